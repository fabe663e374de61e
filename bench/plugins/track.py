"""What a track is: all that the framework has to know of a kind of victim, in one object.

A track is found by its entry point, `cavbench.tracks`. Nothing else in the framework knows one by name: command line, runner,
records and reports ask the object. Importing a track's module must be quick (no torch): imports stand in its methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from bench.errors import UserError
from bench.plugins import registry
from bench.plugins.contracts import Progress
from bench.plugins.pair import Pair
from bench.scenarios import Cell

Columns = Mapping[str, NDArray[np.generic]]
"""Measurements of B episodes: [B] each, or [B, n] where a column holds lists."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """The work of a track: a pair on every scenario seed of a cell, with one training seed.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: of the victim; of what is prepared too.
        attack_seed: of the attack's random generator.
        cell: where.
        seeds: the scenario seed of each episode.
        artefact: fingerprint of what was prepared for it; empty for nothing.
    """

    pair: Pair
    training_seed: int
    attack_seed: int
    cell: Cell
    seeds: range
    artefact: str = ""


@dataclass(frozen=True)
class Driven:
    """What a job made.

    Args:
        columns: a column [B] a measurement of the track, with `seed`.
        traces: what recordings of some episodes are made of, by scenario seed; only the track knows what is in one.
    """

    columns: Columns
    traces: Mapping[int, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of reports: how the values of a measurement over many episodes become one number.

    Args:
        column: of the records.
        heading: at most two lines; `{max_steps}` and other facts of the world are filled in.
        how: `iqm`: interquartile mean over runs and cells with a bootstrap interval; `mean`; `median`; `rate`: share of the
            episodes for which a flag is set, with a Wilson interval; `step mean`: mean over all steps, of a column that holds the
            mean of each episode.
        unit: `share` is written as a percentage.
        digits: behind the point.
        of_attack: whether it describes the attack, and nothing where there is none.
        with_interval: whether the overview shows its interval.
        tables: which tables have it: `overview` (a row an attack), `cells` (a row a cell), or `both`.
        spare: columns are left out of a narrow terminal from the highest number down; 0 stays.
    """

    column: str
    heading: str
    how: Literal["iqm", "mean", "rate", "step mean", "median"] = "mean"
    unit: Literal["", "share"] = ""
    digits: int = 0
    of_attack: bool = False
    with_interval: bool = False
    tables: Literal["overview", "cells", "both"] = "both"
    spare: int = 0


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """What reports call a baseline (`Track.baseline_of`).

    Args:
        title: in a row or a sentence.
        heading: of its column, at most two lines.
        spare: as in `Measure`.
    """

    title: str
    heading: str
    spare: int = 5


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """The baseline that scores under attack are compared with, scenario by scenario, and who has to do better than it.

    Args:
        side: `victim`: the victim under attack must score above a baseline that ignores its input. `attack`: the score must fall
            below that under a baseline attack, which knows nothing of the victim.
        baseline: its name; empty for the one with the lowest score of those that were driven.
        title: of the baseline in a sentence, with its article.
        heading: of the column of differences, at most two lines.
        short: of a column of marks, at most two lines.
    """

    side: Literal["victim", "attack"]
    baseline: str = ""
    title: str
    heading: str
    short: str = ""


class Track(ABC):
    """A kind of victim, with everything that is special about it."""

    name: ClassVar[str]
    """As in the `track` of its base classes."""
    world: ClassVar[str]
    """Name of the world that a run uses when it is not told otherwise."""
    victim: ClassVar[str] = ""
    """Name of a victim to show in examples; empty for none."""
    episode: ClassVar[tuple[str, str]] = ("scenario", "scenarios")
    """What an episode is called: one, and several."""
    run: ClassVar[str] = "training seed"
    """What tells the runs of a pair apart."""
    artefact: ClassVar[tuple[str, str] | None] = None
    """What is prepared once for a pair and training seed, before its cells are driven: one, and several.

    Records have a column named after one of them, with its fingerprint; they are kept in a folder named after several.
    """

    unrepeatable: ClassVar[tuple[str, ...]] = ()
    """Measurements that no replay can repeat: wall times, and names that change with the code."""
    measurements: ClassVar[tuple[pa.Field, ...]]
    """The columns of its records, beside those that every track has (`bench.records.schema`)."""
    probes: ClassVar[tuple[pa.Field, ...]] = ()
    """More of them, that may be null: what the flags of a leaderboard are measured by."""
    facts_of_v1: ClassVar[Mapping[str, object]] = {}
    """What its world was when records did not say (version 1); empty for a track that is younger."""
    metric: ClassVar[str]
    """The measurement it is ranked by, in [0, 1], more is better for the victim."""
    metric_title: ClassVar[str]
    """What reports call it."""
    failure: ClassVar[str] = ""
    """The measurement, a flag, that is the worst that can happen to the victim: a crash, a sign that is run."""
    measures: ClassVar[tuple[Measure, ...]] = ()
    """The columns of its reports, beside the metric."""
    legend: ClassVar[str] = ""
    """What a reader of its tables has to know."""
    baseline_kinds: ClassVar[Mapping[str, Baseline]] = {}
    """What reports call its baselines (`baseline_of`), in their order."""
    contrast: ClassVar[Contrast | None] = None
    """The baseline that a pair under attack is compared with; None where there is none."""
    place: ClassVar[str] = ""
    """The measurement that names where an episode takes place; tables of a pair have a row for each. Empty for none."""
    queries: ClassVar[str] = "queries"
    """The measurement that counts what an attack asked the victim."""
    queries_title: ClassVar[str] = "queries"
    """What reports call it, for instance queries a step."""
    gradients: ClassVar[str] = "gradient_queries"
    """The measurement, or probe, that counts the gradients among them."""
    excess: ClassVar[str] = ""
    """The measurement of how far an attack's answers were outside its perturbation set; empty for none."""
    step_ms: ClassVar[str] = ""
    """The measurement of an attack's wall time a decision, in milliseconds; empty for none."""
    enough_episodes: ClassVar[int] = 20
    """Scenarios a cell below which a leaderboard flags a score."""
    other_input: ClassVar[str] = "another input"
    """What the probe `same_answer` shows the victim instead of its input."""
    many_draws: ClassVar[str] = ""
    """Why every attack sees many draws of a random victim, as a sentence; empty where it has to ask again to see them."""

    work: ClassVar[str]
    """The module that computes its records: its source, with all it imports, is what they outdate with."""
    preparation: ClassVar[str] = ""
    """The module that makes its artefacts."""

    def baselines(self, pair: Pair) -> Iterator[Pair]:
        """The pairs that a pair is compared with, and which every run drives beside it."""
        yield from ()

    def baseline_of(self, other: Mapping[str, object], own: Mapping[str, object]) -> str:
        """The name under which records are a baseline for others; empty if they are none. A baseline is one for itself too.

        Args:
            other: the identity columns of a record of what may be a baseline.
            own: those of what is compared.
        """
        return ""

    def allowed(self, norm: str, budget: float, facts: Mapping[str, Any]) -> str:
        """What a perturbation budget allows, in words.

        Args:
            norm: of the threat model.
            budget: of the threat model.
            facts: of the world, as records have them (`world_facts`).
        """
        return f"a perturbation of at most {budget:g}"

    def effort(self, column: Callable[[str], NDArray[np.float64]]) -> Iterator[tuple[str, str]]:
        """What an attack did or cost, each as a word and a sentence.

        Args:
            column: gives the values of a measurement in all its episodes.
        """
        yield from ()

    def identity(self, pair: Pair) -> Mapping[str, object]:
        """The columns of a record's identity that only this track fills: `action_type`."""
        return {"action_type": ""}

    def prepare(self, job: Job, made_by: str, progress: Progress) -> bytes:
        """Make the `artefact` of a job's pair and training seed: the content of a safetensors file.

        Args:
            job: whose pair it is of; its cell and scenario seeds do not matter.
            made_by: canonical JSON of what decides it, to be kept in the file.
            progress: told how far it is.

        Raises:
            UserError: if it cannot be made.
        """
        raise NotImplementedError(f"the {self.name} track prepares nothing")

    @abstractmethod
    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        """Do the work of a job.

        Args:
            job: what to do.
            artefact: what `prepare` made; None where there is nothing to prepare.
            traced: scenario seeds of the episodes that a recording is wanted of.
        """

    def record(self, job: Job, trace: Any, meta: Mapping[str, object], path: Path) -> None:
        """Write the recording of an episode.

        Args:
            job: that it is of.
            trace: what `drive` kept of it.
            meta: the identity columns of its record.
            path: of the `.rrd` file, in a folder that exists.
        """
        raise NotImplementedError(f"the {self.name} track makes no recordings")


@cache
def track(name: str) -> Track:
    """The track of this name.

    Raises:
        UserError: if there is none, or if what its entry point names is no track.
    """
    found = registry.resolve(registry.TRACKS, name, "track")
    if not (isinstance(found, type) and issubclass(found, Track)):
        raise UserError(f"track {name!r} is not a subclass of bench.plugins.track.Track")
    return found()


def tracks() -> list[Track]:
    """Every track that is installed, by name."""
    return [track(name) for name in registry.entries(registry.TRACKS)]


def track_of(pair: Pair) -> Track:
    """The track of a pair's victim."""
    return track(pair.track)
