"""A patch read back from a scan or a photograph of its page: found by the marks, made square, its light made that of paper."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import printout
from cavbench.detection.colour import linear, srgb
from cavbench.detection.printing import LEAST, MOST
from cavbench.errors import UserError

if TYPE_CHECKING:
    from PIL.Image import Image

LARGEST_BYTES, LARGEST_PIXELS = 200_000_000, 150_000_000
"""Of a picture that is read."""
FLAT = 0.005
"""How far the corners of the marks may be from those of a flat page, as a share of the patch's side."""
PER_TEXEL = 6
"""Pixels along the side of a texel after the page is made square; the outer sixth on each side is left out."""


def opened(path: Path) -> NDArray[np.uint8]:
    """A picture [H, W, 3], turned as its camera says, in sRGB: converted from its colour profile, if it has one.

    Raises:
        UserError: if there is none, it is too large, or cannot be decoded.
    """
    if not path.is_file():
        raise UserError(f"there is no picture {path}")
    if path.stat().st_size > LARGEST_BYTES:
        raise UserError(f"{path} has {path.stat().st_size / 1e6:.0f} MB, at most {LARGEST_BYTES / 1e6:.0f} are read")
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with Image.open(path, formats=("PNG", "JPEG", "TIFF", "BMP", "WEBP")) as image:
            if image.width * image.height > LARGEST_PIXELS:
                raise UserError(f"{path} has {image.width} x {image.height} pixels, at most 150 million are read")
            return np.asarray(_in_srgb(ImageOps.exif_transpose(image), path))
    except UserError:
        raise
    # The decoders raise anything for a truncated or forged file.
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, ValueError, SyntaxError, EOFError) as error:
        raise UserError(f"cannot read the picture {path}: {str(error).splitlines()[0][:200]}") from None


def _in_srgb(image: Image, path: Path) -> Image:
    """A picture in RGB, of sRGB: telephones and scanners write wider gamuts. Without a profile its numbers count as sRGB."""
    from PIL import ImageCms

    profile = image.info.get("icc_profile")
    if not profile:
        return image.convert("RGB")
    if image.mode not in ("L", "RGB", "RGBA", "CMYK"):
        image = image.convert("L" if image.mode == "LA" else "RGB")
    try:
        own = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        found = ImageCms.profileToProfile(image, own, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        found = None
    if found is None:
        raise UserError(f"{path} has a colour profile that cannot be read: save it in sRGB")
    return found


def read(picture: NDArray[np.uint8], texels: int) -> Tensor:
    """The patch [3, P, P], sRGB, on a picture [H, W, 3] of its page.

    The light of the page is made that of the model of printing: paper reflects `MOST`, the black of the marks `LEAST`.

    Args:
        picture: a scan or photograph that shows all four marks.
        texels: side of the patch in texels, P.

    Raises:
        UserError: if it does not show the marks, or they are not those of a flat page seen from the front.
    """
    there = _marks(picture)
    side = texels * PER_TEXEL
    # Coordinates are 0 in the middle of the first pixel, half a pixel inside the edge of the page.
    onto = np.concatenate([_corners(x, y, printout.MARK) for x, y in printout.places()]) * side - 0.5
    matrix, _ = cv2.findHomography(there, onto, 0)
    if matrix is None or float(np.abs(_through(np.asarray(matrix, np.float64), there) - onto).max()) > FLAT * side:
        raise UserError("the marks in the picture are not those of a flat page: scan it again, flat and whole")
    size = round(printout.WHOLE * side)
    page = cv2.warpPerspective(picture, matrix, (size, size), flags=cv2.INTER_LINEAR)
    light = linear(torch.from_numpy(page).permute(2, 0, 1) / 255)
    light = LEAST + (MOST - LEAST) * _between(light, *_paper_and_black(light, side))
    first = round((printout.MARK + 2 * printout.GAP) * side)
    cells = light[:, first : first + side, first : first + side].unflatten(1, (texels, PER_TEXEL))
    cells = cells.unflatten(3, (texels, PER_TEXEL))[:, :, 1:-1, :, 1:-1]
    return srgb(cells.mean((2, 4)).clamp(0, 1))


def _marks(picture: NDArray[np.uint8]) -> NDArray[np.float64]:
    """[16, 2] the corners of the four marks in pixels, in the order of their numbers."""
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    corners, numbers, _ = cv2.aruco.ArucoDetector(printout.dictionary(), settings).detectMarkers(grey)
    given = [] if numbers is None else [int(number) for number in np.ravel(numbers)]
    if missing := [name for number, name in enumerate(NAMES) if given.count(number) != 1]:
        raise UserError(
            f"the picture does not show the mark at the {missing[0]} once: it must show the whole page of `bench patch print`"
        )
    by_number = {number: np.asarray(one, np.float64).reshape(4, 2) for number, one in zip(given, corners, strict=True)}
    return np.concatenate([by_number[number] for number in range(4)])


NAMES = ("upper left", "upper right", "lower right", "lower left")


def _corners(x: float, y: float, side: float) -> NDArray[np.float64]:
    return np.array([(x, y), (x + side, y), (x + side, y + side), (x, y + side)])


def _through(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.perspectiveTransform(points[None], matrix)[0], np.float64)


def _paper_and_black(light: Tensor, side: int) -> tuple[Tensor, Tensor]:
    """[3, 1, 1] the light of paper and of the black of the marks: medians of the white and black squares."""
    white: list[Tensor] = []
    black: list[Tensor] = []
    for number, (x, y) in enumerate(printout.places()):
        bits = cv2.aruco.generateImageMarker(printout.dictionary(), number, printout.MODULES) > 0
        step = printout.MARK * side / printout.MODULES
        for row in range(printout.MODULES):
            for column in range(printout.MODULES):
                at = [int(start * side + (place + 0.5) * step) for start, place in ((y, row), (x, column))]
                (white if bits[row, column] else black).append(light[:, at[0], at[1]])
    found = [torch.stack(colours).median(0).values.view(3, 1, 1) for colours in (white, black)]
    if bool((found[0] - found[1] < 0.1).any()):
        raise UserError("black and white of the marks are alike in the picture: scan it in colour and with more light")
    return found[0], found[1]


def _between(light: Tensor, white: Tensor, black: Tensor) -> Tensor:
    return (light - black) / (white - black)
