"""A track: everything that the framework needs to know about a kind of victim, in one object.

Tracks are found by their entry points, `cavbench.tracks`. Command line, runner, records and reports ask the object; none of them
knows a track by name. Importing a track's module must be quick: put imports of torch into the methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cavbench.core import registry
from cavbench.core.contracts import Progress
from cavbench.core.pair import Pair
from cavbench.errors import UserError
from cavbench.scenarios import Cell

Columns = Mapping[str, NDArray[np.generic]]
"""Measurements of B episodes: [B] each, or [B, n] where a column holds lists."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """The work of a track: a pair on every scenario seed of a cell, with one training seed.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: seed of the victim and of the artefact.
        attack_seed: seed of the attack's random generator.
        cell: cell of the grid.
        seeds: the scenario seed of each episode.
        artefact: fingerprint of the artefact that was prepared for it; empty if there is none.
        entropy: seed of the moments at which the victim is probed, drawn when the work is done; no measurement depends on it.
        device: where the victim computes: `cpu` or `cuda`.
    """

    pair: Pair
    training_seed: int
    attack_seed: int
    cell: Cell
    seeds: range
    artefact: str = ""
    entropy: int = 0
    device: str = "cpu"


@dataclass(frozen=True)
class Driven:
    """The result of a job.

    Args:
        columns: one column [B] for each measurement of the track, and `seed`.
        traces: by scenario seed, the data for recordings of some episodes, in a format of the track.
    """

    columns: Columns
    traces: Mapping[int, object] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Certified:
    """What is proven of a victim in S scenarios, one value each.

    Args:
        seeds: scenario seeds.
        interval, linear: share of the frames without an attack whose decision no attack can change, by bounds with intervals
            and by linear bounds.
        changed: share of these frames in which the given attack changes the decision.
        clean: score without an attack.
        bound: lower bound of the score under every attack; 0 where the search was given up, NaN where there was none.
        given_up: where there were more courses than the search may drive.
    """

    seeds: NDArray[np.int64]
    interval: NDArray[np.float64]
    linear: NDArray[np.float64]
    changed: NDArray[np.float64]
    clean: NDArray[np.float64]
    bound: NDArray[np.float64]
    given_up: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Measure:
    """A column of reports: how a measurement is aggregated over episodes.

    Args:
        column: column of the records.
        heading: at most two lines; may contain facts of the world, such as `{max_steps}`.
        how: `mean`: over all episodes, with its interval; of a flag it is the rate. `median`, and `step mean` (over all steps,
            from a column of episode means) have no interval.
        unit: `share` is shown as a percentage.
        digits: decimal places.
        of_attack: whether it describes the attack; it is empty for clean runs.
        with_interval: whether the overview shows its interval.
        tables: tables that show it: `overview` (one row per attack), `cells` (one row per cell), or `both`.
        spare: a narrow terminal drops the columns with the highest numbers first; 0 is never dropped.
        ranked: whether leaderboards show it beside the score, of the attack that is the strongest in most cells.
    """

    column: str
    heading: str
    how: Literal["mean", "step mean", "median"] = "mean"
    unit: Literal["", "share"] = ""
    digits: int = 0
    of_attack: bool = False
    with_interval: bool = False
    tables: Literal["overview", "cells", "both"] = "both"
    spare: int = 0
    ranked: bool = False


@dataclass(frozen=True, kw_only=True)
class Baseline:
    """The names of a baseline (`Track.baseline_of`) in reports.

    Args:
        title: name in a row or a sentence.
        heading: heading of its column, at most two lines.
        spare: as in `Measure`.
    """

    title: str
    heading: str
    spare: int = 5


@dataclass(frozen=True, kw_only=True)
class Contrast:
    """The baseline that scores under attack are compared with, scenario by scenario.

    Args:
        side: who must beat the baseline. `victim`: the victim under attack must score above an input-independent policy.
            `attack`: the score must fall below the score under a baseline attack that is not optimised against the victim.
        baseline: its name; empty for the baseline with the lowest score.
        title: its name in a sentence, with article.
        heading: heading of the column of differences, at most two lines.
        short: heading of a column of marks, at most two lines.
    """

    side: Literal["victim", "attack"]
    baseline: str = ""
    title: str
    heading: str
    short: str = ""


class Track(ABC):
    """A kind of victim, with everything that is specific to it."""

    name: ClassVar[str]
    """Its name, equal to `track` of its base classes."""
    world: ClassVar[str]
    """Name of the default world of a run."""
    victim: ClassVar[str] = ""
    """Name of a victim for examples; empty for none."""
    episode: ClassVar[tuple[str, str]] = ("scenario", "scenarios")
    """The word for an episode: singular and plural."""
    run: ClassVar[str] = "training seed"
    """The word for what distinguishes the runs of a pair."""
    artefact: ClassVar[tuple[str, str] | None] = None
    """The word for what is prepared once per pair and training seed, before its cells are driven: singular and plural.

    The singular names the column of records that holds its fingerprint, the plural the folder of its files.
    """

    unrepeatable: ClassVar[tuple[str, ...]] = ()
    """Measurements that a replay cannot reproduce: wall times, and fingerprints that change with the code."""
    measurements: ClassVar[tuple[pa.Field, ...]]
    """The columns of its records, in addition to those of all tracks (`cavbench.records.schema`)."""
    probes: ClassVar[tuple[pa.Field, ...]] = ()
    """Further columns, which may be null, for the flags of a leaderboard."""
    later: ClassVar[tuple[str, ...]] = ()
    """Those of `probes` that older records do not have."""
    norms: ClassVar[tuple[str, ...]] = ()
    """The norms of its threat models; records with another one are refused. Empty: any name."""
    sets: ClassVar[Mapping[str, type[Any]]] = {}
    """The sets of its threat models beside the perturbation of values (`cavbench.core.sets`), by name."""
    facts: ClassVar[Mapping[str, object]] = {}
    """Facts of its worlds (`world_facts`), with values of their types: records with facts of other types are refused."""
    metric: ClassVar[str]
    """The ranking metric: a measurement in [0, 1], higher is better for the victim."""
    metric_title: ClassVar[str]
    """Name of the metric in reports."""
    blind_at_zero: ClassVar[tuple[str, str]] = ("", "")
    """A measurement that is 0 in every episode of a victim that sees nothing, and what is said then; if empty, the metric."""
    failure: ClassVar[str] = ""
    """The boolean measurement of the worst failure: a crash, or running the sign; empty for none."""
    measures: ClassVar[tuple[Measure, ...]] = ()
    """The columns of its reports, in addition to the metric."""
    legend: ClassVar[str] = ""
    """Explains the columns of its tables."""
    baseline_kinds: ClassVar[Mapping[str, Baseline]] = {}
    """The names of its baselines (`baseline_of`) in reports, in order."""
    safe_driver: ClassVar[str] = ""
    """The baseline whose rate of `failure` is what safe means; empty for none."""
    perfect: ClassVar[str] = ""
    """The baseline that knows all: with that of `contrast` it makes the scale on which worlds are compared. Empty for none."""
    contrast: ClassVar[Contrast | None] = None
    """The baseline that attacked pairs are compared with; None for none."""
    certificates: ClassVar[str] = ""
    """The list of what is certified of an episode, in [0, 1], frame by frame; reports draw its histogram. Empty for none."""
    place: ClassVar[str] = ""
    """The measurement that names the location of an episode; tables of a pair have one row per location. Empty for none."""
    queries: ClassVar[str] = "queries"
    """The measurement that counts the queries of an attack."""
    queries_title: ClassVar[str] = "queries"
    """Its name in reports, for instance "queries per step"."""
    gradients: ClassVar[str] = "gradient_queries"
    """The measurement or probe that counts the gradients of an attack."""
    excess: ClassVar[str] = ""
    """The measurement of how far an attack left its perturbation set before projection; empty for none."""
    step_ms: ClassVar[str] = ""
    """The measurement of an attack's wall time per decision in milliseconds; empty for none."""
    enough_episodes: ClassVar[int] = 20
    """A leaderboard flags scores with fewer scenarios per cell."""
    other_input: ClassVar[str] = "another input"
    """The input that the probe `same_answer` substitutes."""
    many_draws: ClassVar[str] = ""
    """Why every attack sees many draws of a random victim, as a sentence; empty if it must repeat queries to see them."""

    work: ClassVar[str]
    """The module that computes its records; a change of its source, or of what it imports, outdates them."""
    tries_beside: ClassVar[bool] = False
    """Whether worker processes may load its networks, several at once: none is downloaded."""
    preparation: ClassVar[str] = ""
    """The module that computes its artefacts; empty if it has none."""

    def baselines(self, pair: Pair) -> Iterator[Pair]:
        """The baseline pairs that a pair is compared with; every run also drives these."""
        yield from ()

    def doubts(self, pair: Pair) -> Iterator[str]:
        """What makes scores of a pair doubtful whatever the cell, one line each; a run says it before it drives."""
        yield from ()

    def hopeless(self, baselines: pa.Table) -> str:
        """What to say if the records of all baselines of a run show nothing but failures; empty otherwise."""
        return ""

    def baseline_of(self, other: Mapping[str, object], own: Mapping[str, object]) -> str:
        """The name of the baseline that records are for other records, themselves included; empty if they are not one.

        Args:
            other: identity columns of the possible baseline.
            own: identity columns of the records to compare with it.
        """
        return ""

    def allowed(self, norm: str, budget: float, facts: Mapping[str, Any]) -> str:
        """Describe what a perturbation budget allows.

        Args:
            norm: norm of the threat model.
            budget: budget of the threat model.
            facts: facts of the world, as in records (`world_facts`).
        """
        return f"a perturbation of at most {budget:g}"

    def effort(self, column: Callable[[str], NDArray[np.float64]]) -> Iterator[tuple[str, str]]:
        """Describe what an attack did or cost, each as a keyword and a sentence.

        Args:
            column: returns the values of a measurement in all its episodes.
        """
        yield from ()

    def identity(self, pair: Pair) -> Mapping[str, object]:
        """The identity columns of records that depend on the track: `action_type`."""
        return {"action_type": ""}

    def prepare(self, job: Job, made_by: str, progress: Progress) -> bytes:
        """Make the `artefact` of a pair and training seed: the content of a safetensors file.

        Args:
            job: the job that needs it; its cell and scenario seeds matter only where the attacker knows them
                (`ThreatModel.known`).
            made_by: canonical JSON of everything that determines it, to be stored in the file.
            progress: called with the progress.

        Raises:
            UserError: if it cannot be made.
        """
        raise NotImplementedError(f"the {self.name} track prepares nothing")

    @abstractmethod
    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        """Carry out a job.

        Args:
            job: the job.
            artefact: the result of `prepare`; None if nothing is prepared.
            traced: scenario seeds of the episodes to record.
        """

    def alike(self, job: Job) -> Hashable | None:
        """What jobs have in common that may be given to `drive_jointly`; None for a job that is carried out alone."""
        return None

    def drive_jointly(self, jobs: Sequence[Job], artefacts: Mapping[str, bytes]) -> Sequence[Driven] | None:
        """Carry out jobs that are alike in one batch, which is faster, with the results that each has alone.

        Args:
            jobs: the jobs.
            artefacts: the results of `prepare`, by `Job.artefact`.

        Returns:
            None if they must be carried out one by one.
        """
        return None

    def certify(
        self, pair: Pair, training_seed: int, cells: Sequence[Cell], seeds: Sequence[int], leaves: int
    ) -> Certified:
        """Prove what no attack within the threat model can change.

        Args:
            pair: the defended victim, the world, the threat model, and an attack that is compared with the bounds.
            training_seed: training seed of the victim.
            cells, seeds: cell and seed of each scenario [S].
            leaves: courses of a scenario that are driven at most; 0 bounds frames alone.

        Raises:
            UserError: if the decisions of the victim cannot be bounded.
        """
        raise UserError(f"the {self.name} track has no bounds of decisions: choose a driver, for instance victim=dqn")

    def try_network(self, network: Any, pair: Pair, cells: Sequence[Cell]) -> list[str]:
        """Try the loaded network of a pair before a run: is it what attacks, probes and replays rely on?

        Args:
            network: the defended victim; it is not driven afterwards.
            pair: the pair.
            cells: cells of the run.

        Returns:
            Warnings, each the end of a sentence that begins with the network.

        Raises:
            UserError: the end of such a sentence, if its score would be wrong.
        """
        return []

    def paper(self, action: Literal["print", "scan"], names: list[str], values: dict[str, str], console: Any) -> None:
        """Put an artefact on paper, or read it back from a scan.

        Args:
            action: which of the two.
            names: the file.
            values: options by name, as typed.
            console: to print to.

        Raises:
            UserError: if it cannot be done; `NotImplementedError` if nothing of this track can be printed.
        """
        raise NotImplementedError(f"nothing of the {self.name} track can be printed")

    def record(self, job: Job, trace: Any, meta: Mapping[str, object], path: Path) -> None:
        """Write the recording of an episode.

        Args:
            job: job of the episode.
            trace: its trace from `drive`.
            meta: the identity columns of its record.
            path: path of the `.rrd` file, in an existing folder.
        """
        raise NotImplementedError(f"the {self.name} track makes no recordings")

    def film(self, job: Job, trace: Any, meta: Mapping[str, object]) -> Any:
        """The film of an episode, a `cavbench.recording.film.Film`; arguments as in `record`.

        Raises:
            UserError: if the track makes no films.
        """
        raise UserError(f"the {self.name} track makes no films; leave out --save to look at its recordings")


@cache
def track(name: str) -> Track:
    """The track of this name.

    Raises:
        UserError: if there is no such track, or its entry point is not a track.
    """
    kind = registry.resolve(registry.TRACKS, name, "track")
    if not (isinstance(kind, type) and issubclass(kind, Track)):
        raise UserError(f"track {name!r} is not a subclass of cavbench.core.track.Track")
    return kind()


def tracks() -> list[Track]:
    """All installed tracks, by name."""
    return [track(name) for name in registry.entries(registry.TRACKS)]


def track_of(pair: Pair) -> Track:
    """The track of a pair's victim."""
    return track(pair.track)
