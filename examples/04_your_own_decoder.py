"""Coordinates of your own decoder become a scan: only `decode` is yours.

sl-synth --output captures --images-only --frames 12
python examples/04_your_own_decoder.py captures scan
"""

import sys
from pathlib import Path

import numpy as np

import sl_nerfstudio as sl


def decode(frame: sl.Frame) -> np.ndarray:
    """Pattern coordinates (h, w, 2), NaN where unknown. Here they are known, but for 0.2 px of noise."""
    coords = frame.read_coords()
    return coords + np.random.default_rng(0).normal(0, 0.2, coords.shape).astype(np.float32)


def main(captures: str, output: str) -> None:
    """Calibrate and register the frames, adjust all poses, write the scan."""
    given = sl.read_scan(Path(captures) / "ground_truth")  # for its images and devices; its poses are not used
    clouds = []
    for frame in given.frames:
        coords = decode(frame)
        pose = sl.estimate_relative_pose(*sl.correspondences_of(coords), frame.camera, given.projector)
        clouds.append(sl.frame_cloud(frame.name, coords, frame.camera, given.projector, pose))
    found = sl.adjust_registered(clouds, sl.register(clouds))
    print(f"frames agree to {found.median_after_px:.2f} px")
    pattern, scale = np.rint(255 * given.read_pattern()).astype(np.uint8), sl.Scale(known=False)
    with sl.ScanWriter(output, units="arbitrary", scale=scale, projector=given.projector, pattern=pattern) as writer:
        for k, (frame, cloud) in enumerate(zip(given.frames, clouds, strict=True)):
            if found.sigma[k] is not None:  # else it could not be registered
                image, poses = frame.read_image(), {name: T[k] for name, T in vars(found.poses).items()}
                writer.add_frame(frame.name, image=image, coords=cloud.coords, camera=frame.camera, **poses)


if __name__ == "__main__":
    main(*sys.argv[1:])
