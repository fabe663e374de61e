#!/usr/bin/env bash
# One guesses: nrtk moves the boxes of an image with its pixels, and cuts them at the border of the image.
# What happens: after a translation boxes are cut at their own old right and lower edge. A car that moves right or down has a part of its box,
# down to a box without area. A crop takes boxes as (row, column); translation, distortion and nrtk's MAITE interface take (x, y).
# For whom it matters: a detector that finds every car loses precision and recall by the translation itself, and looks less robust.
# Versions: nrtk 1.1.0 (impls/perturb_image/geometric/_random: RandomTranslationPerturber.perturb, RandomCropPerturber._compute_bboxes),
# smqtk-image-io 0.19.0. Source: the pixels of a white car on black, beside the box that is returned for it.
source "$(dirname "$0")/fresh.sh"
fresh nrtk==1.1.0 smqtk-image-io==0.19.0 numpy
see <<'P'
from importlib.metadata import version

import numpy as np
from nrtk.impls.perturb_image.geometric.random import RandomCropPerturber, RandomTranslationPerturber
from smqtk_image_io.bbox import AxisAlignedBoundingBox

CAR = (140, 60, 180, 90)


def corners(image):
    """The box of what is white: left, upper, right and lower edge."""
    rows, columns = np.nonzero(image[..., 0])
    return (int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1)


def overlap(a, b):
    """Intersection over union of two boxes."""
    inside = np.prod(np.clip(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0, None))
    areas = [np.prod(np.subtract(box[2:], box[:2])) for box in (a, b)]
    return inside / (sum(areas) - inside)


image = np.zeros((200, 300, 3), np.uint8)
image[CAR[1] : CAR[3], CAR[0] : CAR[2]] = 255
box = AxisAlignedBoundingBox(min_vertex=CAR[:2], max_vertex=CAR[2:])
seen = {"right": [], "left": [], "crop": []}
for seed in range(40):
    moved, boxes = RandomTranslationPerturber(seed=seed)(image=image, boxes=[(box, {"car": 1.0})], max_translation_limit=(30, 40))
    ((found, _),) = boxes
    where = corners(moved)
    if where[0] > CAR[0] and where[1] > CAR[1]:
        seen["right"].append(overlap(where, (*found.min_vertex, *found.max_vertex)))
    elif where[0] < CAR[0] and where[1] < CAR[1]:
        seen["left"].append(overlap(where, (*found.min_vertex, *found.max_vertex)))
    # A crop that keeps all of the car: its box has one right answer, and the one that is returned is another.
    cropped, boxes = RandomCropPerturber(seed=seed, crop_size=(160, 280))(image=image, boxes=[(box, {"car": 1.0})])
    if corners(cropped)[3] - corners(cropped)[1] == 30:
        seen["crop"].append(max((overlap(corners(cropped), (*one.min_vertex, *one.max_vertex)) for one, _ in boxes), default=0.0))
mean = {name: round(float(np.mean(found)), 2) for name, found in seen.items()}
print(f"nrtk {version('nrtk')}: overlap of the returned box and the white pixels, moved right and down, left and up, cropped: {mean}, "
      f"of {({name: len(found) for name, found in seen.items()})} images")
raise SystemExit(not (mean["left"] == 1.0 and mean["right"] < 0.5 and mean["crop"] < 0.5 and min(map(len, seen.values())) >= 5))
P
