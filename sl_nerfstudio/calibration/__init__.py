"""Poses from correspondences: joint adjustment of all cameras and projectors."""
