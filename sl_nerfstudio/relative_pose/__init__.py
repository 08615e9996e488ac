"""The pose of the projector relative to its camera, from one frame alone.

In: decoded pixels of a frame and the intrinsics of both devices. Out: the relative pose with a baseline of length one,
its covariance, the pixels that agree with it and the degeneracies of the frame. One frame cannot show how long its
baseline is.
"""
