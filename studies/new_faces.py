"""Measures what detectors say of signs that are neither scored nor in any training: real traffic signs, and red octagons.

    python studies/new_faces.py [--victims yolov3_tiny rcnn] [--defenses none advtrain_detection] [--lanes 3] [--picture FILE]

For each face: the mean confidence at the place of the sign, and in brackets the false stops a frame. The frames are those that
are scored, each with the face in the place of the stop sign. The last two faces are red octagons with a white rim, without the
word STOP: what an honest detector should say of these is open, since a patch may hide the word.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.core import registry
from cavbench.detection import Detector, Scenes
from cavbench.detection.colour import linear
from cavbench.detection.sight import look_at_decoys
from cavbench.envs.camera import sign
from cavbench.envs.camera.bank import BankScenes
from cavbench.envs.camera.faces import Face
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD = StopSignApproach()
SIDE = sign.TEXELS
MIDDLE = (SIDE // 2, SIDE // 2)
Image = NDArray[np.uint8]
RED, WHITE, BLACK, BLUE, YELLOW, GREEN = (
    (190, 15, 25),
    (235, 235, 230),
    (12, 12, 12),
    (20, 70, 160),
    (245, 195, 20),
    (20, 120, 60),
)


def plain(colour: tuple[int, int, int]) -> Image:
    return np.full((SIDE, SIDE, 3), colour, np.uint8)


def polygon(first: float, corners: int, size: float) -> Image:
    """A centred regular polygon [S, S] with its first corner at an angle in degrees; `size` of its circumcircle."""
    angles = np.deg2rad(first + 360 / corners * np.arange(corners))
    points = SIDE / 2 * (1 + size * np.stack([np.cos(angles), np.sin(angles)], 1))
    mask = np.zeros((SIDE, SIDE), np.uint8)
    cv2.fillPoly(mask, [points.round().astype(np.int32)], 255)
    return mask


def written(picture: Image, text: str, height: float, colour: tuple[int, int, int]) -> Image:
    thick = round(0.2 * height * SIDE)
    scale = height * SIDE / cv2.getTextSize("E", cv2.FONT_HERSHEY_DUPLEX, 1.0, 1)[0][1]
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_DUPLEX, scale, thick)
    place = ((SIDE - wide) // 2, (SIDE + high) // 2)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_DUPLEX, scale, colour, thick, cv2.LINE_AA)
    return picture


def no_entry() -> tuple[Image, Image]:
    picture = plain(RED)
    cv2.rectangle(picture, (SIDE // 8, round(0.41 * SIDE)), (SIDE - SIDE // 8, round(0.59 * SIDE)), WHITE, -1)
    return picture, polygon(0, 64, 1)


def no_stopping() -> tuple[Image, Image]:
    picture = plain(BLUE)
    cv2.circle(picture, MIDDLE, round(0.45 * SIDE), RED, round(0.1 * SIDE), cv2.LINE_AA)
    for down in (-1, 1):
        ends = [(round(SIDE * (0.5 + side * 0.3)), round(SIDE * (0.5 + down * side * 0.3))) for side in (-1, 1)]
        cv2.line(picture, ends[0], ends[1], RED, round(0.1 * SIDE), cv2.LINE_AA)
    return picture, polygon(0, 64, 1)


def warning() -> tuple[Image, Image]:
    picture = plain(RED)
    picture[polygon(-90, 3, 0.62) > 0] = WHITE
    return written(picture, "!", 0.26, BLACK), polygon(-90, 3, 1)


def priority() -> tuple[Image, Image]:
    picture = plain(WHITE)
    picture[polygon(0, 4, 0.75) > 0] = YELLOW
    return picture, polygon(0, 4, 1)


def one_way() -> tuple[Image, Image]:
    picture = plain(BLUE)
    arrow = [(0.1, 0.45), (0.6, 0.45), (0.6, 0.35), (0.9, 0.5), (0.6, 0.65), (0.6, 0.55), (0.1, 0.55)]
    cv2.fillPoly(picture, [(np.array(arrow) * SIDE).astype(np.int32)], WHITE)
    cover = np.zeros((SIDE, SIDE), np.uint8)
    cover[SIDE // 4 : -SIDE // 4] = 255
    return picture, cover


def pizza() -> tuple[Image, Image]:
    picture = plain(WHITE)
    picture[:, : SIDE // 3], picture[:, -SIDE // 3 :] = GREEN, RED
    return written(picture, "PIZZA", 0.17, BLACK), octagon()


def rings() -> tuple[Image, Image]:
    picture = plain(RED)
    for size, colour in ((0.72, WHITE), (0.4, RED)):
        picture[polygon(0, 64, size) > 0] = colour
    return picture, octagon()


def go() -> tuple[Image, Image]:
    return written(red()[0], "GO", 0.33, WHITE), octagon()


def red() -> tuple[Image, Image]:
    picture = plain(WHITE)
    picture[polygon(22.5, 8, 0.955 / np.cos(np.pi / 8)) > 0] = RED
    return picture, octagon()


def octagon() -> Image:
    return np.full((SIDE, SIDE), 255, np.uint8)


FACES: dict[str, Callable[[], tuple[Image, Image]]] = {
    "no entry": no_entry,
    "no stopping": no_stopping,
    "warning": warning,
    "priority": priority,
    "one way": one_way,
    "pizza octagon": pizza,
    "ringed octagon": rings,
    "GO, red octagon": go,
    "red octagon": red,
}
"""Colours sRGB [S, S, 3] and where the plate is [S, S], 0 to 255."""


class Carrying(BankScenes):
    """The frames of other scenes, with one face in the place of all decoys."""

    face: Face

    def __init__(self, scenes: Scenes) -> None:
        assert isinstance(scenes, BankScenes)
        super().__init__(list(zip(scenes.poses, scenes.frames, strict=True)), scenes.weathers)

    def developed_decoys(self, frames: Tensor) -> Tensor:
        return torch.stack([self._plate(number).carrying(self.face) for number in frames.tolist()])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--victims", nargs="+", default=["yolov3_tiny"])
    parser.add_argument("--defenses", nargs="+", default=["none", "advtrain_detection"])
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4])
    parser.add_argument("--picture", type=Path, help="PNG of all faces, each in the middle of an approach")
    asked = parser.parse_args()
    settle()
    cells = [WORLD.axes.cell(lanes=n, density=1.0, weather=weather) for n in asked.lanes for weather in asked.weathers]
    approaches = [Carrying(one.scenes) for cell in cells for one in WORLD.approaches(cell, range(len(WORLD.locations)))]
    faces = {name: painted(draw) for name, draw in FACES.items()}
    if asked.picture:
        cv2.imwrite(str(asked.picture), pictured(approaches[0], list(faces.values())))
    print(f"{'':<34}" + "".join(f"{name:>18}" for name in faces))
    for victim in asked.victims:
        for defense in asked.defenses:
            undefended = registry.load("victim", victim)()
            detector = registry.load("defense", defense)().load(undefended, 0, WORLD.facts)
            print(f"{victim + ', ' + defense:<34}", end="", flush=True)
            for face in faces.values():
                sure, stops = said(detector, approaches, face)
                print(f"{f'{sure:.2f} ({stops:.2f})':>18}", end="", flush=True)
            print()


def painted(draw: Callable[[], tuple[Image, Image]]) -> Face:
    picture, cover = (torch.from_numpy(part).float() / 255 for part in draw())
    return Face(linear(picture.permute(2, 0, 1)), cover[None])


def said(detector: Detector, approaches: Sequence[Carrying], face: Face) -> tuple[float, float]:
    """The mean confidence at the place of the sign, and the false stops a frame, if all signs have a face."""
    confidences, stops = [], []
    for scenes in approaches:
        scenes.face = face
        with torch.no_grad():
            seen = look_at_decoys(detector, scenes)
        assert seen is not None
        confidences.extend(seen.confidence)
        stops.extend(len(found.boxes) for found in seen.found)
    return float(np.mean(confidences)), float(np.mean(stops))


def pictured(scenes: Carrying, faces: Sequence[Face]) -> NDArray[np.uint8]:
    """The surroundings of the sign in a frame with each face, side by side, BGR."""
    number = len(scenes) // 2
    x0, y0, x1, y1 = scenes.boxes[number].round().long().tolist()
    margin = (x1 - x0) // 2
    shown = []
    for face in faces:
        scenes.face = face
        image = scenes.render_decoys(torch.tensor([number]))[0]
        part = image[:, y0 - margin : y1 + margin, x0 - margin : x1 + margin]
        shown.append((255 * part.permute(1, 2, 0)).byte().numpy()[..., ::-1])
    return np.concatenate(shown, 1).repeat(3, 0).repeat(3, 1)


if __name__ == "__main__":
    with in_one_line():
        main()
