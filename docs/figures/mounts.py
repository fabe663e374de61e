"""How a patch comes onto the sign: the places and shapes of the threat model, each with the same texels."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure

from cavbench.detection.mount import Mount
from cavbench.envs.camera.world import StopSignApproach
from docs.figures import style
from docs.figures.sightings import show

SHOWN = {
    "middle": Mount(),
    "top": Mount(place="top"),
    "bottom": Mount(place="bottom"),
    "beside": Mount(place="beside"),
    "stickers": Mount("stickers"),
    "light": Mount("light"),
    "plate": Mount("plate"),
}
BUDGET, SIDE = 0.5, 160


def mounts() -> Figure:
    """The nearest frame of an approach with coarse noise, shown in each way."""
    made = style.figure(1.9, "the same texels in each place and shape, budget 0.5")
    texels = torch.rand(1, 3, 10, 10, generator=torch.Generator().manual_seed(0)).round()
    world = StopSignApproach()
    cell = world.facts.axes.cell(lanes=3, density=1.0, weather="clear")
    (approach,) = world.approaches(cell, range(1))
    frame = torch.tensor([len(approach.scenes) - 1])
    middle = (approach.scenes.boxes[frame, :2] + approach.scenes.boxes[frame, 2:]) / 2
    # There is more to see left of the sign.
    corner = (middle - SIDE * torch.tensor([0.6, 0.5])).round().long().clamp(min=0)
    for axes, (name, mount) in zip(made.subplots(1, len(SHOWN)), SHOWN.items(), strict=True):
        show(axes, approach.scenes.mounted(mount).windows(frame, texels, BUDGET, corner, (SIDE, SIDE))[0])
        axes.set_title(name, fontsize=9)
    return made
