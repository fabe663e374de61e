"""The film of an approach: its frames without and with the patch, the detected signs, and the confidence over distance."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping

import cv2
import numpy as np
import torch
from torch import Tensor

from cavbench.detection import stopping
from cavbench.detection.approach import Sight, Sighting
from cavbench.detection.recording.blueprint import FPS, outcome, sights
from cavbench.recording import about
from cavbench.recording.film.drawing import BLACK, BLUE, GREEN, GREY, PALE, VERMILLION, Colour, blank, box, line, write
from cavbench.recording.film.film import PAPER, Film, Picture

WIDTH, VIEW = 720, 300
"""Width of the film, and height of a view of the street, in pixels."""
HEADER, TITLE, CHART, AXIS = 36, 28, 90, 40
LEFT, RIGHT = 60, WIDTH - 20
"""Ends of the axis of distances."""
NAMES = {"without_patch": "without a patch", "with_patch": "with the patch"}
COLOURS: dict[str, Colour] = {"without_patch": BLUE, "with_patch": VERMILLION}


class ApproachFilm(Film):
    """The film of one approach, at half of real time.

    Args:
        sighting: the detector's output on it.
        meta: the record's identity columns.
    """

    photographs = True

    def __init__(self, sighting: Sighting, meta: Mapping[str, object]) -> None:
        self.sighting, self.meta, self.fps = sighting, meta, FPS
        self.scenes = sighting.approach.scenes
        self.views = {name: sight for name in NAMES if (sight := sights(sighting).get(name))}
        self.chart_top = HEADER + len(self.views) * (TITLE + VIEW) + 20
        boxes = self.scenes.boxes
        margin = float((boxes[:, 2:] - boxes[:, :2]).max())
        low, high = boxes[:, :2].amin(0) - margin / 2, boxes[:, 2:].amax(0) + margin / 2
        self.scale = min(WIDTH / float(high[0] - low[0]), VIEW / float(high[1] - low[1]))
        self.corner = ((low + high) / 2 - torch.tensor([WIDTH, VIEW]) / 2 / self.scale).tolist()

    def __len__(self) -> int:
        return len(self.scenes)

    def pictures(self, steps: int) -> Iterator[Picture]:
        for step in range(steps):
            yield self._picture(min(step, len(self) - 1))

    def _picture(self, frame: int) -> Picture:
        picture = blank(self.chart_top + CHART + AXIS, WIDTH)
        write(picture, about.title(self.meta), 12, HEADER / 2, size=16)
        write(picture, f"{float(self.scenes.distance[frame]):.0f} m", WIDTH - 16, HEADER / 2, size=16, align="right")
        top = HEADER
        for name, sight in self.views.items():
            said = f"{NAMES[name]}: confidence {float(sight.confidence[frame]):.2f}"
            if frame == len(self) - 1:
                said = f"{NAMES[name]}: {outcome(sight, self.scenes)}"
            write(picture, said, 12, top + TITLE / 2, size=15, colour=COLOURS[name])
            self._street(picture[top + TITLE : top + TITLE + VIEW], name, sight, frame)
            top += TITLE + VIEW
        self._chart(picture, frame)
        return picture

    def _street(self, view: Picture, name: str, sight: Sight, frame: int) -> None:
        """The part of the image that the sign crosses, its true box (green), and the stop signs that the detector finds."""
        texels = self.sighting.texels if name == "with_patch" else None
        patches = texels.unsqueeze(0) if texels is not None else None
        with torch.no_grad():
            image = self.scenes.render(torch.tensor([frame]), patches, self.sighting.share)[0]
        pixels = (255 * image).round().to(torch.uint8).permute(1, 2, 0).numpy()
        shift = [-self.scale * place for place in self.corner]
        matrix = np.array([[self.scale, 0, shift[0]], [0, self.scale, shift[1]]])
        view[:] = cv2.warpAffine(pixels, matrix, (WIDTH, VIEW), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        self._box(view, self.scenes.boxes[frame], GREEN)
        for found, score in zip(sight.found[frame].boxes, sight.found[frame].scores, strict=True):
            x, y = self._box(view, found, COLOURS[name])
            y = max(y - 10, 10)
            box(view, x, y, (18, 9), COLOURS[name])
            write(view, f"{float(score):.2f}", x, y, size=15, colour=PAPER, align="centre")

    def _box(self, view: Picture, corners: Tensor, colour: Colour) -> tuple[float, float]:
        """An outline; returns the middle of its upper edge, in pixels of the view."""
        places = [self.scale * (float(value) - self.corner[n % 2]) for n, value in enumerate(corners)]
        half = ((places[2] - places[0]) / 2, (places[3] - places[1]) / 2)
        x, y = places[0] + half[0], places[1] + half[1]
        box(view, x, y, half, colour, 2)
        return x, places[1]

    def _chart(self, picture: Picture, frame: int) -> None:
        """Confidence in the sign over distance, up to this frame; the grey line is the threshold of a detection."""
        bottom, distance = self.chart_top + CHART, self.scenes.distance.double().numpy()
        far, near = float(distance.max()), float(distance.min())

        def place(at: float, confidence: float) -> tuple[float, float]:
            return LEFT + (RIGHT - LEFT) * (far - at) / max(far - near, 1e-9), bottom - CHART * confidence

        for level, colour in ((0.0, PALE), (1.0, PALE), (stopping.THRESHOLD, GREY)):
            line(picture, (LEFT, place(far, level)[1]), (RIGHT, place(far, level)[1]), colour)
            write(picture, f"{level:g}", LEFT - 8, place(far, level)[1], size=13, colour=GREY, align="right")
        for at in distance:
            write(picture, f"{at:.0f} m", place(at, 0)[0], bottom + 16, size=13, colour=GREY, align="centre")
        for name, sight in self.views.items():
            points = [place(at, float(value)) for at, value in zip(distance, sight.confidence, strict=True)][
                : frame + 1
            ]
            for start, end in itertools.pairwise(points):
                line(picture, start, end, COLOURS[name], 2)
            for x, y in points:
                box(picture, x, y, (3, 3), COLOURS[name])
        line(picture, place(distance[frame], 0), place(distance[frame], 1), BLACK)
