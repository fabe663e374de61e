"""A third track, as in a plug-in package: listeners that distinguish high from low tones, attacked by a shift of pitch."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from cavbench.core.contracts import Access, Attack, Facts, ThreatModel, Victim, World
from cavbench.core.ranges import Natural
from cavbench.core.track import Driven, Job, Measure, Track
from cavbench.records.schema import FLOAT, field
from cavbench.scenarios import Axes, Axis, Grid

AXES = Axes(
    (
        Axis(name="pitch", kind="float", meaning="of the lower tone", unit="kHz", above=0.0),
        Axis(name="tones", kind="int", meaning="in a melody", low=1, high=64),
    )
)
MELODIES = Grid(name="melodies-v1", world="booth", axes=AXES, values={"pitch": (1.0, 2.0), "tones": (8,)}, episodes=3)


class Listener(nn.Module):
    """1 for every tone above a threshold."""

    def __init__(self, threshold: float) -> None:
        super().__init__()
        self.register_buffer("threshold", torch.tensor(threshold))

    def forward(self, tones: Tensor) -> Tensor:
        return (tones > self.threshold).long()


@dataclass(frozen=True, kw_only=True)
class ShiftThreat(ThreatModel):
    """Every tone may be off by `budget` kHz."""

    norm: Literal["shift"] = "shift"
    budget: float = 0.1
    queries: Natural = 0


class ToneVictim(Victim):
    """Base class of listeners."""

    track: ClassVar[str] = "listening"
    network: ClassVar[type[Any]] = Listener
    threat: ClassVar[type[ThreatModel]] = ShiftThreat


class ToneAttack(Attack):
    """Base class of attacks: shifts tones."""

    track: ClassVar[str] = "listening"

    @abstractmethod
    def shift(self, tones: Tensor, budget: float) -> Tensor:
        """The shifted tones [E, T]."""


class ToneWorld(World):
    """Base class of worlds: plays tones."""

    track: ClassVar[str] = "listening"


@dataclass(frozen=True, kw_only=True)
class Booth(ToneWorld):
    """A quiet room."""

    axes: ClassVar[Axes] = AXES
    grid: ClassVar[str] = MELODIES.name


@dataclass(frozen=True, kw_only=True)
class Ear(ToneVictim):
    """An ear.

    Args:
        threshold: between low and high tones, in kHz.
    """

    threshold: float = 1.5

    def load(self, seed: int, facts: Facts) -> Listener:
        return Listener(self.threshold).eval()


@dataclass(frozen=True, kw_only=True)
class Down(ToneAttack):
    """Plays everything lower.

    Args:
        share: of the budget.
    """

    access: ClassVar[Access] = "oblivious"
    share: float = 1.0

    def shift(self, tones: Tensor, budget: float) -> Tensor:
        return tones - self.share * budget


class ListeningTrack(Track):
    """Listeners that distinguish high tones from low ones."""

    name: ClassVar[str] = "listening"
    world: ClassVar[str] = "booth"
    victim: ClassVar[str] = "ear"
    episode: ClassVar[tuple[str, str]] = ("melody", "melodies")

    measurements: ClassVar[tuple[Any, ...]] = (
        field("heard", FLOAT, "tones that were heard right", "share, 0 to 1"),
        field("highest_khz", FLOAT, "highest tone that was played", "kHz"),
    )
    metric: ClassVar[str] = "heard"
    metric_title: ClassVar[str] = "tones heard"
    measures: ClassVar[tuple[Measure, ...]] = (Measure(column="highest_khz", heading="highest\nkHz", digits=2),)
    work: ClassVar[str] = "listening_plugin"

    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        listener, attack = job.pair.load(job.training_seed), job.pair.attack.component
        generators = [torch.Generator().manual_seed(seed) for seed in job.seeds]
        tones = torch.stack([job.cell.pitch + torch.rand(job.cell.tones, generator=each) for each in generators])
        played = attack.shift(tones, job.pair.threat.budget) if isinstance(attack, ToneAttack) else tones
        heard = (listener(played) == (tones > 1.5)).double().mean(1)
        columns: Mapping[str, Any] = {
            "seed": np.array(job.seeds),
            "heard": heard.numpy(),
            "highest_khz": played.amax(1).double().numpy(),
        }
        return Driven(columns)
