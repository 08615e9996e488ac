"""Methods to compare with: COLMAP, TSDF fusion after ICP and frame to model, Poisson's surface.

In: photographs, or a scan with poses. Out: poses, or a mesh.
"""
