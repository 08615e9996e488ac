"""The tone of surfaces: what holds frames where their shape does not.

In: the projector's light that each pixel returns, points and normals. Out: a map of tones for each frame; pairs of
frames that tones hold, as far as third frames confirm them.
"""
