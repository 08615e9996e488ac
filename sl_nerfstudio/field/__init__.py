"""The signed distance field: a feature grid and a small perceptron, with compiled and plain torch backends.

In: points of the scene in [-1, 1]^3. Out: signed distances and their gradients, differentiable; also a cached coarse
grid of values, and the optimiser for the large feature table.
"""
