"""From a signed distance field to a mesh in world units, trimmed to what was observed.

In: a field, the scan and its poses; or a mesh file. Out: a `Mesh`, and mesh files.
"""
