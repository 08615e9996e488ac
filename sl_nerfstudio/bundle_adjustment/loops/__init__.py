"""The bundle adjustment's compiled loops over anchors, rows and frames.

In: plain arrays of a rig, of anchors, of the rows in which frames see them, and of coordinate images. Out: arrays that
the caller made: look-ups, residuals, derivatives, sums of the normal equations, and random choices that depend on
a seed only.
"""
