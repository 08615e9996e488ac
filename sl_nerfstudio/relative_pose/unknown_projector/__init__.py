"""Intrinsics of a projector that nobody has calibrated, from the coordinates of all frames together.

In: correspondences of every frame, the camera's intrinsics, and what is known of the projector, perhaps only the size
of its image. Out: focal lengths, principal point and one distortion term with their covariance, or what is missing.
Every frame's fundamental matrix leaves two constraints on them; their poses are eliminated.
"""
