"""Detectors with a memory: the score of each frame by itself, and over the frames of an approach."""

from __future__ import annotations

from matplotlib.figure import Figure

from docs.figures import style
from docs.figures.patches import STRONGER, texels_of
from docs.figures.sightings import approaches, detector, frame_axes, sight

PLACE = 0
"""Number of the approach shown."""


def temporal() -> Figure:
    """Frames and tracks without a patch, with a patch of noise, and with two of `eot`."""
    guarded, approach = detector(defense="temporal"), approaches()[PLACE]
    patches = {
        "no patch": None,
        "noise_patch": texels_of("noise_patch"),
        "eot that does not know it": texels_of("eot", **STRONGER),
        "eot that does": texels_of("eot", "temporal", **STRONGER),
    }
    made = style.figure(4.4, "temporal: evidence adds up over the frames of an approach")
    for axes, (name, texels) in zip(made.subplots(2, 2, sharex=True, sharey=True).flat, patches.items(), strict=True):
        seen, distance = sight(guarded, approach, texels), approach.scenes.distance.numpy()
        axes.plot(distance, seen.by_frame, "o", color=style.ORANGE, ms=5, label="frame by itself")
        axes.plot(distance, seen.confidence, color=style.BLUE, lw=2.2, label="over the frames")
        frame_axes(axes)
        axes.label_outer()
        axes.set_title(name, fontsize=10)
    # Sharing an axis, every second inversion takes back the one before.
    axes.set_xlim(31, 7)
    made.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=9.5)
    return made
