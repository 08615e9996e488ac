"""A page of black rectangles and text in millimetres, as a vector PDF and as a PNG, both in true size."""

import io
import zlib
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

MOST_MILLIMETRES = 5000.0  # a side; PDF ends at 14400 points
_POINTS = 72 / 25.4  # per millimetre


@dataclass(frozen=True)
class Line:
    """A line of text; lengths in mm from the page's upper left corner."""

    text: str  # ASCII
    left: float
    baseline: float
    size: float


@dataclass(frozen=True, eq=False)
class PrintedPage:
    """What is printed; lengths in mm, x right and y down from the page's upper left corner."""

    width: float
    height: float
    black: Float64[ndarray, "n 4"]  # left, top, right, bottom
    lines: tuple[Line, ...] = ()

    def pdf(self) -> bytes:
        """A PDF file of one page of exactly this size, without bitmaps."""
        objects = [
            b"<< /Type /Catalog /Pages 2 0 R >>",
            b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            b"<< /Type /Page /Parent 2 0 R /Contents 4 0 R /Resources << /Font << /F 5 0 R >> >> "
            + f"/MediaBox [0 0 {self.width * _POINTS:.4f} {self.height * _POINTS:.4f}] >>".encode(),
            _stream(self._drawing()),
            b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        ]
        text, places = b"%PDF-1.4\n", []
        for number, content in enumerate(objects, 1):
            places.append(len(text))
            text += b"%d 0 obj\n%b\nendobj\n" % (number, content)
        size = len(objects) + 1
        table = b"0000000000 65535 f \n" + b"".join(b"%010d 00000 n \n" % place for place in places)
        end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (size, len(text))
        return text + b"xref\n0 %d\n%b" % (size, table) + end

    def _drawing(self) -> bytes:
        """PDF's drawing commands. All rectangles are one path, so that no seams show between neighbours."""
        left, top, right, bottom = self.black.T
        areas = np.stack([left, top, right - left, bottom - top], -1)
        commands = [f"{_POINTS:.9f} 0 0 {-_POINTS:.9f} 0 {self.height * _POINTS:.4f} cm", "0 g"]
        commands += [" ".join(f"{value:.6f}" for value in area) + " re" for area in areas]
        commands += ["f"] if len(areas) else []
        for line in self.lines:
            escaped = line.text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
            commands.append(f"BT /F {line.size:g} Tf 1 0 0 -1 {line.left:.4f} {line.baseline:.4f} Tm ({escaped}) Tj ET")
        return "\n".join(commands).encode("ascii")

    def png(self, pixels_per_mm: float) -> bytes:
        """A PNG file that states its resolution; edges of rectangles are rounded to whole pixels."""
        size = round(self.width * pixels_per_mm), round(self.height * pixels_per_mm)
        image = np.full(size[::-1], 255, dtype=np.uint8)
        for left, top, right, bottom in np.rint(self.black * pixels_per_mm).astype(np.int64):
            image[top:bottom, left:right] = 0
        picture = Image.fromarray(image)
        draw = ImageDraw.Draw(picture)
        for line in self.lines:
            font = ImageFont.load_default(line.size * pixels_per_mm)
            draw.text((line.left * pixels_per_mm, line.baseline * pixels_per_mm), line.text, 0, font, anchor="ls")
        buffer = io.BytesIO()
        picture.save(buffer, "PNG", dpi=(pixels_per_mm * 25.4, pixels_per_mm * 25.4))
        return buffer.getvalue()


def _stream(content: bytes) -> bytes:
    packed = zlib.compress(content)
    return b"<< /Length %d /Filter /FlateDecode >>\nstream\n%b\nendstream" % (len(packed), packed)
