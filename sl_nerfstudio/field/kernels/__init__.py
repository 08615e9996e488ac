"""The field's compiled CPU kernels: only numba, without BLAS, OpenMP or a compiler on the user's machine.

In: points, the feature table and the weights as arrays. Out: values, their gradients, and the adjoints of both.
"""
