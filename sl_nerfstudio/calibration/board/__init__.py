"""Intrinsics of camera and projector from photographs of a board.

In: photographs of a chessboard or ChArUco board, with coordinates of the pattern projected onto it. Out: both devices
with the covariance of every number, and facts a person can judge them by.
"""
