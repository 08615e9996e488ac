"""Registration: the cameras of all frames in one world, from the surfaces that the frames share.

Decoded coordinates and the relative pose of every frame come in, and rough camera poses where they are known. A camera
pose and the length of the baseline of every frame go out, with the pairs that support them, the frames that were left
out and why, and what remains uncertain; a known length turns relative lengths into true ones.
"""
