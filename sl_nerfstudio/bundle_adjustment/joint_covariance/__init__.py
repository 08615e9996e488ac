"""The covariance of all poses and the intrinsics together, in the gauge of the scan.

In: the adjustment's covariance, and the length that fixes the scale. Out: what shared errors do to points and lengths.
"""
