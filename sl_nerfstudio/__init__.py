"""3D scanning with a freely moving pattern projector and camera, as a nerfstudio plugin.

What Python programs use is listed in `__init__.pyi` by topic, and loaded when it is first named: docs/python.md.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
