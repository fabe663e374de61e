#!/usr/bin/env bash
# One guesses: AlbumentationsX, which is imported as albumentations, takes its calls, or raises where a word for a strength has another name now.
# What happens: 17 such words that albumentations 2.0.8 takes are left out with a warning, and the default strength is used: MotionBlur(blur_limit=21)
# blurs like blur_limit=3. Words that kept their names work, and so do the new names.
# For whom it matters: a curve over five severities is flat, and a detector looks robust. Warnings of worker processes are easily missed.
# Versions: albumentationsx 2.5.1, which needs torch (core/validation.py, ValidatedTransformMeta; `strict=True` makes it an error, albumentations' issue 2307).
# Source: weak and strong calls, with the words of the signatures of albumentations 2.0.8; met while looking at the boxes of blurred cars.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 albumentationsx==2.5.1 opencv-python-headless==5.0.0.93 numpy
see <<'P'
import warnings
from importlib.metadata import version

import albumentations
import cv2
import numpy as np

OLD = {
    "MotionBlur": {"blur_limit": (3, 21)},
    "Blur": {"blur_limit": (3, 21)},
    "GaussianBlur": {"sigma_limit": (0.5, 6.0)},
    "Defocus": {"radius": (1, 12)},
    "ZoomBlur": {"max_factor": (1.02, 1.4)},
    "RandomBrightnessContrast": {"brightness_limit": (0.05, 0.5)},
    "RandomGamma": {"gamma_limit": (95, 300)},
    "CLAHE": {"clip_limit": (1.1, 8.0)},
    "ColorJitter": {"brightness": (1.05, 1.6)},
    "HueSaturationValue": {"val_shift_limit": (5, 80)},
    "RGBShift": {"r_shift_limit": (2, 90)},
    "ISONoise": {"intensity": (0.05, 0.9)},
    "Spatter": {"std": (0.1, 0.6)},
    "ChromaticAberration": {"primary_distortion_limit": (0.01, 0.5)},
    "GridDistortion": {"distort_limit": (0.01, 0.6)},
    "OpticalDistortion": {"distort_limit": (0.01, 0.6)},
    "Rotate": {"limit": (2, 45)},
}
KEPT = {
    "MotionBlur": {"blur_range": (3, 21)},
    "RandomFog": {"fog_coef_range": (0.1, 0.9)},
    "GaussNoise": {"std_range": (0.02, 0.4)},
    "ImageCompression": {"quality_range": (95, 5)},
}

image = cv2.GaussianBlur((np.random.default_rng(0).random((96, 96, 3)) * 255).astype(np.uint8), (0, 0), 2)


def change(name, word, strength):
    """The mean change of ten images, and how often a warning named the word."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        transform = getattr(albumentations, name)(**{word: (strength, strength)}, p=1.0)
    images = [albumentations.Compose([transform], seed=seed)(image=image)["image"] for seed in range(10)]
    return round(float(np.mean([np.abs(one.astype(float) - image).mean() for one in images])), 2), sum(word in str(one.message) for one in told)


seen = {f"{name}({word}=)": [change(name, word, one) for one in ends] for words in (OLD, KEPT) for name, of in words.items() for word, ends in of.items()}
old = {name: pair for name, pair in seen.items() if name.split("(")[0] in OLD and "blur_range" not in name}
kept = {name: pair for name, pair in seen.items() if name not in old}
flat = [name for name, (weak, strong) in old.items() if weak == strong and weak[1] == 1]
print(f"albumentationsx {version('albumentationsx')}: change of pixels, weakest and strongest, where the word was kept or is new: "
      f"{({name: [change for change, _ in pair] for name, pair in kept.items()})}; equal and warned of: {len(flat)} of {len(old)} old words, {flat}")
raise SystemExit(len(flat) != len(old) or len(old) != 17 or any(strong[0] < 1.5 * weak[0] or weak[1] or strong[1] for weak, strong in kept.values()))
P
