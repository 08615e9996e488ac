"""Captures of the coded grid, decoded from a single image.

In: one image and a `GridPattern`. A U-Net finds lines and symbols, a graph network identifies the nodes, a dense fit to
the image refines the coordinates, and an edge network continues them beside edges and says which are wrong. Out: a
`Decoded`.
"""
