"""Captures of the coded grid, decoded from a single image.

In: one image and a `GridPattern`. A U-Net finds lines and symbols, a graph network identifies the nodes, and a dense
fit to the image refines the coordinates. Out: a `Decoded`.
"""
