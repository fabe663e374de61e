"""Units that differ in their attacks alone are carried out in one batch, with the records that each has alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import pytest
import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.core.pair import Chosen
from cavbench.detection import Detector, Predictions
from cavbench.detection.patch import Patch
from cavbench.isolation.framework import Snapshot
from cavbench.run.attempt import attempt
from cavbench.run.batches import batches
from cavbench.run.config import plan_of
from cavbench.run.task import Outcome, Task
from cavbench.run.unit import Unit
from tests.plugins.toy_camera import RedDetector, RedScenes, RedStreet, RedVictim

pytestmark = pytest.mark.usefixtures("toy_folder")

WORDS = (
    *("attack=paint,blank,noise_patch", "victim=red", "world=red_street", "lanes=3", "density=1,2", "weather=clear"),
    *("seeds=0", "record=0", "reference=false", "workers=1"),
)
OWN = {"wall_s", "created_at", "entropy", "redrawn", "same_answer", "inconsistent"}
"""Columns of the moment and of the probes."""


class Certain(RedDetector):
    """Has a certificate, which may be false, and may be random."""

    asked: ClassVar[list[int]] = []
    promise, noise = 0.0, 0.0

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        return Predictions(found.boxes, found.objectness - self.noise * torch.rand(len(pictures), 1), found.classes)

    def certified(self, pictures: Tensor, boxes: Tensor, reach: Tensor) -> Tensor:
        self.asked.append(len(pictures))
        return torch.full((len(pictures),), self.promise)


@dataclass(frozen=True, kw_only=True)
class CertainVictim(RedVictim):
    """The victim of `Certain`.

    Args:
        promise: what it calls certain.
        noise: of its scores.
    """

    promise: float = 0.0
    noise: float = 0.0

    def load(self, seed: int, facts: Facts) -> Detector:
        detector = Certain().requires_grad_(False).eval()
        detector.promise, detector.noise = self.promise, self.noise
        return detector


def attacked(victim: RedVictim) -> tuple[list[Unit], dict[str, bytes]]:
    """The units of three attacks in one cell, and their patches: light, medium and dark red."""
    chosen = [Chosen(kind="victim", name="red", component=victim, code="test")]
    chosen += [Chosen(kind="world", name="red_street", component=RedStreet(), code="test")]
    other = {one.kind: one for one in chosen}
    units = [replace(unit, pair=replace(unit.pair, **other)) for unit in plan_of(list(WORDS)).units()]
    some = [unit for unit in units if unit.artefact and unit.cell["density"] == 1]
    assert len(some) == 3
    reds = [Patch(torch.tensor([shade, 0.0, 0.0])[:, None, None].repeat(1, 8, 8)) for shade in (0.9, 0.5, 0.1)]
    return some, {unit.artefact: patch.written("") for unit, patch in zip(some, reds, strict=True)}


def least(outcome: Outcome) -> float:
    """The lowest confidence in a frame."""
    assert outcome.records is not None
    return min(min(row) for row in outcome.records["frame_confidence"].to_pylist())


def carried_out(task: Task) -> list[Outcome]:
    outcome = attempt(task, lambda *news: None, Snapshot())
    return [outcome, *outcome.others]


def test_units_of_a_cell_and_a_detector_come_together() -> None:
    units = plan_of(list(WORDS)).units()
    tasks = [Task(unit=unit) for unit in units] * 9
    found = [[task.unit for task in batch] for batch in batches(tasks, {units[0].fingerprint}, workers=1)]
    kinds = {tuple(sorted({unit.pair.attack.name for unit in one})) for one in found}
    assert ("blank", "noise_patch", "paint") in kinds
    assert all(len({unit.cell["density"] for unit in one}) == 1 for one in found)
    assert all(len({unit.pair.threat for unit in one}) == 1 for one in found), "the clean control is apart"


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_each_has_the_records_that_it_has_alone(noise: float, monkeypatch: pytest.MonkeyPatch) -> None:
    units, patches = attacked(CertainVictim(noise=noise))
    alone = [carried_out(Task(unit=unit, artefacts=patches))[0] for unit in units]
    rendered: list[Tensor] = []
    decoys = RedScenes.render_decoys
    monkeypatch.setattr(
        RedScenes, "render_decoys", lambda self, frames: rendered.append(frames) or decoys(self, frames)
    )
    Certain.asked.clear()
    together = carried_out(Task(unit=units[0], others=units[1:], artefacts=patches))
    assert len(rendered) == len(Certain.asked) == 3, "once for each of the three approaches"
    for one, other in zip(together, alone, strict=True):
        assert one.records is not None
        assert other.records is not None
        same = [name for name in one.records.column_names if name not in OWN]
        assert one.records.select(same).equals(other.records.select(same))


def test_one_that_fails_is_named_and_the_others_are_kept() -> None:
    """Under the dark patch the confidence is lower than the detector promises; under the light one it is not."""
    units, patches = attacked(CertainVictim())
    light, _, dark = map(least, carried_out(Task(unit=units[0], others=units[1:], artefacts=patches)))
    assert light > dark + 0.05
    units, patches = attacked(CertainVictim(promise=(light + dark) / 2))
    kept, _, failed = carried_out(Task(unit=units[0], others=units[1:], artefacts=patches))
    assert least(kept) == light
    assert "the certificate is false" in failed.why
