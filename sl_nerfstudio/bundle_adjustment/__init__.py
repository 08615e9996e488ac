"""Bundle adjustment: all poses together, and the intrinsics on request, from decoded coordinates.

In: a `Rig` of starting poses, the coordinate images of all frames, a prior with the stated uncertainties, and which
parameters are free. Out: the adjusted `Rig`, its covariance, and how well the intrinsics agree with the captures; facts
only, no messages.
"""
