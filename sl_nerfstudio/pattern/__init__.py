"""Projected patterns: the coded grid, Gray code, and any image.

In: the size and period of a pattern and a seed, or a pattern.json. Out: a `PatternLayout`, which has the pattern's
codes, its picture, and its description as pattern.json.
"""
