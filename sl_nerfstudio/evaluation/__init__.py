"""How good a result is: distances from the truth, pose errors, agreement with the captures, and a verdict.

In: a mesh, a scan, poses and, if known, the truth or a reference. Out: an `Evaluation`, its JSON and its report.
"""
