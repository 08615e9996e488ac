"""One frame registered to another.

In: the surface maps of two frames, and where to search. Out: the similarity between them with its uncertainty, other
similarities that explain nearly as much, and how much of the two surfaces agrees.
"""
