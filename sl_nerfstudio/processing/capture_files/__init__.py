"""Captures as people have them: sequences of other programs.

In: the images of a folder and what the flags say about them. Out: the sequence that they show, or an error with the
file.
"""
