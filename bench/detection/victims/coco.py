"""The classes of the COCO detection data set (Lin et al. 2014), in the label order of detectors trained on it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

NAMES = tuple(Path(__file__).with_name("coco.names").read_text().splitlines())
NO_OBJECT = "no object"
LEFT_OUT = (12, 26, 29, 30, 45, 66, 68, 69, 71, 83)
"""The categories of COCO, numbered from 1 to 90, that no object has: 80 classes are left."""


def _categories() -> tuple[str, ...]:
    """The names of the categories 1 to 90."""
    names = iter(NAMES)
    return tuple(f"category {number}" if number in LEFT_OUT else next(names) for number in range(1, 91))


NUMBERINGS: Mapping[str, tuple[str, ...]] = {
    "coco80": NAMES,
    "coco91": ("background", *_categories()),
    "coco90": _categories(),
    "coco92": ("background", *_categories(), NO_OBJECT),
}
"""How detectors number them: the 80 classes from 0; the categories by their numbers (torchvision, TensorFlow); from 0 (TensorFlow
Lite); by their numbers and, at the end, that there is none (DETR)."""
