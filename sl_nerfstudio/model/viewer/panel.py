"""The controls of a scan at the top of the viewer's panel."""

import base64
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib
import numpy as np
import viser
from PIL import Image

from sl_nerfstudio.model.viewer.surface import MODES, RENDERED, Coloured


class Panel:
    """The values that the user chose; every change calls `changed` with the name of what changed."""

    def __init__(
        self, server: viser.ViserServer, names: Sequence[str], training: bool, changed: Callable[[str], None]
    ) -> None:
        gui = server.gui
        with gui.add_folder("Scan", order=-1.0):
            self.surface = gui.add_dropdown("Surface", MODES, RENDERED, hint="The surface as a mesh, in these colours")
            self._legend = gui.add_markdown("", visible=False)
            self.update = gui.add_button("Update surface", visible=False, hint="Make the mesh of the current step")
            last = max(len(names) - 1, 1)
            self.frame = gui.add_slider(
                "Frame", 0, last, 1, 0, hint="Its projector lights the surface; depth, coordinates and rays are its own"
            )
            self._name = gui.add_markdown("")
            self.rays = gui.add_checkbox("Pattern rays", False, hint="Where rays of the frame's devices meet")
            self.projectors = gui.add_checkbox("Projectors", True)
            self.starting = gui.add_checkbox("Starting poses", True, hint="Grey, with a line to the current pose")
            self.names = gui.add_checkbox("All names", False, hint="Otherwise those of the chosen frame")
        self._frames, self._training = names, training
        for name in ("surface", "frame", "rays", "projectors", "starting", "names"):
            getattr(self, name).on_update(_Call(changed, name))
        self.update.on_click(_Call(changed, "update"))
        self.show_frame()

    @property
    def chosen_frame(self) -> int:
        """Number of the chosen frame."""
        return min(int(self.frame.value), len(self._frames) - 1)

    def show_frame(self) -> None:
        """Write the chosen frame's name under the slider."""
        self._name.content = f"`{self._frames[self.chosen_frame]}`"

    def show_legend(self, coloured: Coloured | None) -> None:
        """Say what the colours mean; None if the surface is not drawn as a mesh."""
        self._legend.visible = coloured is not None
        self.update.visible = self._training and coloured is not None
        if coloured is not None:
            self.say(legend(coloured))

    def say(self, text: str) -> None:
        """Write something under the choice of the surface."""
        self._legend.visible = True
        self._legend._image_root = Path()  # pictures are data, not files
        self._legend.content = text


class _Call:
    """A callback that passes on a name, not viser's event."""

    def __init__(self, changed: Callable[[str], None], name: str) -> None:
        self._changed, self._name = changed, name

    def __call__(self, event: viser.GuiEvent) -> None:
        self._changed(self._name)


def legend(coloured: Coloured) -> str:
    """Markdown: the colour scale with its limits, and what it shows."""
    if coloured.scale is None:
        return coloured.meaning
    colours, lower, upper, units = coloured.scale
    strip = np.repeat(matplotlib.colormaps[colours](np.linspace(0, 1, 240))[None, :, :3], 10, 0)
    buffer = io.BytesIO()
    Image.fromarray(np.rint(255 * strip).astype(np.uint8)).save(buffer, "PNG")
    address = "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode()
    return f"![colours]({address})\n\n**{lower:.3g}** to **{upper:.3g} {units}**. {coloured.meaning}"
