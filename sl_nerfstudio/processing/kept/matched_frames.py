"""Decoded frames matched along the epipolar lines of their relative poses, kept in the work folder."""

from typing import Any

from sl_nerfstudio.decoding.decoded import Decoded
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.grid.decoder import NetworkDecoder
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.matching.matcher import DecodedImage, LineMatcher
from sl_nerfstudio.matching.resolution import pixels_a_period
from sl_nerfstudio.processing.captures import CapturedFrame
from sl_nerfstudio.processing.kept.records import digest
from sl_nerfstudio.processing.kept.stages import surroundings
from sl_nerfstudio.processing.kept.store import DecodedStore
from sl_nerfstudio.relative_pose.estimation import RelativePose
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.scan.photographs import read_photograph

_KEY_LENGTH = 24


class FrameMatcher:
    """Matches the frames of one decoder; of those that read more than one image of a frame, none."""

    def __init__(self, decoder: Decoder[Any], store: DecodedStore) -> None:
        self._decoder = decoder if isinstance(decoder, NetworkDecoder) else None
        self._matcher = None if self._decoder is None else LineMatcher(self._decoder.layout)
        self._store = store

    def matched(
        self, frame: CapturedFrame, key: str, decoded: Decoded, devices: tuple[Device, Device], pose: RelativePose
    ) -> tuple[str, Decoded] | None:
        """Key and maps of a frame that was decoded under `key`; None where it is left as it is.

        So are frames that several poses explain: coordinates must not be changed for one of them. Raises FileError if
        the image cannot be read.
        """
        if self._decoder is None or self._matcher is None or pose.alternatives:
            return None
        new = digest((surroundings(), key, devices, pose.T_camera_projector))[:_KEY_LENGTH]
        kept = self._store.load(frame, new)
        if kept is not None:
            return new, kept
        grey = as_grey(read_photograph(frame.images[0]))
        image = DecodedImage(grey, decoded.coords, decoded.mask)
        coords = self._matcher.match(image, *devices, pose.T_camera_projector)
        size = pixels_a_period(decoded.coords, self._decoder.layout.period)
        if coords is decoded.coords or size is None:
            return None
        return new, self._store.save(frame, new, self._decoder.images.decoded(grey, coords, decoded.mask, size))
