"""From two photographs, with no pose known, to one cloud of points.

sl-synth --output captures --images-only --frames 12
python examples/02_two_frames_to_a_cloud.py captures cloud.npy
"""

import sys
from pathlib import Path

import numpy as np

import sl_nerfstudio as sl


def main(captures: str, output: str) -> None:
    """Decode two frames, find the projector in each, register both, and save their points."""
    folder = Path(captures)
    layout = sl.read_layout(folder / "pattern.json")
    projector = sl.read_device_file(folder / "intrinsics.json", "projector", (layout.w, layout.h))
    clouds = []
    for image in sorted((folder / "images").iterdir())[:2]:
        found = sl.decode_image(image, layout)
        height, width = found.mask.shape
        camera = sl.read_device_file(folder / "intrinsics.json", "camera", (width, height))
        pose = sl.estimate_relative_pose(*sl.correspondences_of(found.coords), camera, projector)
        print(f"{image.name}: projector known to {pose.sigma_rotation_deg:.3f} degrees, baseline of length 1")
        clouds.append(sl.frame_cloud(image.stem, found.coords, camera, projector, pose, seen=found.mask))
    registration = sl.register(clouds)
    points = [
        cloud.points * baseline @ T[:3, :3].T + T[:3, 3]
        for cloud, T, baseline in zip(clouds, registration.T_world_camera, registration.baseline, strict=True)
    ]
    print(f"registered: {registration.registered.tolist()}, {sum(map(len, points))} points in the axes of camera 0")
    np.save(output, np.concatenate(points))


if __name__ == "__main__":
    main(*sys.argv[1:])
