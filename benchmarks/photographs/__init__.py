"""From photographs to scans: rendered sets of captures with known truth, and how well `sl-process` does on them.

In: sets of captures (`sets`), rendered once. Out: figures for each set, printed and written as JSON.
"""
