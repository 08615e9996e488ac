"""Geometry without files: SE(3), Sim(3), device models, rays, triangulation, epipolar residuals.

In: poses, intrinsics, pixels and points, as arrays or tensors. Out: the same kinds of values; most functions are
differentiable.
"""
