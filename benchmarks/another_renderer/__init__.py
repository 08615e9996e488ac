"""Captures by a renderer that shares no code with the package, and what `sl-process` makes of them.

In: objects from formulas. Out: photographs with their truth, and figures for each set, printed and written as JSON.
Nothing here imports `sl_nerfstudio`: geometry, lenses, light, noise and scoring are written a second time.
"""
