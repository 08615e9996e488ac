"""What happens along rays, as Warp's kernels for GPUs; they also run on the CPU, where tests compare them with torch.

In: pixels, poses, a cached grid, the field's values at samples, one projector and its pattern. Out: samples and other
points; the losses of what rays see and of these points, with their adjoints by the field's values and by poses.
"""
