"""How far is a measured surface from the part that it should be?

python examples/05_compare_with_cad.py mesh.ply part.stl mm 0.1
"""

import sys

import sl_nerfstudio as sl


def main(mesh: str, part: str, unit: str, tolerance: str) -> None:
    """Place the surface on the part, wherever it is, and print where it is out of tolerance."""
    measured, nominal = sl.read_mesh(mesh, unit), sl.read_mesh(part, unit)
    placed = sl.place_on_part(measured, nominal)
    print(f"{'placed' if placed.fits else 'does not fit'}: {placed.rms:.3f} {unit} RMS of the nearest 80 %")
    if placed.open_motions or placed.equal_turns:
        print("its shape allows other places, too: deviations may belong elsewhere")
    found = sl.inspect(measured, nominal, placed.S_part_result, float(tolerance), sl.read_quality(mesh))
    print(f"within {found.within:.1%}, out of tolerance {found.out:.1%}, undecided {found.undecided:.1%}")
    for patch in found.patches:
        print(f"{patch.mean:+.3f} {unit} over {patch.area:.1f} {unit}² at {', '.join(f'{v:.1f}' for v in patch.place)}")


if __name__ == "__main__":
    main(*sys.argv[1:])
