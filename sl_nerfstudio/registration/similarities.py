"""Many similarities at once, and their increments (v, w, l) about pivots (see `increments`)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity


@dataclass(frozen=True)
class Similarities:
    """Each maps `p_b` to `scale * R @ p_b + t`."""

    scale: Float64[ndarray, "n"]
    R: Float64[ndarray, "n 3 3"]
    t: Float64[ndarray, "n 3"]

    @staticmethod
    def of(each: Sequence[Similarity]) -> "Similarities":
        """From at least one."""
        scale, R, t = zip(*((S.scale, S.R, S.t) for S in each), strict=True)
        return Similarities(np.array(scale), np.stack(R), np.stack(t))

    def each(self) -> list[Similarity]:
        """One by one."""
        return [Similarity(float(s), R, t) for s, R, t in zip(self.scale, self.R, self.t, strict=True)]

    def chosen(self, index: Int64[ndarray, "m"]) -> "Similarities":
        """Some of them."""
        return Similarities(self.scale[index], self.R[index], self.t[index])

    def points(self, p: Float64[ndarray, "n 3"]) -> Float64[ndarray, "n 3"]:
        """One point of frame b each in frame a."""
        return self.scale[:, None] * (self.R @ p[..., None])[..., 0] + self.t

    def orthonormal(self) -> "Similarities":
        """With the rotations nearest to their matrices.

        `inverse` transposes, and products of similarities and inverses double what is not orthonormal, again and again:
        rounding errors become large where components are joined a hundred times.
        """
        return Similarities(self.scale, Rotation.from_matrix(self.R).as_matrix(), self.t)

    def inverse(self) -> "Similarities":
        """Of each."""
        R = self.R.transpose(0, 2, 1)
        return Similarities(1 / self.scale, R, -(R @ self.t[..., None])[..., 0] / self.scale[:, None])

    def __matmul__(self, other: "Similarities") -> "Similarities":
        """Products of pairs."""
        return Similarities(self.scale * other.scale, self.R @ other.R, self.points(other.t))


def logs_at(D: Similarities, centre: Float64[ndarray, "n 3"], radius: Float64[ndarray, "n"]) -> Float64[ndarray, "n 7"]:
    """Increments about pivots that are the similarities."""
    v = (D.points(centre) - centre) / radius[:, None]
    return np.concatenate([v, Rotation.from_matrix(D.R).as_rotvec(), np.log(D.scale)[:, None]], 1)


def exps_at(
    x: Float64[ndarray, "n 7"],
    centre: Float64[ndarray, "n 3"],
    radius: Float64[ndarray, "n"],
    largest_log_scale: float,
) -> Similarities:
    """The similarities of increments about pivots."""
    R = Rotation.from_rotvec(x[:, 3:6]).as_matrix()
    scale = np.exp(np.clip(x[:, 6], -largest_log_scale, largest_log_scale))
    turned = scale[:, None] * (R @ centre[..., None])[..., 0]
    return Similarities(scale, R, centre - turned + radius[:, None] * x[:, :3])
