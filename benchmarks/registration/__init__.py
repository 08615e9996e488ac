"""Registration of frames whose relative poses are known."""
