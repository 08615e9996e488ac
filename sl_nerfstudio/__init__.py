"""3D scanning with a freely moving pattern projector and camera, as a nerfstudio plugin."""

__version__ = "0.1.0"
