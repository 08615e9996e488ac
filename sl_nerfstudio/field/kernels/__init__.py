"""The field's compiled CPU kernels: numba, without BLAS, without OpenMP, without a compiler at the user's."""
