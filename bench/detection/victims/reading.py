"""How the network of a detector of others is read: its pixels, boxes, scores and class names."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import ClassVar, get_args

import torch

from cavbench import bounded
from cavbench.core.ranges import Count
from cavbench.detection import STOP_SIGN, DetectorVictim
from cavbench.detection.victims import coco
from cavbench.detection.victims.file_network import Boxes, Input, Order, Output, Scaling
from cavbench.detection.victims.layout import Activation
from cavbench.errors import UserError, short

LARGEST_NAMES = 2**20
"""Most bytes of a file of class names."""
MOST_IMAGES, MOST_PIXELS = 64, 4096
"""The largest fixed batch size, and the largest fixed height and width."""


@dataclass(frozen=True, kw_only=True)
class Foreign(DetectorVictim):
    """A detector of others; the fields say what its network takes and returns.

    Args:
        names: class names in the order of the scores, one of which is "stop sign": joined by `+`, as in "car+stop sign"; or a
            text file with one in each line; or `coco80`, `coco91` (COCO's category numbers, 0 is the background), `coco90` (the
            same from 0), `coco92` (with "no object" at the end). Empty for that of COCO's which fits the outputs.
        boxes: `corners`: [x1, y1, x2, y2]; `corners_yx`: [y1, x1, y2, x2], as TensorFlow writes them; `centre`: [x, y, width,
            height]; `auto`: as is usual for outputs of these shapes.
        normalised: boxes are shares of the input's width and height, not pixels.
        activation: makes probabilities of scores that are logits: `sigmoid` or `softmax`; `none` if they are in [0, 1].
        scaling: values of the pixels: `unit`: [0, 1]; `byte`: [0, 255]; `imagenet`: [0, 1], minus the mean of ImageNet, over its
            standard deviation. An input of uint8 is `byte` in any case.
        channels: their order.
        frame: longer side in pixels of the world's images, if the input size is fixed. Such an image fills the input, and smaller
            windows of it are shown at the same scale.
    """

    fixed: ClassVar[bool] = True
    """Whether it must return the same number of boxes for every image."""

    names: str = ""
    boxes: Boxes = "auto"
    normalised: bool = False
    activation: Activation = "none"
    scaling: Scaling = "unit"
    channels: Order = "rgb"
    frame: Count = 1248

    def alternatives(self) -> Mapping[str, Foreign]:
        """Other readings of its pixels, boxes and labels, which differ in one or two parameters; those that differ in one come
        first."""
        choices: dict[str, tuple[object, ...]] = {
            "scaling": get_args(Scaling),
            "channels": get_args(Order),
            "boxes": get_args(Boxes),
            "normalised": (False, True),
        }
        if self.names in ("", *coco.NUMBERINGS):
            # Labels are numbered in one of three ways; "no object" is no label.
            choices["names"] = (self.names, "coco80", "coco90", "coco91")
        found: list[tuple[int, str, Foreign]] = []
        for values in itertools.product(*choices.values()):
            given = dict(zip(choices, values, strict=True))
            words = [self.said(name, value) for name, value in given.items() if value != getattr(self, name)]
            found.append((len(words), " ".join(words), replace(self, **given)))  # type: ignore[arg-type]
        return {words: victim for count, words, victim in sorted(found, key=itemgetter(0)) if count in (1, 2)}

    def said(self, name: str, value: object) -> str:
        """A parameter as the user gives it."""
        return f"victim.{name}={str(value).lower()}"

    def zoo_name(self) -> str:
        """It has no trained or defended versions.

        Raises:
            UserError: always.
        """
        raise UserError("a detector in a file cannot be trained: leave out the training or the defence that needs one")

    def input_of(self, what: str, shape: Sequence[int | None], dtype: torch.dtype) -> Input:
        """What a network with an input of this shape takes.

        Args:
            what: the network in errors.
            shape: of its input; None for a side of any size.
            dtype: of its input.

        Raises:
            UserError: if it takes no images.
        """
        batch, *rest = shape or (0,)
        size: tuple[int, int] | None
        match rest if batch is None or 0 < batch <= MOST_IMAGES else []:
            case [3 | None, None, None]:
                size, last = None, False
            case [None, None, 3]:
                size, last = None, True
            case [3 | None, int(height), int(width)] if _fits(height, width):
                size, last = (height, width), False
            case [int(height), int(width), 3] if _fits(height, width):
                size, last = (height, width), True
            case _:
                sides = ", ".join("any" if side is None else str(side) for side in shape)
                raise UserError(
                    f"{what} takes [{sides}]; a detector takes images [N, 3, H, W] or [N, H, W, 3], with H and W both fixed, "
                    f"up to {MOST_PIXELS}, or both dynamic, and N up to {MOST_IMAGES} or dynamic"
                )
        return Input(batch, size, dtype, self.frame, self.scaling, self.channels, last)

    @property
    def output(self) -> Output:
        """How the network writes boxes and scores."""
        return Output(self.boxes, self.normalised, self.activation)

    def class_names(self) -> tuple[str, ...] | None:
        """The class names that were given; None for COCO's in the numbering that fits.

        Raises:
            UserError: if they cannot be read, or a stop sign is not among them.
        """
        if not self.names:
            return None
        names = coco.NUMBERINGS.get(self.names) or _listed(self.names)
        if not all(name and name.isprintable() for name in names):
            raise UserError(f"victim.names={short(self.names)!r} has an empty name, or one that cannot be printed")
        if STOP_SIGN not in names:
            raise UserError(
                f"none of the classes in victim.names is {STOP_SIGN!r}, which attacks hide: {short(', '.join(names))!r}; "
                'join the names by "+", or give a text file with one in each line'
            )
        return names


def _fits(*sides: int) -> bool:
    return min(sides) > 0 and max(sides) <= MOST_PIXELS


def _listed(given: str) -> tuple[str, ...]:
    """Names joined by `+`, or the lines of a file."""
    try:
        path = Path(given).expanduser()
        if not path.is_file():
            return tuple(name.strip() for name in given.split("+"))
        found = bounded.content(path, most=LARGEST_NAMES, name=f"victim.names={short(given)}")
        return tuple(line.strip() for line in found.decode("utf-8").strip().splitlines())
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"victim.names={short(given)} cannot be read: {type(error).__name__}") from error
