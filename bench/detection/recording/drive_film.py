"""The film of a drive in closed loop: the camera's image with the detected signs beside the road from above."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.detection.approach import Sighting
from cavbench.detection.closed_loop import Drive, Drives, Moment
from cavbench.detection.recording.film import COLOURS, NAMES
from cavbench.recording import about
from cavbench.recording.film.drawing import BLACK, GREEN, GREY, ORANGE, PALE, ROAD, Colour, blank, box, line, write
from cavbench.recording.film.film import PAPER, Film, Picture

CAMERA = 760
"""Width of the camera's image in the film, in pixels."""
INSET, MARGIN = 110, 1.0
"""Side of the enlarged sign in pixels, and the space around the sign as a share of its width."""
BEHIND_M, BEYOND_M, SCALE = 66.0, 16.0, 6.5
"""Metres of road before and beyond the line that are seen from above, and pixels a metre; the car drives to the right."""
HEADER, TITLE, GAP = 36, 28, 8


class DriveFilm(Film):
    """The drives of one approach, without and with the patch, one below the other, in real time. A collision ends a drive.

    Args:
        sighting: the approach.
        drives: its drives.
        meta: the record's identity columns.
    """

    photographs = True

    def __init__(self, sighting: Sighting, drives: Drives, meta: Mapping[str, object]) -> None:
        self.sighting, self.drives, self.meta = sighting, drives, meta
        self.scenes = sighting.approach.scenes
        self.fps = 1 / drives.shown.step_s
        self.rows = {"without_patch": drives.shown} if drives.clean is None else {}
        if drives.clean is not None:
            self.rows = {"without_patch": drives.clean, "with_patch": drives.shown}
        self.view = round(CAMERA * self.scenes.size[0] / self.scenes.size[1])
        self._image = lru_cache(maxsize=4)(self._rendered)

    def __len__(self) -> int:
        return max(self._last(drive) for drive in self.rows.values()) + 1

    def _last(self, drive: Drive) -> int:
        """The step at which a drive ends: its collision, or its last."""
        hits = [moment.hit[self.drives.draw] for moment in drive.moments]
        return hits.index(True) if any(hits) else len(hits) - 1

    def pictures(self, steps: int) -> Iterator[Picture]:
        for step in range(steps):
            yield self._picture(step)

    def _picture(self, step: int) -> Picture:
        wide = CAMERA + GAP + round((BEHIND_M + BEYOND_M) * SCALE)
        picture = blank(HEADER + len(self.rows) * (TITLE + self.view + GAP), wide)
        write(picture, about.title(self.meta), 12, HEADER / 2, size=16)
        write(picture, f"{step / self.fps:.1f} s", wide - 12, HEADER / 2, size=16, align="right")
        top = HEADER
        for name, drive in self.rows.items():
            last = self._last(drive)
            moment = drive.moments[min(step, last)]
            said = self._outcome(drive, moment) if step >= last else _said(moment)
            write(picture, f"{NAMES[name]}: {said}", 12, top + TITLE / 2, size=15, colour=COLOURS[name])
            below = picture[top + TITLE : top + TITLE + self.view]
            self._camera(below[:, :CAMERA], name, moment)
            self._road(below[:, CAMERA + GAP :], name, moment)
            top += TITLE + self.view + GAP
        return picture

    def _outcome(self, drive: Drive, moment: Moment) -> str:
        """How a drive ended, as text."""
        seen = f"confirmed at {drive.confirmed_m:.1f} m" if drive.confirmed_m else "never confirmed"
        seen += f", something else at {drive.false_m:.1f} m" if drive.false_m else ""
        if moment.hit[self.drives.draw]:
            does = f"the car collides at {moment.speed_mps:.1f} m/s"
        elif not drive.stands:
            does = "the car crosses without stopping"
        else:
            does = f"the car stops {_at(moment)}"
        return f"the sign is {seen}, {does}"

    def _camera(self, view: Picture, name: str, moment: Moment) -> None:
        """The image that the detector saw, with the sign's true place (green) and the stop signs that it found."""
        pixels = self._image(name, moment.frame)
        height, width = view.shape[:2]
        view[:] = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
        scale = CAMERA / self.scenes.size[1]
        true = self.scenes.boxes[moment.frame]
        _outline(view, true, scale, GREEN)
        for found, score in zip(moment.found.boxes, moment.found.scores, strict=True):
            x, y = _outline(view, found, scale, COLOURS[name])
            box(view, x, y - 10, (18, 9), COLOURS[name])
            write(view, f"{float(score):.2f}", x, y - 10, size=15, colour=PAPER, align="centre")
        view[:INSET, :INSET] = _enlarged(pixels, true)
        box(view, INSET / 2, INSET / 2, (INSET / 2, INSET / 2), COLOURS[name], 2)
        nearest = float(self.scenes.distance.min())
        if moment.distance_m < nearest - 0.5:
            said = f"the last image, {nearest:.0f} m before the sign"
            write(view, said, width - 10, height - 14, colour=BLACK, align="right")

    def _rendered(self, name: str, frame: int) -> Picture:
        texels = self.sighting.texels if name == "with_patch" else None
        patches = texels.unsqueeze(0) if texels is not None else None
        with torch.no_grad():
            image = self.scenes.render(torch.tensor([frame]), patches, self.sighting.share)[0]
        return (255 * image).round().to(torch.uint8).permute(1, 2, 0).numpy()

    def _road(self, view: Picture, name: str, moment: Moment) -> None:
        """The road from above: waiting vehicles (grey), the cross traffic (orange), the sign and the car."""
        plan = self.drives.plan
        view[:] = PAPER
        for road in plan.roads:
            _rectangle(view, road, ROAD)
        for painted in plan.lines:
            _rectangle(view, painted, GREY)
        for waiting in plan.waiting:
            _rectangle(view, waiting, GREY)
        for other in moment.others[self.drives.draw]:
            _rectangle(view, other, ORANGE)
        length, width = plan.car
        front = -moment.distance_m
        _rectangle(view, np.array([-width / 2, front - length, width / 2, front]), COLOURS[name])
        if moment.hit[self.drives.draw]:
            _cross(view, *_place(view, 0.0, front))
        x, y = _place(view, *plan.sign)
        box(view, x, y, (4, 4), (200, 20, 30))
        box(view, view.shape[1] / 2, view.shape[0] / 2, (view.shape[1] / 2 - 1, view.shape[0] / 2 - 1), PALE, 1)


def _place(view: Picture, x: float, y: float) -> tuple[float, float]:
    """Column and row of a point of the road in m; the middle of the car's lane is in the middle of the view."""
    return (y + BEHIND_M) * SCALE, view.shape[0] / 2 + x * SCALE


def _rectangle(view: Picture, rectangle: NDArray[np.float64], colour: Colour) -> None:
    x0, y0, x1, y1 = rectangle
    (left, top), (right, bottom) = _place(view, x0, y0), _place(view, x1, y1)
    # OpenCV's coordinates are bounded: roads go on for hundreds of metres.
    left, right = np.clip([left, right], -50, view.shape[1] + 50)
    top, bottom = np.clip([top, bottom], -50, view.shape[0] + 50)
    box(view, (left + right) / 2, (top + bottom) / 2, ((right - left) / 2, (bottom - top) / 2), colour)


def _cross(view: Picture, x: float, y: float) -> None:
    for across in (-1, 1):
        line(view, (x - 10, y - 10 * across), (x + 10, y + 10 * across), BLACK, 4)


def _outline(view: Picture, corners: Tensor, scale: float, colour: Colour) -> tuple[float, float]:
    """Draw a box; return the middle of its upper edge."""
    x0, y0, x1, y1 = (scale * float(value) for value in corners)
    box(view, (x0 + x1) / 2, (y0 + y1) / 2, ((x1 - x0) / 2, (y1 - y0) / 2), colour, 2)
    return (x0 + x1) / 2, y0


def _enlarged(pixels: Picture, true: Tensor) -> Picture:
    """The surroundings of the sign, enlarged."""
    x0, y0, x1, y1 = (float(value) for value in true)
    side = max(x1 - x0, y1 - y0, 1.0) * (1 + MARGIN)
    scale = INSET / side
    matrix = np.array([[scale, 0, INSET / 2 - scale * (x0 + x1) / 2], [0, scale, INSET / 2 - scale * (y0 + y1) / 2]])
    near = cv2.warpAffine(pixels, matrix, (INSET, INSET), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return near.astype(np.uint8)


def _said(moment: Moment) -> str:
    """What happens at a step, as text."""
    does = "brakes" if moment.asked else "confirmed" if moment.confirmed else "drives on"
    return f"confidence {moment.confidence:.2f}, {does}, {moment.speed_mps:.1f} m/s, {_at(moment)}"


def _at(moment: Moment) -> str:
    if abs(moment.distance_m) < 0.05:
        return "at the line"
    return f"{abs(moment.distance_m):.1f} m {'before' if moment.distance_m >= 0 else 'beyond'} the line"
