"""Decoding: which point of the projected pattern lights each pixel of a capture.

In: the images of one frame (one photograph, or a sequence) and the `PatternLayout` that was projected; no calibration
and no other frame. Out: a `Decoded`, with pattern coordinates for every pixel, a mask, and the normalised intensity; or
a DecodingError that says what is wrong with the capture.
"""
