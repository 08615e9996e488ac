"""What stands in front of the devices: built-in objects, mesh files, and the table and walls around an object.

In: a name or a file, and for surroundings a random generator. Out: triangle meshes in millimetres.
"""
