"""Scores `temporal` with and without an attack that knows of it, on scored approaches and in closed loop.

    python studies/temporal_evidence.py [--defense segmenter] [--steps 300] [--weathers clear rain] [--patches FOLDER]

Each frame is looked at once; the rows with and without `temporal` differ in what they make of the same predictions. The patches
are `noise_patch`, the stronger `eot` of the suite `standard` with one start, which does not know of `temporal`, and the same
through its aggregation. The columns are those of the records, means over three approaches with three lanes in each weather, and
over 50 draws of the cross traffic.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from cavbench.attacks.detection.eot import EOT
from cavbench.attacks.detection.noise_patch import NoisePatch
from cavbench.attacks.detection.suites import STANDARD_DETECTION_3
from cavbench.core import registry
from cavbench.defenses.detection.temporal import TemporalFusion
from cavbench.detection import Approach, Detector, PatchAttack, PatchThreat, Predictions, Wrapped
from cavbench.detection.approach import measured
from cavbench.detection.closed_loop import drive
from cavbench.detection.crafting import craft
from cavbench.detection.discrimination import discrimination
from cavbench.detection.patch import Patch
from cavbench.detection.sight import look, look_at_decoys
from cavbench.envs.camera.crossing import StopSignCrossing
from cavbench.envs.camera.world import StopSignApproach
from cavbench.errors import in_one_line
from cavbench.run.process import settle

WORLD, LOOP, THREAT = StopSignApproach(), StopSignCrossing(), PatchThreat()
MEASURES = ("stop_score", "confidence_mean", "average_precision", "decoy_confidence", "false_stops", "ran")
SPEED_MPS, DRAWS = 10.0, range(50)
STRONGER = STANDARD_DETECTION_3.members[1].params


class Once(Wrapped):
    """A detector that looks at each image once."""

    def __init__(self, inner: Detector) -> None:
        super().__init__(inner)
        self.seen: dict[int, Predictions] = {}

    def predict(self, pictures: Tensor) -> Predictions:
        if torch.is_grad_enabled():
            return self.inner.predict(pictures)
        keys = [hash(picture.numpy().tobytes()) for picture in pictures]
        for key, picture in zip(keys, pictures, strict=True):
            if key not in self.seen:
                self.seen[key] = self.inner.predict(picture[None])
        found = [self.seen[key] for key in keys]
        return Predictions(*(torch.cat([getattr(one, name) for one in found]) for name in vars(found[0])))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--defense", default="none", help="what `temporal` is added to")
    parser.add_argument("--steps", type=int, default=300, help="of `eot`")
    parser.add_argument("--weathers", nargs="+", default=["clear", "rain"])
    parser.add_argument("--patches", type=Path, help="folder in which crafted patches are kept")
    asked = parser.parse_args()
    settle()
    victim = registry.load("victim", "yolov3_tiny")()
    inner = Once(registry.load("defense", asked.defense)().load(victim, 0, WORLD.facts))
    detectors = {"without": inner, "with": TemporalFusion().around(inner)}
    eot = EOT(**{**STRONGER, "steps": asked.steps, "restarts": 1})
    patches: dict[str, Patch | None] = {
        "no patch": None,
        "noise_patch": _crafted(NoisePatch(), inner, None),
        "eot, unaware": _crafted(eot, inner, asked.patches and asked.patches / "unaware"),
        "eot, adaptive": _crafted(eot, detectors["with"], asked.patches and asked.patches / "adaptive"),
    }
    print(
        f"{'':<40}" + "".join(f"{name:>18}" for name in (*MEASURES, "stopped", "confirmed_m", "overrun_m", "collided"))
    )
    for weather in asked.weathers:
        cell = WORLD.axes.cell(lanes=3, density=1.0, weather=weather)
        approaches = WORLD.approaches(cell, range(len(WORLD.locations)))
        for title, patch in patches.items():
            for name, detector in detectors.items():
                values = [*_scored(detector, approaches, patch), *_driven(detector, weather, patch)]
                print(f"{weather + ', ' + title:<30}{name:<10}" + "".join(f"{v:>18.3f}" for v in values), flush=True)
        inner.seen.clear()


def _crafted(attack: PatchAttack, detector: Detector, kept: Path | None) -> Patch:
    path = kept and kept.with_suffix(".safetensors")
    if path and path.exists():
        return Patch.read(path.read_bytes())
    patch = craft(attack, detector, WORLD.training_scenes(), THREAT, attack_seed=0, progress=lambda share, text: None)
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(patch.written("studies/temporal_evidence.py"))
    return patch


@torch.no_grad()
def _scored(detector: Detector, approaches: list[Approach], patch: Patch | None) -> list[float]:
    texels = patch.texels if patch else None
    scenes = [one.scenes for one in approaches]
    seen = [look(detector, one, texels, THREAT.budget) for one in scenes]
    decoys = [look_at_decoys(detector, one) for one in scenes]
    columns = measured(seen, scenes) | discrimination(seen, decoys, scenes)
    return [float(np.nanmean(columns[name].astype(float))) for name in MEASURES]


def _driven(detector: Detector, weather: str, patch: Patch | None) -> list[float]:
    texels = patch.texels if patch else None
    env = LOOP.environment(LOOP.axes.cell(weather=weather, speed=SPEED_MPS), DRAWS, texels, THREAT.budget)
    found = drive(detector, env)
    return [float(found.stopped), found.confirmed_m, found.overrun_m, float(found.collided.mean())]


if __name__ == "__main__":
    with in_one_line():
        main()
