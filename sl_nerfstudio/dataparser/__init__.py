"""The scan folder as nerfstudio data.

In: a scan folder. Out: cameras in the normalised scene, a table of all pixels with some held out, and batches of rays
with their measurements.
"""
