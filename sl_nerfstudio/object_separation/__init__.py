"""The object apart from what surrounds it: the plane it stands on, walls, and what lies beyond.

In: decoded frames with known poses (`DecodedFrame`). Out: a `Separation`, which says for every pixel of a frame and for
every point in the world whether it belongs to the object, and what is known about every plane. Nothing is removed here.
"""
