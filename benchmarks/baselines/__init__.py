"""Classical methods to compare with: COLMAP, TSDF fusion, Poisson's surface, ICP registration, window matching.

In: photographs, a scan with poses, or the nodes that the decoder found. Out: poses, a mesh, or matched nodes.
"""
