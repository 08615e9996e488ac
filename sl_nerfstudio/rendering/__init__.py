"""Volume rendering of a signed distance field as projector coordinates and pattern intensity, with the losses.

In: rays, poses, projector and pattern as tensors, a field, and how far the run has come. Out: rendered rays and losses.
Knows neither nerfstudio nor its model.
"""
