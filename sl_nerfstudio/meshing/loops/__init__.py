"""Compiled loops over the vertices of a mesh as frames see them: derivatives, and comparisons with what was decoded.

In: plain arrays of vertices, devices and images of a frame. Out: arrays that the caller made.
"""
