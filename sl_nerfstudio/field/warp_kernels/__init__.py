"""The field's kernels for GPUs, in Warp; they also run on the CPU, where tests compare them with torch.

In: points, the feature table, layers of the perceptron, as tensors. Out: encoded points, their derivatives, and the
adjoints of both; the optimiser's step for the table. Matrix products are torch's.
"""
