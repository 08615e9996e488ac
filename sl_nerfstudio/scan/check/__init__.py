"""The full check of a scan folder, as sl-check and training do it.

In: a scan folder as scan/ reads it, and all its pixels. Out: every fault, with its place, likely cause and remedy; if
there is none, the scan and how well its starting poses fit the coordinates.
"""
