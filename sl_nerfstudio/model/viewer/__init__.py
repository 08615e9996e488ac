"""What nerfstudio's viewer shows of a scan: devices, the way of their poses, pattern rays, the surface in colours.

In: the model that is trained or was loaded, and nerfstudio's viewer. Out: nodes of the viewer's scene, and controls for
them in its panel. Positions in the viewer are ten times those of the scene.
"""
