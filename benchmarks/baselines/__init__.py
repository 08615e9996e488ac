"""Classical methods to compare with: TSDF fusion, ICP registration, fusion frame to model, window matching.

In: a scan with poses, or the nodes that the decoder found. Out: a mesh, registered poses, or matched nodes.
"""
