"""Poses and intrinsics of a run as files of other programs: COLMAP models, a script for Blender, trajectories.

In: the devices of all frames with their refined poses (`PosedDevice`), and a surface. Out: the contents of files.
"""
