"""Train the surface of a scan, and write it with the uncertainty of every vertex.

sl-synth --output scan
python examples/03_scan_to_mesh.py scan outputs mesh.ply 1000
"""

import sys

import numpy as np

import sl_nerfstudio as sl


def main(scan: str, runs: str, output: str, steps: str = "1000") -> None:
    """Train, load the run, extract its surface, measure a distance on it."""
    run = sl.load_run(sl.train(scan, runs, name="example", steps=int(steps)))
    surface = sl.surface_of(run, resolution=256)
    mesh, quality, model = surface.mesh, surface.properties.quality, run.model
    sl.write_mesh(output, mesh, surface.properties, model.scan.units)
    seen = mesh.vertices[quality.views > 0]
    print(
        f"{len(mesh.faces)} triangles; 1 sigma along the normal: {np.nanmedian(quality.sigma):.2g} {model.scan.units}"
    )
    p, q = seen[seen[:, 0].argmin()], seen[seen[:, 0].argmax()]
    pair = sl.PointPair("width", tuple(p.tolist()), tuple(q.tolist()))
    (width,) = sl.measure_lengths([pair], mesh, quality, model.scan, model.poses(), model.joint_covariance())
    sigma = "not known" if width.sigma is None else f"{width.sigma:.2g}"
    print(f"{width.name}: {width.length:.2f} {model.scan.units}, 1 sigma {sigma}")


if __name__ == "__main__":
    main(*sys.argv[1:])
