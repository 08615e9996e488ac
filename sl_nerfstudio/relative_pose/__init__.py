"""The pose of the projector relative to its camera, from one frame alone.

Decoded pixels of a frame and the intrinsics of both devices come in. The relative pose with a baseline of length one,
its covariance, the pixels that agree with it and the degeneracies of the frame go out; one frame cannot show how long
its baseline is.
"""
