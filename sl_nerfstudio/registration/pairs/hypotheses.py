"""Several similarities between two frames at once, as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class Hypotheses:
    """Similarities `p_target = scale R p_source + t`."""

    scale: Float64[ndarray, "k"]
    R: Float64[ndarray, "k 3 3"]
    t: Float64[ndarray, "k 3"]
    log_scale_prior: Float64[ndarray, "k"]  # logarithm of the scale that each started with

    @staticmethod
    def of(S: Similarity) -> "Hypotheses":
        """One similarity alone."""
        return Hypotheses(np.array([S.scale]), S.R[None], S.t[None], np.log([S.scale]))

    @staticmethod
    def joined(parts: Sequence["Hypotheses"]) -> "Hypotheses":
        """Several sets as one."""
        return Hypotheses(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Hypotheses)))

    def __len__(self) -> int:
        """Number of similarities."""
        return len(self.scale)

    def __getitem__(self, index: list[int]) -> "Hypotheses":
        """Some of them."""
        return Hypotheses(self.scale[index], self.R[index], self.t[index], self.log_scale_prior[index])

    def incremented(
        self, v: Float64[ndarray, "k 3"], w: Float64[ndarray, "k 3"], growth: Float64[ndarray, "k"],
        centre: Float64[ndarray, "3"],
    ) -> "Hypotheses":  # fmt: skip
        """Each followed by `p <- centre + growth exp(w) (p - centre) + v`."""
        turn = Rotation.from_rotvec(w).as_matrix()
        t = centre + growth[:, None] * np.einsum("kij,kj->ki", turn, self.t - centre) + v
        return Hypotheses(self.scale * growth, turn @ self.R, t, self.log_scale_prior)

    def similarity(self, k: int) -> Similarity:
        """One of them."""
        return Similarity(float(self.scale[k]), self.R[k], self.t[k])

    def difference(self, a: int, b: int, centre: Float64[ndarray, "3"]) -> tuple[float, float]:
        """Angle between two of them, in degrees, and how far apart they map the point that b maps to `centre`."""
        angle = np.arccos(np.clip((np.trace(self.R[a] @ self.R[b].T) - 1) / 2, -1, 1))
        p = (self.R[b].T @ (centre - self.t[b])) / self.scale[b]
        shift = np.linalg.norm(self.scale[a] * self.R[a] @ p + self.t[a] - centre)
        return float(np.degrees(angle)), float(shift)
