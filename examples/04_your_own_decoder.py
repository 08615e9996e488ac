"""Coordinates of your own decoder become a scan: only `decode` is yours.

sl-synth --output captures --images-only --frames 12
python examples/04_your_own_decoder.py captures scan
"""

import sys
from pathlib import Path

import numpy as np

import sl_nerfstudio as sl


def decode(name: str, captures: Path) -> np.ndarray:
    """Pattern coordinates (h, w, 2) of a frame, NaN where unknown. Here they are known, but for 0.2 px of noise."""
    coords = np.load(captures / "ground_truth" / "coords" / f"{name}.npz")["coords"]
    return coords + np.random.default_rng(0).normal(0, 0.2, coords.shape).astype(np.float32)


def main(folder: str, output: str) -> None:
    """Calibrate and register the frames, adjust all poses, write the scan."""
    captures = Path(folder)
    truth = sl.read_scan(captures / "ground_truth")  # for its devices
    camera, projector = truth.frames[0].camera, truth.projector
    clouds = []
    for frame in truth.frames:
        coords = decode(frame.name, captures)
        pose = sl.estimate_relative_pose(*sl.correspondences_of(coords), camera, projector)
        clouds.append(sl.frame_cloud(frame.name, coords, camera, projector, pose))
    found = sl.adjust_registered(clouds, sl.register(clouds))
    print(f"frames agree to {found.median_after_px:.2f} px")
    pattern = np.rint(255 * truth.read_pattern()).astype(np.uint8)
    devices = {"projector": projector, "pattern": pattern, "camera": camera}
    with sl.ScanWriter(output, units="arbitrary", scale=sl.Scale(known=False), **devices) as writer:
        for k, (frame, cloud) in enumerate(zip(truth.frames, clouds, strict=True)):
            if found.sigma[k] is None:
                continue  # it could not be registered
            poses = {name: T[k] for name, T in vars(found.poses).items()}
            writer.add_frame(
                frame.name, image=frame.read_image(), coords=cloud.coords, pose_sigma=found.sigma[k], **poses
            )
    print(f"{output}: {len(sl.read_scan(output).frames)} frames")


if __name__ == "__main__":
    main(*sys.argv[1:])
