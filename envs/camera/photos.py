"""Photographs of one's own: a stop sign in each, whose corners are given; patches are put on it in its light and perspective."""

from __future__ import annotations

import csv
import hashlib
import io
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, ClassVar

import cv2
import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection import Approach, CameraWorld, Scenes
from cavbench.detection.mount import Mount
from cavbench.detection.scanned import opened
from cavbench.envs.camera import develop, sign
from cavbench.envs.camera.objects import NAMES
from cavbench.envs.camera.photos_axes import AXES, PHOTOS_V1
from cavbench.envs.camera.plate import Box, detail, filtered, texture_mean, wholly_sign
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import UserError
from cavbench.scenarios import Axes, Cell

LIST = "signs.csv"
CORNERS = tuple(f"{axis}{number}" for number in range(1, 9) for axis in "xy")
_EDGE = math.tan(math.pi / 8) / 2
OCTAGON = np.array(
    [
        (0.5 - _EDGE, 0), (0.5 + _EDGE, 0), (1, 0.5 - _EDGE), (1, 0.5 + _EDGE),
        (0.5 + _EDGE, 1), (0.5 - _EDGE, 1), (0, 0.5 + _EDGE), (0, 0.5 - _EDGE),
    ]
)  # fmt: skip
"""The corners on the bounding square of the sign, clockwise from the upper left end of the upper edge."""
MOST_PICTURES, MOST_BYTES = 100, 1_000_000
LEAST_PIXELS = 12.0
"""Width of a sign that can be scored."""
OFF = 0.06
"""How far the corners may be from those of a flat octagon in perspective, as a share of the sign's width."""
BETTER = 0.75
"""The corners begin at a wrong one if, from another one on, what the sign leaves unexplained is less than this share."""
STRIDE = 32


@dataclass(frozen=True, eq=False)
class Photo:
    """A picture with a sign.

    Args:
        picture: uint8 [3, H, W].
        crop: box around the sign.
        face_from_pixel: homography [3, 3].
        black: float32 [3, 1, 1] light that the sign would have in the picture if it were black.
        gain: float32 [3, h, w] on the crop, what is added to it for each reflectance.
        box: x0, y0, x1, y1 of the sign in pixels.
    """

    picture: Tensor
    crop: Box
    face_from_pixel: NDArray[np.float64]
    black: Tensor
    gain: Tensor
    box: tuple[float, float, float, float]

    def patched(self, face: Tensor, cover: Tensor) -> Tensor:
        """The picture [3, H, W] in [0, 1] with a face [3, S, S] where the cover [1, S, S] of a patch is; differentiable in it."""
        x0, y0, x1, y1 = self.crop
        shown = develop.tone(self.black + self.gain * texture_mean(self.crop, face, self.face_from_pixel))
        there = texture_mean(self.crop, cover, self.face_from_pixel) > 1e-3
        picture = self.picture / 255
        picture[:, y0:y1, x0:x1] = torch.where(there, shown, picture[:, y0:y1, x0:x1])
        return picture


class PhotoScenes(Scenes):
    """Photographs, the smallest sign first.

    Args:
        photos: pictures of the same size.
        distance: [M] of each, in m.
    """

    def __init__(self, photos: list[Photo], distance: Tensor) -> None:
        self.photos = photos
        height, width = photos[0].picture.shape[1:]
        self.size, self.distance = (height, width), distance
        self.boxes = torch.tensor([photo.box for photo in photos])
        self.visible = torch.ones(len(photos))

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        shown = []
        cover = Mount().cover(share, sign.TEXELS)[None]
        faces = None if patches is None else sign.painted(patches, share)
        for place, number in enumerate(frames.tolist()):
            photo = self.photos[number]
            if faces is None:
                shown.append(photo.picture / 255)
                continue
            side = detail(photo.crop)
            face = filtered(faces[place % len(faces)][None], side)[0]
            shown.append(photo.patched(face, filtered(cover, side)[0]))
        return torch.stack(shown)

    def reach(self, share: float) -> Tensor:
        left, top, right, bottom = Mount().bounds(share)
        edges = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
        found = []
        for photo in self.photos:
            seen = _through(np.asarray(np.linalg.inv(photo.face_from_pixel), np.float64), edges)
            # A pixel counts as covered by any part of a texel; textures are filtered over one more.
            found.append([*(np.floor(seen.min(0)) - 2), *(np.ceil(seen.max(0)) + 2)])
        height, width = self.size
        return (
            torch.tensor(np.array(found), dtype=torch.float32).clamp(min=0).minimum(torch.tensor([width, height] * 2))
        )


@dataclass(frozen=True, kw_only=True)
class StopSignPhotos(CameraWorld):
    """One approach of the pictures of a folder, the smallest sign first. Patches are crafted on the frames of `camera`.

    Args:
        path: the folder. Its `signs.csv` has a line for each picture: its name, and the corners of the sign in pixels, `x1,y1` to
            `x8,y8`, clockwise from the left end of the upper edge.
        side: the longer side of the pictures in pixels, to which they are scaled (default 1280).
        field_of_view: horizontal angle that the camera sees, in degrees, for the distances (default 66).
        sha256: of list and pictures; filled in, so that records name what was shown. Another one is refused.
    """

    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = PHOTOS_V1.name
    locations: ClassVar[tuple[str, ...]] = ("photos",)
    classes: ClassVar[tuple[str, ...]] = NAMES

    path: str = ""
    side: Annotated[int, Interval(ge=320, le=4096)] = 1280
    field_of_view: Annotated[float, Interval(ge=5, le=150)] = 66.0
    sha256: str = ""

    def __post_init__(self) -> None:
        if not self.path:
            return
        try:
            found = _digest(Path(self.path).expanduser())
        except UserError as error:
            raise ValueError(str(error)) from None
        if self.sha256 not in ("", found):
            raise ValueError(
                f"{self.path} has other pictures than world.sha256={self.sha256[:12]} says: they have {found[:12]}"
            )
        object.__setattr__(self, "sha256", found)

    def training_scenes(self) -> Scenes:
        """Those of the world `camera`."""
        return StopSignApproach().training_scenes()

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        if not self.path:
            raise UserError(f"world photos needs world.path=FOLDER, a folder of pictures with {LIST}")
        scenes = _scenes(Path(self.path).expanduser(), self.side, self.field_of_view, self.sha256)
        return [Approach(seed=seed, location=self.locations[0], scenes=scenes) for seed in seeds]

    def scenarios(self, cell: Cell) -> int | None:
        """See `World.scenarios`."""
        return 1

    def doubts(self, cells: object) -> tuple[str, ...]:
        # It is called before anything is driven, so bad pictures are named then.
        self.approaches(AXES.cell(light="as_taken"), range(1))
        return ()


def _digest(folder: Path) -> str:
    """sha256 of the list and of the pictures in it."""
    found = hashlib.sha256(_list(folder).encode())
    for name, _ in _rows(folder):
        if not (folder / name).is_file():
            raise UserError(f"there is no picture {folder / name}, which {LIST} names")
        with (folder / name).open("rb") as file:
            found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()


def _list(folder: Path) -> str:
    path = folder / LIST
    if not path.is_file():
        raise UserError(f"there is no {path}: a line for each picture, with the header picture,{','.join(CORNERS)}")
    if path.stat().st_size > MOST_BYTES:
        raise UserError(f"{path} is too large: at most {MOST_PICTURES} pictures")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise UserError(f"{path} is no text in UTF-8") from None


def _rows(folder: Path) -> list[tuple[str, NDArray[np.float64]]]:
    """Names of pictures with the corners [8, 2] of their signs."""
    reader = csv.DictReader(io.StringIO(_list(folder)))
    if missing := [name for name in ("picture", *CORNERS) if name not in (reader.fieldnames or ())]:
        raise UserError(f"{folder / LIST} has no column {missing[0]}: its header is picture,{','.join(CORNERS)}")
    found = []
    for number, row in enumerate(reader, 2):
        where = f"{folder / LIST}, line {number}"
        name = row["picture"] or ""
        if not name or Path(name).name != name:
            raise UserError(f"{where}: picture must be the name of a file in the folder, got {name[:60]!r}")
        try:
            corners = np.array([float(row[key]) for key in CORNERS]).reshape(8, 2)
        except (TypeError, ValueError):
            raise UserError(f"{where}: x1 to y8 must be sixteen numbers") from None
        if not np.isfinite(corners).all():
            raise UserError(f"{where}: a corner is not finite")
        found.append((name, corners))
    if not 1 <= len(found) <= MOST_PICTURES:
        raise UserError(f"{folder / LIST} has {len(found)} pictures, from 1 to {MOST_PICTURES} can be read")
    return found


@lru_cache(maxsize=2)
def _scenes(folder: Path, side: int, field_of_view: float, sha256: str) -> PhotoScenes:
    opened_ones = [_opened(folder / name, corners, side) for name, corners in _rows(folder)]
    height, width = (max(picture.shape[axis] for picture, _, _ in opened_ones) for axis in (0, 1))
    height, width = (-(-each // STRIDE) * STRIDE for each in (height, width))
    photos, distances = [], []
    for picture, corners, name in opened_ones:
        # Smaller pictures are continued with grey, below and to the right.
        whole = np.full((height, width, 3), 128, np.uint8)
        whole[: picture.shape[0], : picture.shape[1]] = picture
        photo = _lit(whole, corners, name)
        photos.append(photo)
        focal = picture.shape[1] / 2 / math.tan(math.radians(field_of_view) / 2)
        distances.append(sign.SIZE_M * focal / max(photo.box[2] - photo.box[0], photo.box[3] - photo.box[1]))
    order = sorted(range(len(photos)), key=lambda number: -distances[number])
    there: list[float] = []
    for number in order:
        # Of two signs of the same size one counts as a little nearer.
        there.append(min(distances[number], there[-1] - 0.001) if there else distances[number])
    return PhotoScenes([photos[number] for number in order], torch.tensor(there, dtype=torch.float32))


def _opened(path: Path, corners: NDArray[np.float64], side: int) -> tuple[NDArray[np.uint8], NDArray[np.float64], Path]:
    """A picture scaled to its longer side, with the corners in its pixels."""
    picture = opened(path)
    height, width, _ = picture.shape
    outside = (corners < 0).any() or (corners > (width, height)).any()
    if outside:
        raise UserError(f"{path}: a corner of the sign is outside the picture of {width} x {height} pixels")
    following = np.roll(corners, -1, 0) - corners
    turns = following[:, 0] * np.roll(following[:, 1], -1) - following[:, 1] * np.roll(following[:, 0], -1)
    if not (turns > 0).all():
        raise UserError(
            f"{path}: the corners must go round the sign clockwise, without a dent, from the upper left one"
        )
    factor = side / max(height, width)
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    how = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    scaled = np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)
    return scaled, corners * (size[0] / width, size[1] / height), path


def _lit(picture: NDArray[np.uint8], corners: NDArray[np.float64], path: Path) -> Photo:
    """The sign with its perspective and its light.

    In linear light a pixel is black + gain * reflectance. Both are fitted to the red and white that are known to be there. The
    gain varies over the sign as the picture does beside it.

    Raises:
        UserError: if it is too small, no flat octagon, or no red sign with white letters.
    """
    x0, y0 = np.floor(corners.min(0)).astype(int)
    x1, y1 = np.ceil(corners.max(0)).astype(int)
    if min(x1 - x0, y1 - y0) < LEAST_PIXELS:
        raise UserError(
            f"{path}: the sign is {min(x1 - x0, y1 - y0)} pixels wide at this side, at least {LEAST_PIXELS:g} are needed"
        )
    matrix = _onto_face(corners)
    if float(np.abs(_through(matrix, corners) - OCTAGON).max()) > OFF:
        raise UserError(f"{path}: the corners are not those of a flat octagon in perspective")
    crop = (int(x0), int(y0), int(x1), int(y1))
    planes = torch.from_numpy(picture).permute(2, 0, 1).contiguous()
    light = develop.light_of(planes[:, y0:y1, x0:x1] / 255)
    reflected, inside, black, gain, left = _explained(light, crop, matrix)
    # An octagon fits in eight ways: only the letters say which way the patch is up.
    turned = [_explained(light, crop, _onto_face(np.roll(corners, -first, 0)))[-1] for first in range(1, len(OCTAGON))]
    if min(turned) < BETTER * left:
        first = turned.index(min(turned)) + 2
        raise UserError(
            f"{path}: the letters fit if the corners begin with x{first},y{first}: the left end of the upper edge is x1,y1"
        )
    if min(gain) <= 0.02:
        raise UserError(f"{path}: what is inside the corners is no red sign with white letters")
    levels, slopes = (torch.tensor(each).view(3, 1, 1) for each in (black, gain))
    shade = _shade(light, levels + slopes * reflected, inside)
    box = (*corners.min(0).tolist(), *corners.max(0).tolist())
    return Photo(planes, crop, np.asarray(matrix, np.float64), levels, slopes * shade, box)


def _onto_face(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homography [3, 3] from the corners [8, 2] of a sign to those of its face."""
    fitted, _ = cv2.findHomography(corners, OCTAGON, 0)
    return np.asarray(np.eye(3) if fitted is None else fitted, np.float64)


def _explained(
    light: Tensor, crop: Box, matrix: NDArray[np.float64]
) -> tuple[Tensor, Tensor, tuple[float, ...], tuple[float, ...], float]:
    """The face of the sign on a crop, where it is wholly seen, black and gain of each channel, and the mean light left over."""
    reflected = texture_mean(crop, filtered(sign.painted(None, 1.0), detail(crop))[0], matrix)
    inside = wholly_sign(crop, matrix)
    black, gain = zip(*(_line(reflected[c][inside], light[c][inside]) for c in range(3)), strict=True)
    levels, slopes = (torch.tensor(each).view(3, 1) for each in (black, gain))
    left = float((light[:, inside] - levels - slopes * reflected[:, inside]).abs().mean())
    return reflected, inside, black, gain, left


def _line(reflected: Tensor, light: Tensor) -> tuple[float, float]:
    """Light without reflectance, not below 0, and light for each reflectance: least squares, twice, without what is far off."""
    kept = torch.ones_like(light, dtype=torch.bool)
    black = gain = 0.0
    for _ in range(2):
        x, y = reflected[kept], light[kept]
        spread = ((x - x.mean()) ** 2).mean()
        gain = float(((x - x.mean()) * (y - y.mean())).mean() / spread.clamp(min=1e-8))
        black = float(y.mean() - gain * x.mean())
        if black < 0:
            black, gain = 0.0, float((x * y).sum() / (x * x).sum().clamp(min=1e-8))
        off = (light - black - gain * reflected).abs()
        kept = off <= 3 * off.median().clamp(min=1e-4)
    return black, gain


def _shade(light: Tensor, fitted: Tensor, inside: Tensor) -> Tensor:
    """[1, h, w] how much lighter the sign is in the picture than the fit says, smoothed over a quarter of its width."""
    weight = inside.float().numpy()
    width = max(3.0, light.shape[2] / 4)

    def smooth(values: Tensor) -> NDArray[np.float32]:
        return np.asarray(cv2.GaussianBlur(values.mean(0).numpy() * weight, (0, 0), width), np.float32)

    ratio = (smooth(light) + 1e-4) / (smooth(fitted) + 1e-4)
    return torch.from_numpy(ratio).clamp(0.5, 2.0)[None]


def _through(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.perspectiveTransform(points[None].astype(np.float64), matrix)[0], np.float64)
