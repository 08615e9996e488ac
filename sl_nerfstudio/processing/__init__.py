"""From photographs to a scan folder: the work of `sl-process`.

In: images, pattern.json, the intrinsics of both devices, and flags (`ProcessConfig`). Out: a scan folder, a report, and
processing.json; a frame that cannot be used is left out with its reason, and decoded frames are kept for the next run.
"""
