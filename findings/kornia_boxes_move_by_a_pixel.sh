#!/usr/bin/env bash
# One guesses: a box (0, 0, 4, 4) of width 4 in an image of 10 is (6, 0, 10, 4) after a horizontal flip, and (0, 0, 8, 8) after a resize to 20.
# What happens: kornia moves the corners as centres of pixels: (5, 0, 9, 4) and (0, 0, 8.44, 8.44). The pixels themselves are moved as one
# guesses, so the box leaves out one column of what it held. Two flips return it.
# Versions: kornia 0.9.0, torch 2.13.0. Source: labels of a detector that was trained with augmentations.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 kornia==0.9.0 numpy
see <<'P'
import kornia
import torch
from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip, Resize

image = torch.zeros(1, 1, 10, 10)
image[..., :4, :4] = 1
box = torch.tensor([[[0.0, 0.0, 4.0, 4.0]]])


def moved(augmentation):
    """What is painted and the box, both as (left, right), after an augmentation."""
    pixels, boxes = AugmentationSequential(augmentation, data_keys=["input", "bbox_xyxy"])(image, box)
    columns = (pixels[0, 0].max(0).values > 0.5).nonzero().flatten()
    left, _, right, _ = boxes[0, 0].tolist()
    return (columns[0].item(), columns[-1].item() + 1), (round(left, 2), round(right, 2))


flipped, resized = moved(RandomHorizontalFlip(p=1.0)), moved(Resize((20, 20)))
print(f"kornia {kornia.__version__}: columns painted, and of the box: flipped {flipped}, resized to twice the size {resized}")
raise SystemExit(not (flipped == ((6, 10), (5.0, 9.0)) and resized == ((0, 8), (0.0, 8.44))))
P
