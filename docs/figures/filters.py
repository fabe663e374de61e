"""Input transformations before the detector: the filtered patch, and the confidence under it."""

from __future__ import annotations

from copy import copy

import torch
from matplotlib.figure import Figure
from torch import Tensor
from torch.nn.functional import avg_pool2d

from cavbench.defenses.detection.judge import COVER, GREY, SIGN
from cavbench.defenses.detection.segmenter import Completed
from cavbench.detection.filter import FilteredDetector
from cavbench.detection.stopping import THRESHOLD
from cavbench.envs.camera.faces import DECOYS
from docs.figures import style
from docs.figures.patches import STRONGER, texels_of
from docs.figures.sightings import FRAME, approaches, crop, detector, frame_axes, picture, said, show, sight

NEAR = 8
"""Index of the frame in the figure of `segmenter`, in which the patch that knows of it avoids the marks."""


def median() -> Figure:
    """The median of each neighbourhood."""
    return _figure("median", texels_of("eot", "median"))


def jpeg() -> Figure:
    """JPEG compression; 40 crafting steps instead of 150 are enough against it."""
    return _figure("jpeg", texels_of("eot", "jpeg", steps=40))


def segmenter() -> Figure:
    """What is marked and filled, with a patch crafted without the defence and with one crafted against it."""
    guarded = detector(defense="segmenter")
    assert isinstance(guarded, Completed)
    approach = approaches()[0]
    made = style.figure(2.1, "segmenter: what it marks, and what the detector sees")
    patches = (
        ("patch that does not know it", texels_of("eot", steps=40)),
        ("patch that does", texels_of("eot", "segmenter", **STRONGER)),
    )
    for row, (name, texels) in zip(made.subfigures(1, 2), patches, strict=True):
        shown = picture(approach, NEAR, texels)
        with torch.no_grad():
            seen, marks = guarded.defense.filter(shown[None])[0], guarded.log_odds(shown[None])[0] > 0
        marked = torch.where(marks, torch.tensor([0.0, 0.45, 0.7])[:, None, None], shown)
        row.suptitle(name, fontsize=10)
        for axes, part, title in zip(row.subplots(1, 2), (marked, seen), ("marked", "completed"), strict=True):
            axes.imshow(avg_pool2d(crop(part, approach, NEAR), 3).permute(1, 2, 0).numpy(), interpolation="nearest")
            axes.set_xlabel(f"{title}: {said(guarded.inner, part, approach, NEAR):.2f}" if part is seen else title)
            style.bare(axes)
    return made


def masking() -> Figure:
    """What the judge sees of the sign with and without a patch, and of a decoy with a red ring."""
    guarded, approach = detector(defense="masking"), approaches()[0]
    scenes = copy(approach.scenes)
    scenes.decoys = tuple(each for each in DECOYS if each.name == "fifty") * len(scenes)
    patch = torch.rand(3, 100, 100, generator=torch.Generator().manual_seed(0))
    shown = {
        "stop sign": picture(approach, NEAR),
        "with a patch": picture(approach, NEAR, patch),
        "the decoy fifty": scenes.render_decoys(torch.tensor([NEAR]))[0],
    }
    made = style.figure(1.7, "masking: the middle is hidden from the judge")
    left, top, right, bottom = scenes.boxes[NEAR].tolist()
    x, y, half = (left + right) / 2, (top + bottom) / 2, (right - left) * COVER / SIGN / 2
    rows, columns = slice(round(y - half), round(y + half)), slice(round(x - half), round(x + half))
    for part, (name, each) in zip(made.subfigures(1, len(shown)), shown.items(), strict=True):
        covered = each.clone()
        covered[:, rows, columns] = GREY
        for axes, one in zip(part.subplots(1, 2), (each, covered), strict=True):
            axes.imshow(avg_pool2d(crop(one, approach, NEAR), 3).permute(1, 2, 0).numpy(), interpolation="nearest")
            style.bare(axes)
        part.suptitle(f"{name}: {said(guarded, each, approach, NEAR):.2f}", fontsize=10)
    return made


def _figure(defense: str, aware: Tensor) -> Figure:
    """The sign and the confidence with a patch crafted without the defence, and with `aware`, crafted against it."""
    guarded = detector(defense=defense)
    assert isinstance(guarded, FilteredDetector)
    unaware = texels_of("eot")
    approach = approaches()[0]
    seen = {
        "no patch": sight(guarded, approach).confidence,
        "patch crafted without the defence": sight(guarded, approach, unaware).confidence,
        "patch crafted against it": sight(guarded, approach, aware).confidence,
    }
    clean, found, again = (int((each > THRESHOLD).sum()) for each in seen.values())
    title = (
        f"{defense}: sign found in {clean} of {len(approach.scenes)} frames, with a patch in {found},\n"
        f"with one that knows of the defence in {again}"
    )
    made = style.figure(5.6, title)
    pictures, curves = made.subfigures(2, 1, height_ratios=(1, 1.35))
    for axes, (name, texels, filtered) in zip(
        pictures.subplots(1, 3),
        (("before", unaware, False), (f"after {defense}", unaware, True), ("a patch that knows of it", aware, True)),
        strict=True,
    ):
        shown = picture(approach, FRAME, texels)
        with torch.no_grad():
            shown = guarded.defense.filter(shown[None])[0] if filtered else shown
        show(axes, crop(shown, approach, FRAME))
        axes.set_title(name, fontsize=10)
    axes = curves.subplots()
    distance = approach.scenes.distance.numpy()
    looks = ((style.BLUE, "-"), (style.GREEN, "-."), (style.RED, "--"))
    for (name, each), (colour, dashes) in zip(seen.items(), looks, strict=True):
        axes.plot(distance, each, color=colour, ls=dashes, lw=2.2, marker="o", ms=4, label=name)
    frame_axes(axes)
    axes.set_title("yolov3_tiny on one approach in clear weather", fontsize=10)
    curves.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9.5)
    return made
