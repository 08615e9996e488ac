"""The poses of all devices from their parameters, as Warp's kernels for GPUs; tested against torch on the CPU.

In: increments and base poses. Out: poses in single precision, and the adjoints of the increments.
"""
