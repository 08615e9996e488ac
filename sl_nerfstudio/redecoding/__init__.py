"""Decoding again, with what a trained surface predicts: cells that were missed, and cells that were decoded wrongly.

In: a trained run with its scan. Out: a new scan folder with more coordinates, and the facts of every frame. A
coordinate is only taken from the image; the surface says where in the pattern to look. Limits are learnt from the
pixels of the same frame that the decoder had decoded.
"""
