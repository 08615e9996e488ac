"""Triangle meshes as binary PLY."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray


def encode_ply(vertices: Float[ndarray, "v 3"], faces: Int[ndarray, "f 3"]) -> bytes:
    """A binary little-endian PLY file with vertices in double precision."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(vertices)}\nproperty double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, faces
    return head.encode() + vertices.astype("<f8").tobytes() + records.tobytes()
