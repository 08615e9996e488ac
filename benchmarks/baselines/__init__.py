"""Classical methods to compare with: TSDF fusion, rigid ICP registration, window matching.

They take scans, poses and grid graphs of the package, and return meshes, poses and node assignments. The package itself
never imports them.
"""
