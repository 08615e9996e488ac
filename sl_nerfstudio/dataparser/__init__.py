"""The scan folder as nerfstudio sees it.

In: a scan folder. Out: cameras in the normalised scene, a table of all pixels with some held out, and batches of rays
with what was measured along them.
"""
