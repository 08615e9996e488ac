"""Rigid motions, device models, rays, triangulation and epipolar geometry."""
