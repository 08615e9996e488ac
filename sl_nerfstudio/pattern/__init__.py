"""Projected patterns: the coded grid, any image, and local intensity normalisation."""
