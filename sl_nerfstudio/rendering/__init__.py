"""Volume rendering of a signed distance field as projector coordinates and pattern intensity, with the losses.

In: rays, poses, projector and pattern as tensors, a field, and the progress of the run. Out: rendered rays and losses.
Independent of nerfstudio and of the model.
"""
