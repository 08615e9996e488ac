"""How true the intrinsics of sl-calibrate are, and their stated uncertainties.

In: rendered photographs of boards, or real ones. Out: errors against the truth; stability under leaving poses out.
"""
