"""Meshes and point clouds as the bytes of other programs' files, with the unit and the axes that those expect.

In: meshes with the properties of their vertices, in a scan's world. Out: contents of OBJ, STL, glTF, PLY and LAS files.
"""
