"""Rigid motions, similarities, device models, rays, triangulation and epipolar residuals.

Functions take poses, intrinsics, pixels and points as arrays or tensors, and return the same. They know nothing about
scans or files, and all other folders build on them.
"""
