"""Methods to compare with: COLMAP, TSDF fusion after ICP and frame to model, Poisson's surface, window matching.

In: photographs, a scan with poses, or the nodes that the decoder found. Out: poses, a mesh, or matched nodes.
"""
