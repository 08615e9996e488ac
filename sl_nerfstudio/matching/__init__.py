"""Coordinates of a photograph, matched along epipolar lines once the pose of its projector is known.

The pose leaves one unknown to each pixel, its distance; what the pattern shows there is compared with the image.
In: a grey photograph of the coded grid, what the decoder read in it, both devices and their relative pose.
Out: coordinates of more pixels, more exact ones, and how probable it is that each is right.
"""
