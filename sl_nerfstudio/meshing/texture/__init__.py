"""An image for the surface: the mesh laid out flat, and the colour of every pixel of it.

In: a mesh, and pictures that were taken without the pattern. Out: texture coordinates and an image for mesh files.
"""
