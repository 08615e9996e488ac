"""How well a projector that nobody has calibrated is found, and what that costs in the surface.

In: synthetic sets of decoded coordinates under projectors with lens shift. Out: figures against the truth.
"""
