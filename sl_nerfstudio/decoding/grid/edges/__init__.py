"""Coordinates beside edges: from which of the surfaces around it each pixel is continued.

The windows of the dense fit, and the U-Net's own field of view, are wider than what is seen of a surface beside its
edge, so coordinates run on from one surface over the border of another. In: the evidence of the dense fit. A network
chooses for each pixel where its surface is seen better, a few pixels away, and says how probable it is that it is wrong
all the same. Out: coordinates continued from there.
"""
