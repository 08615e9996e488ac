"""Showing patterns on displays, and capturing frames with a camera.

In: a pattern, the number of a display, and a camera or a video. Out: the pattern on the display, pixel for pixel, and a
folder of captures as sl-process takes them. Frames are decoded while they are captured, so that only those are kept
which add something.
"""
