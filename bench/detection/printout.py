"""A patch on paper: a page with marks around it, as a PDF that says its size and its colours."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.colour import linear, srgb
from cavbench.detection.printing import LEAST, MOST

PROFILE = "sRGB IEC61966-2.1"
"""The colour profile in the PDF: the printer's driver converts from it."""
MARK, GAP = 1 / 8, 1 / 32
"""Side of a mark and white space around it, as shares of the patch's side."""
WHOLE = 1 + 2 * (MARK + 2 * GAP)
"""Side of the page with the marks."""
MODULES = 6
"""A mark has so many squares along its side."""
NOTE_MM = 8.0
"""Height of the line of text below."""
LEAST_MM, MOST_MM = 20.0, 3000.0
POINTS_MM = 72 / 25.4

Picture = NDArray[np.uint8]


@dataclass(frozen=True)
class Part:
    """A picture [h, w, 3] on the page, of squares; its upper left corner and its side are shares of the patch's side."""

    picture: Picture
    x: float
    y: float
    side: float


def dictionary() -> cv2.aruco.Dictionary:
    """The marks: ArUco (Garrido-Jurado et al. 2014), numbers 0 to 3 clockwise from the upper left."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)


def places() -> tuple[tuple[float, float], ...]:
    """Upper left corners of the four marks, as shares of the patch's side."""
    far = WHOLE - GAP - MARK
    return (GAP, GAP), (far, GAP), (far, far), (GAP, far)


def on_page(texels: Tensor) -> Tensor:
    """The colours to print, sRGB, so that the paper reflects the texels [..., 3, P, P], sRGB, or the nearest that it can.

    White is paper, which reflects `MOST`, and black is the ink, which reflects `LEAST`: what lies between is stretched.
    """
    return srgb(((linear(texels) - LEAST) / (MOST - LEAST)).clamp(0, 1))


def parts(texels: Tensor) -> list[Part]:
    """The patch [3, P, P] and its marks."""
    coded = (on_page(texels) * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().numpy()
    inset = MARK + 2 * GAP
    found = [Part(coded, inset, inset, 1.0)]
    for number, (x, y) in enumerate(places()):
        mark = cv2.aruco.generateImageMarker(dictionary(), number, MODULES)
        found.append(Part(np.repeat(mark[..., None], 3, 2), x, y, MARK))
    return found


def raster(texels: Tensor, side: int) -> Picture:
    """The page as a picture [W, W, 3], as a scanner sees it; the patch has about `side` pixels."""
    width = round(WHOLE * side)
    page = np.full((width, width, 3), 255, np.uint8)
    for part in parts(texels):
        size = round(part.side * side)
        x, y = round(part.x * side), round(part.y * side)
        page[y : y + size, x : x + size] = cv2.resize(part.picture, (size, size), interpolation=cv2.INTER_NEAREST)
    return page


def pdf(texels: Tensor, side_mm: float, note: str) -> bytes:
    """The page as a PDF.

    Args:
        texels: sRGB [3, P, P].
        side_mm: side of the patch on paper.
        note: a line of text below it, in ASCII.
    """
    scale = side_mm * POINTS_MM
    width, height = WHOLE * scale, WHOLE * scale + NOTE_MM * POINTS_MM
    images, drawn = [], []
    for number, part in enumerate(parts(texels)):
        rows, columns, _ = part.picture.shape
        images.append(
            _stream(
                f"/Type /XObject /Subtype /Image /Width {columns} /Height {rows} /BitsPerComponent 8 "
                "/ColorSpace [/ICCBased 5 0 R] /Interpolate false",
                part.picture.tobytes(),
            )
        )
        side, x = part.side * scale, part.x * scale
        drawn.append(f"q {side:.4f} 0 0 {side:.4f} {x:.4f} {height - part.y * scale - side:.4f} cm /P{number} Do Q")
    text = "".join(f"\\{letter}" if letter in "()\\" else letter for letter in note if " " <= letter <= "~")
    drawn.append(f"BT /F 7 Tf {GAP * scale:.2f} {NOTE_MM * POINTS_MM / 2:.2f} Td ({text}) Tj ET")
    first = 7
    listed = " ".join(f"/P{number} {first + number} 0 R" for number in range(len(images)))
    bodies = [
        b"<< /Type /Catalog /Pages 2 0 R /OutputIntents [<< /Type /OutputIntent /S /GTS_PDFX "
        + f"/OutputConditionIdentifier ({PROFILE}) /DestOutputProfile 5 0 R >>] >>".encode(),
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 4 0 R "
        f"/Resources << /XObject << {listed} >> /Font << /F 6 0 R >> >> >>".encode(),
        _stream("", "\n".join(drawn).encode()),
        _stream("/N 3 /Alternate /DeviceRGB", _profile()),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        *images,
    ]
    return _document(bodies)


@cache
def _profile() -> bytes:
    """The ICC profile of sRGB."""
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def _stream(entries: str, content: bytes) -> bytes:
    packed = zlib.compress(content, 9)
    head = f"<< {entries} /Filter /FlateDecode /Length {len(packed)} >>\nstream\n"
    return head.encode() + packed + b"\nendstream"


def _document(bodies: list[bytes]) -> bytes:
    """A PDF 1.7 of numbered objects, the first of which is the catalogue."""
    found, places = bytearray(b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n"), []
    for number, body in enumerate(bodies, 1):
        places.append(len(found))
        found += f"{number} 0 obj\n".encode() + body + b"\nendobj\n"
    start = len(found)
    found += f"xref\n0 {len(bodies) + 1}\n0000000000 65535 f \n".encode()
    found += b"".join(f"{place:010d} 00000 n \n".encode() for place in places)
    return bytes(found) + f"trailer\n<< /Size {len(bodies) + 1} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n".encode()
