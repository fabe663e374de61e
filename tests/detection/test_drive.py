"""What jobs have in common is done once, and their measurements are those of each job alone, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from cavbench.core.contracts import Facts
from cavbench.core.pair import Chosen, Pair, choose
from cavbench.core.track import Driven, Job, track
from cavbench.defenses.detection.temporal import TemporalFusion
from cavbench.detection import (
    Approach,
    CameraWorld,
    Detector,
    DetectorVictim,
    PatchThreat,
    Predictions,
    Scenes,
    Wrapped,
)
from cavbench.detection.closed_loop import DrivingEnv
from cavbench.detection.drive import drive, drive_jointly
from cavbench.detection.patch import Patch, written_together
from cavbench.detection.victims.yolov3_tiny import YOLOv3Tiny
from cavbench.envs.camera.environment import ApproachEnv
from cavbench.run.batches import batches
from cavbench.run.task import Task
from cavbench.run.unit import Unit
from cavbench.scenarios import Axes, Axis, Cell
from tests.detection.growing_signs import GrowingScenes, SquareDetector

DISTANCES = torch.arange(22.0, 7.9, -0.5)
SPEED = Axis(name="speed", kind="float", meaning="of the car", unit="m/s", low=1.0, default=10.0, unseen=True)
NEAREST = Axis(name="nearest", kind="float", meaning="distance of the nearest frame", unit="m", low=1.0, default=8.0)
SEEDS = range(1_000_000, 1_000_004)
SCENES = {nearest: GrowingScenes(DISTANCES[nearest <= DISTANCES]) for nearest in (8.0, 10.0)}
DARK = torch.full((3, 8, 8), 0.1)


@dataclass(frozen=True, kw_only=True)
class GrowingStreet(CameraWorld):
    """A road of growing red squares."""

    axes: ClassVar[Axes] = Axes((SPEED, NEAREST))
    locations: ClassVar[tuple[str, ...]] = ("street",)

    def training_scenes(self) -> Scenes:
        return SCENES[8.0]

    def approaches(self, cell: Cell, seeds: range) -> list[Approach]:
        return [Approach(seed=seed, location="street", scenes=SCENES[cell.nearest]) for seed in seeds]

    def environment(self, cell: Cell, seeds: Sequence[int], patch: Tensor | None, share: float) -> DrivingEnv:
        patches = None if patch is None else patch[None]
        return ApproachEnv([SCENES[cell.nearest]], patches, share, speed=cell.speed, seeds=seeds)


class Counting(Wrapped):
    """Counts the pictures that it is asked about."""

    asked: ClassVar[int] = 0

    def predict(self, pictures: Tensor) -> Predictions:
        Counting.asked += len(pictures)
        return self.inner.predict(pictures)


class Random(Counting):
    """Answers with another confidence each time."""

    def predict(self, pictures: Tensor) -> Predictions:
        found = super().predict(pictures)
        return replace(found, objectness=found.objectness * (0.5 + torch.rand(found.objectness.shape) / 2))


class Drawn(Counting):
    """Has a weight that is drawn when it is made."""

    def __init__(self, inner: Detector) -> None:
        super().__init__(inner)
        self.register_buffer("weight", torch.rand(1))


MADE = {
    "squares": lambda: Counting(SquareDetector()),
    "memory": lambda: TemporalFusion().around(Counting(SquareDetector())),
    "random": lambda: Random(SquareDetector()),
    "drawn": lambda: Drawn(SquareDetector()),
    "yolov3_tiny": lambda: Counting(YOLOv3Tiny().load(0, GrowingStreet().facts)),
}


@dataclass(frozen=True, kw_only=True)
class Made(DetectorVictim):
    """The victim of a detector of `MADE`."""

    kind: str = "squares"

    def load(self, seed: int, facts: Facts) -> Detector:
        return MADE[self.kind]().eval()


def unit(kind: str, attack: str = "none", knows: str = "universal", **values: float) -> Unit:
    pair = Pair(
        attack=choose("attack", attack),
        defense=choose("defense", "none"),
        victim=Chosen(kind="victim", name="made", component=Made(kind=kind), code="test"),
        world=Chosen(kind="world", name="growing", component=GrowingStreet(), code="test"),
        threat=PatchThreat(budget=0.75, knows=knows) if attack != "none" else PatchThreat(budget=0, queries=0),
    )
    cell = GrowingStreet.axes.cell(**values)
    return Unit(pair=pair, training_seed=0, weights_sha256="", cell=cell, seeds=SEEDS)


def job(kind: str, attack: str = "none", knows: str = "universal", **values: float) -> Job:
    found = unit(kind, attack, knows, **values).job
    return replace(found, artefact="" if attack == "none" else attack)


def files(jobs: Sequence[Job]) -> dict[str, bytes]:
    return {one.artefact: Patch(texels=DARK).written("") for one in jobs if one.artefact}


def counted(jobs: Sequence[Job], *, jointly: bool) -> tuple[list[Driven], int]:
    """The measurements, and how many pictures the detector was asked about."""
    Counting.asked, artefacts = 0, files(jobs)
    if jointly:
        found = drive_jointly(jobs, artefacts)
        assert found is not None
        return list(found), Counting.asked
    return [drive(one, artefacts.get(one.artefact), ()) for one in jobs], Counting.asked


def same(found: Driven, wanted: Driven) -> None:
    assert found.columns.keys() == wanted.columns.keys()
    for name, values in wanted.columns.items():
        np.testing.assert_array_equal(found.columns[name], values, err_msg=name)


@pytest.mark.parametrize("kind", sorted(MADE.keys() - {"drawn"}))
def test_cells_that_differ_in_speed_are_measured_together_as_alone(kind: str) -> None:
    for attack in ("none", "grey_patch"):
        jobs = [job(kind, attack, speed=speed) for speed in (8.0, 20.0)]
        (together, asked), (alone, asked_alone) = counted(jobs, jointly=True), counted(jobs, jointly=False)
        for found, wanted in zip(together, alone, strict=True):
            same(found, wanted)
        slow, fast = (one.columns["drive_overrun_m"][0] for one in together)
        assert slow < fast
        if kind == "random":
            assert asked == asked_alone
        elif kind == "memory":
            assert 0.5 * asked_alone < asked < asked_alone, "frames of a drive are looked at again"
        else:
            assert asked < 0.6 * asked_alone


def test_cells_with_other_frames_are_not_taken_for_each_other() -> None:
    jobs = [job("squares", nearest=nearest) for nearest in (8.0, 10.0)]
    together, alone = counted(jobs, jointly=True)[0], counted(jobs, jointly=False)[0]
    for found, wanted in zip(together, alone, strict=True):
        same(found, wanted)


def test_detectors_that_are_others_in_each_cell_are_not_driven_together() -> None:
    jobs = [job("drawn", speed=speed) for speed in (8.0, 20.0)]
    assert drive_jointly(jobs, {}) is None
    assert drive_jointly(jobs[:1], {}) is not None


def test_units_come_together_if_they_differ_in_attack_and_speed_alone() -> None:
    alike = [
        track("detection").alike(one)
        for one in (
            job("squares", "grey_patch", speed=8.0),
            job("squares", "noise_patch", speed=12.0),
            job("squares", "grey_patch", nearest=10.0),
            job("memory", "grey_patch"),
        )
    ]
    assert alike[0] == alike[1]
    assert len(set(alike)) == 3


def test_speeds_of_a_pair_are_not_parted_however_many_workers_there_are() -> None:
    units = [unit("squares", attack, speed=speed) for speed in (8.0, 10.0, 12.0) for attack in ("noise_patch", "eot")]
    for workers in (1, 16):
        found = batches([Task(unit=one) for one in units], (), workers)
        assert sorted(map(len, found)) == [3, 3]
        assert {len({task.unit.pair.id for task in batch}) for batch in found} == {1}
    # Where there is much to do, pairs come together, too.
    many = [replace(one, seeds=range(start, start + 4)) for one in units for start in range(0, 40, 4)]
    assert sorted(map(len, batches([Task(unit=one) for one in many], (), 1))) == [6] * 10


def test_a_patch_for_a_scene_is_that_of_every_speed_and_is_looked_at_once() -> None:
    """All approaches of a cell have the same frames, and so the same patch."""
    site, universal = (job("squares", "grey_patch", knows) for knows in ("scene", "universal"))
    known = [site.pair.threat.known(GrowingStreet.axes.cell(speed=v), GrowingStreet.axes) for v in (8.0, 12.0)]
    assert known[0] == known[1]
    patch = Patch(texels=DARK)
    Counting.asked = 0
    wanted = drive(universal, patch.written(""), ())
    once, Counting.asked = Counting.asked, 0
    found = drive(site, written_together([patch] * len(SEEDS), ""), ())
    assert Counting.asked == once
    same(found, wanted)


def test_approaches_with_patches_of_their_own_are_measured_each_under_its_own() -> None:
    site, universal = (job("squares", "grey_patch", knows) for knows in ("scene", "universal"))
    patches = [Patch(texels=torch.full((3, 8, 8), grey)) for grey in (0.1, 0.1, 0.9, 0.1)]
    found = drive(site, written_together(patches, ""), ())
    for place, patch in enumerate(patches):
        alone = drive(universal, patch.written(""), ())
        for name, values in alone.columns.items():
            np.testing.assert_array_equal(found.columns[name][place], values[place], err_msg=name)
    assert list(found.columns["seed"]) == list(SEEDS)
    assert len(set(found.columns["patch_sha256"])) == 2
