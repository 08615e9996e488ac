"""Gray-code sequences, decoded pixel by pixel.

In: the images of one sequence in the order of projection, and its `GrayCode`. Out: a `Decoded` whose coordinates are
finer than the cells of the code.
"""
