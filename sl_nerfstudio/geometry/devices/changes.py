"""Changes of focal lengths and principal points, as shares of the focal length, by which a calibration is corrected."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field, replace

from sl_nerfstudio.geometry.devices.device import Device


@dataclass(frozen=True)
class DeviceChange:
    """A change of one device's intrinsics; all three numbers are shares of its fl_x. Distortion does not change."""

    focal: float = 0.0
    """Relative change of both focal lengths."""
    x: float = 0.0
    """Shift of the principal point to the right, as a share of the focal length."""
    y: float = 0.0
    """Shift of the principal point downward, as a share of the focal length."""

    def applied(self, device: Device) -> Device:
        """The device after the change."""
        return replace(
            device,
            fl_x=device.fl_x * (1 + self.focal),
            fl_y=device.fl_y * (1 + self.focal),
            cx=device.cx + device.fl_x * self.x,
            cy=device.cy + device.fl_x * self.y,
        )


@dataclass(frozen=True)
class IntrinsicsChange:
    """A change of the intrinsics of the cameras (the same for all) and of the projector."""

    camera: DeviceChange = field(default_factory=DeviceChange)
    """Change of all cameras."""
    projector: DeviceChange = field(default_factory=DeviceChange)
    """Change of the projector."""

    @staticmethod
    def of(values: Sequence[float]) -> "IntrinsicsChange":
        """From six numbers: focal, x, y of the cameras, then of the projector."""
        camera, projector = values[:3], values[3:]
        return IntrinsicsChange(DeviceChange(*camera), DeviceChange(*projector))

    @property
    def values(self) -> tuple[float, ...]:
        """Six numbers, in the order of `of`."""
        return (*astuple(self.camera), *astuple(self.projector))

    def __bool__(self) -> bool:
        """Whether it changes anything."""
        return any(self.values)

    def __add__(self, other: "IntrinsicsChange") -> "IntrinsicsChange":
        """Both changes combined, to first order."""
        return IntrinsicsChange.of([a + b for a, b in zip(self.values, other.values, strict=True)])


UNCHANGED = IntrinsicsChange()
