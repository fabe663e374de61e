"""The driving track: driving policies whose observations are attacked at every step."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cavbench.core import sets
from cavbench.core.pair import Pair, choose
from cavbench.core.track import Baseline, Certified, Contrast, Driven, Job, Measure, Track
from cavbench.driving.sets import Actuator, Held, Latency, Messages, Presence, Traffic
from cavbench.driving.surroundings import Surroundings
from cavbench.errors import UserError
from cavbench.records.schema import FLOAT, NAN_GRADIENTS, PROBES, field
from cavbench.scenarios import Cell

if TYPE_CHECKING:
    from cavbench.driving import DrivingVictim, DrivingWorld
    from cavbench.recording.film import Film

FEW = 3
"""So many fixed features are named in a sentence."""
BEST_BLIND, IDM, CLAIRVOYANT, RANDOM = "best blind", "idm", "clairvoyant", "random"

MEASUREMENTS: tuple[pa.Field, ...] = (
    field("steps", pa.int32(), "decisions until the episode ended", "steps", low=0, at_most="max_steps"),
    field("return", FLOAT, "reward of the world, summed over the episode", "reward"),
    field(
        "safe_progress",
        FLOAT,
        "0 if the ego crashed or left the road, otherwise mean progress over the steps of a full episode",
        "share, 0 to 1",
    ),
    field("crashed", pa.bool_(), "the ego hit another vehicle"),
    field("offroad", pa.bool_(), "the ego left the road"),
    field("distance_m", FLOAT, "driven along the road", "m"),
    field(
        "min_ttc_s", FLOAT, "smallest time to collision with the car ahead; inf if there is none", "s", low=0, high=inf
    ),
    field("mean_speed", FLOAT, "mean over the steps", "m/s"),
    field("queries", FLOAT, "victim evaluations per step, mean", "queries", low=0),
    field("queries_median", FLOAT, "victim evaluations per step, median", "queries", low=0),
    field("queries_max", FLOAT, "victim evaluations per step, maximum", "queries", low=0),
    field("changed", FLOAT, "steps on which the attack changed the decision", "share, 0 to 1"),
    field("linf", FLOAT, "largest deviation of a step, mean over the steps", "normalised, 2 is the full range", low=0),
    field("linf_max", FLOAT, "largest deviation of the episode", "normalised, 2 is the full range", low=0),
    field("l2", FLOAT, "L2 norm of a step's deviation, mean over the steps", "normalised", low=0),
    field("linf_m", FLOAT, "largest deviation of a position in a step, mean over the steps", "m", low=0),
    field("linf_mps", FLOAT, "largest deviation of a velocity in a step, mean over the steps", "m/s", low=0),
    field(
        "excess_max",
        FLOAT,
        "largest distance of the attack's answer outside its perturbation set, before projection",
        "normalised",
        low=0,
    ),
    field(
        "attack_ms",
        FLOAT,
        "wall time of the attack per step and episode (the time of a batch, divided by its episodes)",
        "ms",
        low=0,
    ),
    field(
        "action_counts",
        pa.list_(pa.int32()),
        "how often each discrete action was taken; empty for continuous actions",
        low=0,
        at_most="max_steps",
    ),
)

ASSURED = field(
    "assured",
    FLOAT,
    "frames in which an action was safe under the victim's own assumptions; null if it makes none",
    "share, 0 to 1",
    nullable=True,
    low=0,
    high=1,
)

ALARMS: tuple[pa.Field, ...] = (
    field(
        "suspicion",
        FLOAT,
        "highest suspicion of the victim's monitor; null without one",
        "1 is an alarm",
        nullable=True,
        low=0,
        high=inf,
    ),
    field("alarms", FLOAT, "alarms that the victim's monitor raised; null without one", "alarms", nullable=True, low=0),
    field(
        "alarm_delay_s",
        FLOAT,
        "from the first falsified frame to the next alarm; inf if there is none, null without a monitor or a falsified frame",
        "s",
        nullable=True,
        low=0,
        high=inf,
    ),
)

SHIFT = field(
    "shift",
    FLOAT,
    "L2 norm of all that the threat model lets an attack change in an episode, in units of the noise that the victim adds to its "
    "input; null if it adds none",
    "standard deviations",
    nullable=True,
    low=0,
    high=inf,
)


FORGED = (
    field(
        "hidden",
        FLOAT,
        "cars hidden from the victim, mean over the steps; null if the threat model allows none",
        "cars",
        nullable=True,
        low=0,
    ),
    field("invented", FLOAT, "cars invented, mean over the steps; null as `hidden`", "cars", nullable=True, low=0),
    field(
        "age",
        FLOAT,
        "age of the frame that the victim was shown, mean over the steps; null as `hidden`",
        "decisions",
        nullable=True,
        low=0,
    ),
    field(
        "acted",
        FLOAT,
        "steps on which the car executed another command than the victim's; null as `hidden`",
        "share, 0 to 1",
        nullable=True,
    ),
)
"""What was used of the sets beside changed values."""

TOLD = (
    field(
        "false_messages",
        FLOAT,
        "senders whose messages were forged, repeated or held back, mean over the steps; null as `hidden`",
        "senders",
        nullable=True,
        low=0,
    ),
)

BLAME: tuple[pa.Field, ...] = (
    field(
        "avoidable",
        FLOAT,
        "whether the planner with perfect information, at the wheel from 5 s before the crash, avoids it among the same driven "
        "cars; null without a crash, and where the traffic drives as usual",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "avoidable_idm",
        FLOAT,
        "the same of the IDM driver, which does not know what the driven cars will do",
        "share, 0 to 1",
        nullable=True,
    ),
    field(
        "room",
        FLOAT,
        "distance to the driven car at its last manoeuvre before the crash, over the safe distance of RSS; null without one",
        "safe distances",
        nullable=True,
        low=0,
    ),
)


STRINGS: tuple[pa.Field, ...] = (
    field(
        "min_time_gap_s",
        FLOAT,
        "smallest time to the place of the car ahead, bumper to bumper, at the own speed; null in a world that does not say",
        "s",
        nullable=True,
        low=0,
        high=inf,
    ),
    field(
        "amplification",
        FLOAT,
        "L2 norm of the ego's acceleration over that of the car ahead, from 20 s on; above 1 is not string stable; null as "
        "`min_time_gap_s`, and in shorter episodes",
        "ratio",
        nullable=True,
        low=0,
    ),
    field(
        "amplification_peak",
        FLOAT,
        "the same of the largest accelerations (L-infinity)",
        "ratio",
        nullable=True,
        low=0,
    ),
)
"""What a car in a platoon does to those behind it."""

LATER = (*ALARMS, *FORGED, *BLAME, *STRINGS, *TOLD)
"""Columns that older records lack. New ones come last: a record has its columns in this order."""


class DrivingTrack(Track):
    """Driving policies on a road, attacked through their observations, ranked by `safe_progress`."""

    name: ClassVar[str] = "driving"
    world: ClassVar[str] = "highway"
    victim: ClassVar[str] = "dqn"

    unrepeatable: ClassVar[tuple[str, ...]] = ("attack_ms",)
    measurements: ClassVar[tuple[pa.Field, ...]] = MEASUREMENTS
    probes: ClassVar[tuple[pa.Field, ...]] = (
        *PROBES,
        ASSURED,
        SHIFT,
        NAN_GRADIENTS,
        *LATER,
    )
    later: ClassVar[tuple[str, ...]] = tuple(one.name for one in LATER)
    norms: ClassVar[tuple[str, ...]] = ("relative", "linf")
    sets: ClassVar[Mapping[str, type[Any]]] = {
        "presence": Presence,
        "latency": Latency,
        "held": Held,
        "actuator": Actuator,
        "traffic": Traffic,
        "dynamics": Surroundings,
        "messages": Messages,
    }
    metric: ClassVar[str] = "safe_progress"
    metric_title: ClassVar[str] = "safe progress"
    failure: ClassVar[str] = "crashed"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure(column="return", heading="return\nof {max_steps}"),
        Measure(column="crashed", heading="\ncrashed", unit="share"),
        Measure(column="offroad", heading="off\nroad", unit="share", tables="overview", spare=4),
        Measure(column="avoidable", heading="avoid-\nable", unit="share", of_attack=True, spare=1),
        Measure(column="min_ttc_s", heading="min\nTTC s", how="median", digits=1, tables="overview", spare=6),
        Measure(column="min_time_gap_s", heading="min\ngap s", how="median", digits=2, tables="overview", spare=1),
        Measure(column="amplification", heading="ampli-\nfication", digits=2, tables="overview", spare=1),
        Measure(column="changed", heading="success\n/ step", how="step mean", unit="share", of_attack=True, spare=2),
        Measure(column="queries", heading="queries\n/ step", how="step mean", of_attack=True),
        Measure(column="attack_ms", heading="ms\n/ step", how="step mean", digits=1, of_attack=True, spare=3),
    )
    legend: ClassVar[str] = (
        "safe progress: 0 if the car crashes or leaves the road, otherwise its mean progress. success: share of steps in which "
        "the attack changed the decision. TTC: time to collision with the car ahead. best blind: the best policy that "
        "ignores its input. gap: smallest time gap. amplification: of the accelerations of the car ahead (L2). avoidable: share "
        "of the crashes that a planner with perfect information avoids in the same traffic."
    )
    baseline_kinds: ClassVar[Mapping[str, Baseline]] = {
        BEST_BLIND: Baseline(title="best blind policy", heading="best\nblind", spare=0),
        RANDOM: Baseline(title="random", heading="ran-\ndom"),
        IDM: Baseline(title="IDM and MOBIL", heading="\nIDM"),
        CLAIRVOYANT: Baseline(title="perfect information", heading="per-\nfect"),
    }
    safe_driver: ClassVar[str] = IDM
    perfect: ClassVar[str] = CLAIRVOYANT
    contrast: ClassVar[Contrast | None] = Contrast(
        side="victim",
        baseline=BEST_BLIND,
        title="the best blind policy",
        heading="against\nbest blind",
        short="beats\nblind",
    )
    queries_title: ClassVar[str] = "queries per step"
    excess: ClassVar[str] = "excess_max"
    step_ms: ClassVar[str] = "attack_ms"
    other_input: ClassVar[str] = "another episode's observation"
    facts: ClassVar[Mapping[str, object]] = {
        "decision_hz": 15,
        "max_steps": 450,
        "features": {"names": ["x"], "units": ["m"], "floors": [0.5]},
    }

    work: ClassVar[str] = "cavbench.driving.drive"
    tries_beside: ClassVar[bool] = True

    def baselines(self, pair: Pair) -> Iterator[Pair]:
        """Input-independent policies with the pair's action type, and the IDM driver if the world has one."""
        victim, world = _parts(pair)
        facts, action_type = world.facts, victim.action_type
        drivers = [("blind", {"policy": policy}) for policy in facts.blind_policies(action_type)]
        drivers += [("random", {"actions": action_type})]
        drivers += [(IDM, {})] if IDM in facts.drivers else []
        for name, params in drivers:
            none = {"attack": choose("attack", "none"), "defense": choose("defense", "none")}
            yield replace(pair, **none, victim=choose("victim", name, **params), threat=type(pair.threat).of_nobody())

    def doubts(self, pair: Pair) -> Iterator[str]:
        from cavbench.driving.doubts import doubts

        return doubts(pair, self.world)

    def hopeless(self, baselines: pa.Table) -> str:
        from cavbench.driving.doubts import hopeless

        return hopeless(baselines)

    def baseline_of(self, other: Mapping[str, object], own: Mapping[str, object]) -> str:
        same_world = all(own[name] == other[name] for name in ("world", "world_params"))
        same_actions = own["action_type"] == other["action_type"] or other["victim"] in (IDM, CLAIRVOYANT)
        if (
            other["sees"]
            or other["defense"] != "none"
            or other["attack"] != "none"
            or not (same_world and same_actions)
        ):
            return ""
        return BEST_BLIND if other["victim"] == "blind" else str(other["victim"])

    def allowed(self, norm: str, budget: float, facts: Mapping[str, Any]) -> str:
        norm, others = sets.split(norm)
        deviation = f"{100 * budget:g} % of itself" if norm == "relative" else f"{budget:g} on the [-1, 1] scale"
        features = facts.get("features", {})
        floors = features.get("floors", ()) if norm == "relative" else ()
        minima = [
            f"{name} {floor * budget / 0.1:g} {unit}"
            for name, floor, unit in zip(features.get("names", ()), floors, features.get("units", ()), strict=False)
        ]
        by_floor = f", or by its floor ({', '.join(minima)})" if minima else ""
        fixed = features.get("fixed", ())
        named = fixed if len(fixed) <= FEW else [f"{len(fixed)} fixed features"]
        if any(word.startswith("presence.") for word in others):
            forged = f"{' and '.join(named)} cannot be forged" if named else ""
        else:
            forged = f"{' and '.join(['presence', *named])} cannot be forged"
        return "; ".join(filter(None, (f"each measured value may be off by {deviation}{by_floor}", forged, *others)))

    def effort(self, column: Callable[[str], NDArray[np.float64]]) -> Iterator[tuple[str, str]]:
        steps = column("steps")
        metres, speed = (
            f"{(column(name) * steps).sum() / max(float(steps.sum()), 1.0):.2f}" for name in ("linf_m", "linf_mps")
        )
        yield "moved", f"{metres} m and {speed} m/s: largest deviation per step, on average"
        yield from _blame(*(column(name).ravel() for name in ("avoidable", "avoidable_idm", "safe_progress")))

    def identity(self, pair: Pair) -> Mapping[str, object]:
        return {"action_type": _parts(pair)[0].action_type}

    def try_network(self, network: Any, pair: Pair, cells: Sequence[Cell]) -> list[str]:
        from cavbench.driving.doubts import other_features
        from cavbench.driving.trial import try_policy

        victim, world = _parts(pair)
        if not victim.sees:
            return []
        if why := other_features(pair, self.world):
            raise UserError(why)
        gradients = victim.answers == "gradients"
        return try_policy(
            network, world, cells, gradients=gradients, random=victim.draws or pair.defense.name != "none"
        )

    def drive(self, job: Job, artefact: bytes | None, traced: Sequence[int]) -> Driven:
        from cavbench.driving.drive import drive

        return drive(job, traced)

    def alike(self, job: Job) -> Hashable | None:
        from cavbench.driving.drive import joint

        features = _parts(job.pair)[1].facts_at(job.cell).features
        return (job.pair.id, job.training_seed, job.seeds, features) if joint(job.pair) else None

    def drive_jointly(self, jobs: Sequence[Job], artefacts: Mapping[str, bytes]) -> Sequence[Driven] | None:
        from cavbench.driving.drive import drive_jointly

        return drive_jointly(jobs)

    def certify(
        self, pair: Pair, training_seed: int, cells: Sequence[Cell], seeds: Sequence[int], leaves: int
    ) -> Certified:
        from cavbench.driving.bounds.certify import Certifier

        return Certifier(pair, training_seed, cells, seeds).certify(leaves)

    def record(self, job: Job, trace: Any, meta: Mapping[str, object], path: Path) -> None:
        from cavbench.driving.recording import save

        save(trace, facts=_parts(job.pair)[1].facts_at(job.cell), meta=meta, path=path)

    def film(self, job: Job, trace: Any, meta: Mapping[str, object]) -> Film:
        from cavbench.driving.recording.episode import Episode
        from cavbench.driving.recording.film import EpisodeFilm

        return EpisodeFilm(Episode.of(trace, _parts(job.pair)[1].facts_at(job.cell), meta))


def _blame(
    avoidable: NDArray[np.float64], by_idm: NDArray[np.float64], scores: NDArray[np.float64]
) -> Iterator[tuple[str, str]]:
    """How many crashes of E episodes could have been avoided, and the score without the others; [E] each, NaN without one."""
    judged = np.isfinite(avoidable)
    if not judged.any():
        return
    counted = avoidable != 0
    score = f"{scores[counted].mean():.2f}" if counted.any() else "none"
    yield (
        "blame",
        f"{np.nansum(avoidable):.0f} of {judged.sum()} crashes could have been avoided ({np.nansum(by_idm):.0f} by IDM); "
        f"score without the other crashes: {score}",
    )


def _parts(pair: Pair) -> tuple[DrivingVictim, DrivingWorld]:
    """The victim and the world of a pair, in the types of this track."""
    victim: Any = pair.victim.component
    world: Any = pair.world.component
    return victim, world
