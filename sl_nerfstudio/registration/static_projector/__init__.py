"""Frames under a projector that stands still: its codes are matches between the cameras.

In: decoded coordinates of all frames and the cameras' intrinsics; of the projector perhaps only the size of its image.
Out: poses of all cameras and of the projector with baseline-free scale, and its intrinsics with their uncertainty. The
cameras are placed without the projector (two views, then one after the other), which then follows by resection.
"""
