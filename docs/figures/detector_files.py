"""Detectors from files: the zoo's `yolov5` is exported, loaded as a victim, and looks at one approach."""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.detection import Detector
from cavbench.envs.camera.world import StopSignApproach
from docs.figures import style
from docs.figures.sightings import approaches, detector, frame_axes, sight

SQUARE = 640


class _Exported(nn.Module):
    """A detector as a plain network with two outputs."""

    def __init__(self, of: Detector) -> None:
        super().__init__()
        self.of = of

    def forward(self, pictures: Tensor) -> tuple[Tensor, Tensor]:
        found = self.of.predict(pictures)
        return found.boxes, found.scores


def detector_file() -> Figure:
    """The confidence in the sign of `yolov5`, and of the same network from files."""
    of, approach = detector("yolov5"), approaches()[0]
    height, width = approach.scenes.size
    looks = {"before": sight(of, approach).confidence}
    with tempfile.TemporaryDirectory() as folder:
        whole, square = _program(of, height, width), _program(of, SQUARE, SQUARE)
        torch.export.save(whole, Path(folder) / "whole.pt2")
        torch.export.save(square, Path(folder) / "square.pt2")
        torch.onnx.export(whole, (), Path(folder) / "whole.onnx", external_data=False, verbose=False)
        for name in ("whole.pt2", "whole.onnx", "square.pt2"):
            victim = choose("victim", "detector", path=str(Path(folder) / name), names="+".join(of.names)).component
            looks[name] = sight(victim.load(0, StopSignApproach().facts), approach).confidence
    apart = {name: float(abs(looks[name] - looks["before"]).max()) for name in ("whole.pt2", "whole.onnx")}
    same, near = (f"{most:.0e} apart" if most else "the same" for most in apart.values())
    made = style.figure(
        4.0, "detector: yolov5 from files is as sure as before\nif the input has the size of the camera's frames"
    )
    axes, distance = made.subplots(), approach.scenes.distance
    size = f"{width} x {height}"
    axes.plot(distance, looks["before"], color=style.GREEN, lw=2.2, label="before")
    axes.plot(distance, looks["whole.pt2"], "o", ms=7, color=style.GREEN, label=f".pt2 {size}")
    axes.plot(distance, looks["whole.onnx"], "x", ms=6, color=style.INK, label=f".onnx {size}")
    axes.plot(distance, looks["square.pt2"], "s--", ms=4, color=style.ORANGE, label=f".pt2 {SQUARE} x {SQUARE}")
    frame_axes(axes)
    axes.set_title(f"at {size}: from .pt2 {same}, from .onnx {near}", fontsize=10)
    axes.legend(loc=(0.02, 0.32), fontsize=9.5)
    return made


def _program(of: Detector, height: int, width: int) -> torch.export.ExportedProgram:
    batch = torch.export.Dim("batch")
    return torch.export.export(_Exported(of), (torch.rand(2, 3, height, width),), dynamic_shapes=({0: batch},))
