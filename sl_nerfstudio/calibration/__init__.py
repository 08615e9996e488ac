"""Intrinsics of camera and projector from photographs of a board, and from the files of other programs.

In: photographs of a board in several poses, or a plain JSON, COLMAP, OpenCV or procam-calibration file, and the size of
the images or of the pattern. Out: a `Device` with the conventions of a scan (first pixel centre at (0.5, 0.5), lens
terms k1, k2, p1, p2) and its uncertainty, or an error that says what does not fit.
"""
