"""The decoder of the coded grid."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import Coords, Decoded, Decoder, Layer, Mask, drop_small_regions, torn
from sl_nerfstudio.decoding.grid_detection import LEAST_NODES, DetectedGrid, GridDetector, refusal
from sl_nerfstudio.decoding.grid_edges import Chosen, EdgeChooser, EdgeEvidence, weight_files
from sl_nerfstudio.decoding.grid_fit import DrawnGrid, draw_sharpnesses, fit_densely
from sl_nerfstudio.decoding.grid_graph import symbol_log_ratio
from sl_nerfstudio.decoding.grid_networks import ImageNetworks, LoadedNetworks
from sl_nerfstudio.decoding.grid_phases import (
    LEAST_MASK,
    map_from_pixels,
    measure_appearance,
    node_places,
    sample_pixels,
    spread,
    to_pattern,
    to_pixel_coordinates,
)
from sl_nerfstudio.pattern.codes import rotate_codes
from sl_nerfstudio.pattern.grid import GridPattern, normalise_locally, projected_light
from sl_nerfstudio.scan.images import Pixels, as_grey, shrunk

# An image of the coded grid, decoded without calibration or other frames.
#
# The grid is found and its phases are read, its nodes are recognised, coordinates spread from the nodes over all
# pixels, a dense fit to the image refines them, and beside edges they are continued from where their surface is seen
# better.

# Which pixels are kept.
_LEAST_TRUST = 0.02  # weight in the fit of a pixel that hardly shows the pattern
_LEAST_LOG_RATIO = 0.0  # log-likelihood ratio of the symbols around a pixel: they must not contradict it
_MOST_WRONG = 0.3  # probability that the pixel is wrong
_SMALLEST_REGION = 2.0  # periods squared
_TEAR = 0.5  # periods between neighbouring pixels
_NORMALISING = 0.8  # window of the local intensity normalisation, periods
_LIGHT_WINDOW = 0.5  # window in which the light is measured, periods
_LIGHT_BLURS = (0.05, 0.09, 0.14, 0.2)  # of the pattern with which it is measured, periods
# Which pixels are right without a look at edges.
_CLEAR_AGREEMENT, _CLEAR_LOG_RATIO = 0.85, 0.9  # of the drawn pattern with the image, and of the symbols
_BESIDE_TEAR = 0.35  # periods around a tear in which nothing is clear
# At which size a photograph is decoded.
_FINEST = 12.0  # pixels a period that are enough: more give no better coordinates
_LARGE = 1.5e6  # pixels; smaller photographs are decoded as they are
_LOOKED_AT = 1200  # pixels of the longer side at which the grid is looked for first


@dataclass(frozen=True)
class FirstLook:
    """An image whose grid was found and read, before edges are looked at."""

    grey: Layer
    found: DetectedGrid
    evidence: EdgeEvidence

    @property
    def mask(self) -> Mask:
        """Where the pattern lights the object."""
        return self.evidence.probability > LEAST_MASK


class GridImageDecoder:
    """Decodes images of one pattern. Create it once for all frames; the same image always gives the same result."""

    def __init__(self, pattern: GridPattern, networks: ImageNetworks | None = None) -> None:
        """`networks`: where they are computed; by default here on the CPU."""
        self.pattern = pattern
        self._networks = LoadedNetworks() if networks is None else networks
        self._detector = GridDetector(pattern, self._networks.unet)

    def decode(self, image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> Decoded:
        """Projector coordinates of every pixel that shows the pattern.

        `image` is grey (h, w) or RGB (h, w, 3), 8 or 16 bit. Raises DecodingError if it shows no pattern, or another
        pattern.
        """
        return self.finished(self.look(image))

    def look(self, image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]) -> FirstLook:
        """The first half of decoding, which `finished` takes up. Raises DecodingError."""
        grey = as_grey(image)
        found = self.detect(grey)
        return FirstLook(grey, found, self.examine(grey, found))

    def finished(self, first: FirstLook) -> Decoded:
        """The second half of decoding: coordinates beside edges, and all maps."""
        found = first.found
        chosen = self.edges.choose(first.evidence, found.rectified, found.assignment.turn)
        coords = self._select(chosen, found.appearance.period)
        return self.decoded(first.grey, coords, first.mask, found.appearance.period)

    def clear_coords(self, first: FirstLook) -> Coords:
        """Coordinates that are right without a look at edges: fewer than all, and enough to know where a frame is."""
        evidence, period = first.evidence, first.found.appearance.period
        fitted = evidence.fitted
        reach = 2 * round(_BESIDE_TEAR * period) + 1
        tear = torn(fitted, _TEAR * self.pattern.period).astype(np.uint8)
        beside = cv2.dilate(tear, np.ones((reach, reach), np.uint8)) > 0
        right = (evidence.agreement > _CLEAR_AGREEMENT) & (evidence.log_ratio > _CLEAR_LOG_RATIO)
        kept = first.mask & right & ~beside & self._inside(fitted)
        return np.where(kept[..., None], fitted, np.float32(np.nan))

    def decoded(self, grey: Layer, coords: Coords, mask: Mask, pixels_a_period: float) -> Decoded:
        """All maps of a capture with these coordinates; the mask holds every pixel that has any."""
        mask = mask | np.isfinite(coords[..., 0])
        light = projected_light(grey, coords, self._soft, _LIGHT_WINDOW * pixels_a_period)
        picture = self.drawn[0].layers[..., 0]
        sigma, mean, contrast = _NORMALISING * pixels_a_period, float(picture.mean()), float(picture.std())
        return Decoded(coords, mask, normalise_locally(grey, mask, sigma, mean, contrast), light)

    def detect(self, grey: Layer) -> DetectedGrid:
        """The grid in an image. Raises DecodingError if too little of it fits the pattern."""
        found = self._detector.detect(grey)
        if found is None or found.known < LEAST_NODES:
            raise refusal(grey, found, self._detector, self.pattern)
        return found

    def shrink_factor(self, image: Pixels) -> int | None:
        """By how much a photograph can be shrunk and still have `_FINEST` pixels a period; None where no grid is found.

        The grid is looked for in a small copy, and in larger ones as long as its lines may be too fine for that.
        """
        if image.shape[0] * image.shape[1] < _LARGE:
            return 1
        factor = max(image.shape[:2]) // _LOOKED_AT
        while factor >= 1:
            found = self._detector.detect(as_grey(shrunk(image, factor)))
            if found is not None and found.known >= LEAST_NODES:
                nodes = node_places(found.maps, found.graph, found.assignment.known)
                measured = measure_appearance(found.maps, found.appearance, nodes) or found.appearance
                return max(1, int(factor * measured.period / _FINEST))
            factor //= 2
        return None

    def examine(self, grey: Layer, found: DetectedGrid) -> EdgeEvidence:
        """Coordinates of all pixels that a node reaches, and what tells the right ones from the wrong ones."""
        assignment, known = found.assignment, found.assignment.known
        phases = sample_pixels(found.maps, found.rectified, (grey.shape[0], grey.shape[1]))
        at = np.floor(to_pixel_coordinates(found.graph.place[known], found.rectified)).astype(np.int32)
        turned = spread(phases.phase, phases.clear, np.ascontiguousarray(at[:, ::-1]), assignment.place[known])
        codes = rotate_codes(np.asarray(self.pattern.codes), assignment.turn)
        to_map = map_from_pixels(found.rectified)
        log_ratio = symbol_log_ratio(turned, codes, found.maps.symbol, to_map, found.appearance.period)
        turned = np.where((log_ratio > _LEAST_LOG_RATIO)[..., None], turned, np.float32(np.nan))
        read = to_pattern(turned, self.pattern, assignment.turn)
        read[~self._inside(read)] = np.nan
        trust = np.clip((phases.probability - LEAST_MASK) / (1 - LEAST_MASK), _LEAST_TRUST, 1).astype(np.float32)
        fitted, agreement = fit_densely(grey, read, trust, self.drawn, found.appearance.period)
        return EdgeEvidence(read, fitted, agreement, log_ratio, phases.probability)

    def _select(self, chosen: Chosen, pixels_a_period: float) -> Coords:
        """The coordinates without pixels that are probably wrong and without small regions."""
        kept = (chosen.wrong < _MOST_WRONG) & self._inside(chosen.coords)
        coords = np.where(kept[..., None], chosen.coords, np.float32(np.nan))
        least = round(_SMALLEST_REGION * pixels_a_period**2)
        return drop_small_regions(coords, _TEAR * self.pattern.period, least)

    def _inside(self, coords: Coords) -> Mask:
        """Pixels whose coordinates lie in the pattern; False for NaN."""
        x, y = coords[..., 0], coords[..., 1]
        return (x >= 0) & (x <= self.pattern.w) & (y >= 0) & (y <= self.pattern.h)

    @cached_property
    def drawn(self) -> tuple[DrawnGrid, ...]:
        """The pattern from sharp to soft."""
        return draw_sharpnesses(self.pattern.render(), self.pattern.period)

    @cached_property
    def edges(self) -> EdgeChooser:
        """Continues coordinates beside edges."""
        return EdgeChooser(self._networks.edges, self.pattern, self.drawn)

    @cached_property
    def _soft(self) -> list[Float32[ndarray, "ph pw"]]:
        """The pattern through lenses of different sharpness."""
        picture, period = self.pattern.render(), self.pattern.period
        return [cv2.GaussianBlur(picture, (0, 0), blur * period) for blur in _LIGHT_BLURS]


class NetworkDecoder(Decoder[GridPattern]):
    """Decodes single images with the trained networks of this package."""

    name: ClassVar[str] = "network"
    version: ClassVar[int] = 10
    reads: ClassVar[str] = GridPattern.kind
    sequence: ClassVar[bool] = False
    networks: ImageNetworks | None = None  # on a GPU; None: loaded here on the CPU

    @property
    def key(self) -> str:
        """See `Decoder`; what a GPU gives may differ in the last digits."""
        return super().key if self.networks is None else f"{super().key} on a GPU"

    def __getstate__(self) -> dict[str, object]:
        """What another process gets: it loads its own networks."""
        return {name: value for name, value in vars(self).items() if name != "images"}

    def decode(self, images: Sequence[Pixels], names: Sequence[str]) -> Decoded:
        """Decode the one image of a frame."""
        return self.images.decode(images[0])

    def shrink_factor(self, image: Pixels) -> int | None:
        """The factor that leaves enough pixels a period."""
        return self.images.shrink_factor(image)

    def weights(self) -> Iterable[Path]:
        """The files of the trained networks."""
        return weight_files()

    @cached_property
    def images(self) -> GridImageDecoder:
        """The decoder of single images."""
        return GridImageDecoder(self.layout, self.networks)
