"""Photographs by Mitsuba 3, a path tracer that nobody of this project wrote, as folders of captures with their truth.

In: meshes of other packages, and a few of our own. Out: sets that `benchmarks.photographs` measures like any other.
"""
