"""Registration: the cameras of all frames in one world, from the surfaces that the frames share.

In: decoded coordinates and the relative pose of every frame, and rough camera poses where they are known. Out: a camera
pose and the length of the baseline of every frame, with the pairs that support them, the frames that were left out and
why, and what remains uncertain. A known length turns relative lengths into true ones.
"""
