"""open3d without its web viewer and its machine learning, whose imports (dash, sklearn, pandas) take most of its start.

Both can still be imported later: the stand-ins are removed as soon as open3d is there.
"""

import sys
from types import ModuleType
from typing import TYPE_CHECKING

_LEFT_OUT = {"open3d.ml": (), "open3d.visualization.draw_plotly": ("draw_plotly", "draw_plotly_server")}


def _import_core() -> ModuleType:
    stand_ins = {}
    for name, members in _LEFT_OUT.items() if "open3d" not in sys.modules else ():
        stand_ins[name] = ModuleType(name)
        for member in members:  # which open3d imports by name
            setattr(stand_ins[name], member, None)
    sys.modules.update(stand_ins)
    try:
        import open3d as core
    finally:
        for name in stand_ins:
            sys.modules.pop(name, None)
    return core


if TYPE_CHECKING:
    import open3d
else:
    open3d = _import_core()
