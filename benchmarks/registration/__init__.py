"""Registration of frames whose poses are known: of walks around objects, and of shuffled frames."""
