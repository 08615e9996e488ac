"""Which point of the pattern lights each pixel of a photograph?

sl-synth --output captures --images-only --frames 6
python examples/01_decode_one_image.py captures/images/frame_00000.png captures/pattern.json
"""

import sys

import sl_nerfstudio as sl


def main(image: str, pattern: str) -> None:
    """Decode an image, and print what was found."""
    layout = sl.read_layout(pattern)
    found = sl.decode_image(image, layout)
    known = found.decoded  # (h, w): pixels that have coordinates
    print(f"{known.sum()} pixels decoded, {found.rate:.0%} of what the pattern lights")
    row, column = (values.mean() for values in known.nonzero())
    row, column = int(row), int(column)
    x, y = found.coords[row, column]
    print(f"the pixel in row {row}, column {column} is lit by point ({x:.2f}, {y:.2f}) of {layout.w} x {layout.h}")


if __name__ == "__main__":
    main(*sys.argv[1:])
