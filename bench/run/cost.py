"""What a run will cost, known before it does anything: episodes, CPU time, wall time and disk.

It is computed from a table of measured costs, `costs.json`, which `python benchmarks/costs.py` renews. A batch costs a part of
its own and a part for each episode. Both are known for an attack on a defended victim in the usual world. Another world has
costs of its own, and asks the pair as often as it has decisions.
What the units of a run really take corrects the estimate while it goes on (`cavbench.run.forecast`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from statistics import median
from typing import TYPE_CHECKING, Any

from cavbench.core.names import split
from cavbench.core.parameters import parameters
from cavbench.records.packing import UNITS
from cavbench.run.batches import batches
from cavbench.run.process import cores
from cavbench.run.racing import dearest
from cavbench.run.task import Task
from cavbench.run.unit import Unit

if TYPE_CHECKING:
    from cavbench.core.pair import Pair

EFFORT = {"steps": 1.0, "restarts": 1.0, "directions": 1.0, "views": 1.0, "batch": 1.0, "window": 1.0, "horizon": 1.0}
"""Parameters of attacks that their cost grows with, and by which power."""
LIKE = {
    "driving": {"oblivious": "noise", "decisions": "zo", "scores": "zo", "gradients": "pgd", "dynamics": "plan"},
    "detection": {"oblivious": "noise_patch", "scores": "square_patch", "gradients": "eot"},
}
"""By track and by the access that it needs, the attack that stands for one whose cost nobody measured."""
SAME = {"plain_patch": "grey_patch"}
"""Attacks that do the same work as a measured one: only the colour differs."""
START_S = 6.0
"""CPU seconds until the first unit begins: imports, and the networks."""
UNIT_BYTES, EPISODE_BYTES, RECORDING_BYTES, ARTEFACT_BYTES = 46_000, 300, 700_000, 130_000
"""On disk: the file of a unit, an episode in a packed file, a recording, and a patch."""
HOUR = 3600.0


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a run will cost.

    Args:
        pairs: attacked pairs, or those that were asked for.
        episodes: all of them.
        controls: those of clean controls that were not asked for.
        baselines: those of baselines.
        cpu_s: CPU seconds of all.
        workers: worker processes that have something to do.
        disk_bytes: what the results folder will have.
        unknown: components whose cost nobody measured.
        at_most: whether it may drive less (`until`, or a race).
        by_pair: episodes and CPU seconds of each pair that is driven, by its `id`.
    """

    pairs: int
    episodes: int
    controls: int
    baselines: int
    cpu_s: float
    workers: int
    disk_bytes: int
    unknown: tuple[str, ...] = ()
    at_most: bool = False
    by_pair: Mapping[str, tuple[int, float]] = field(default_factory=dict)

    @property
    def wall_s(self) -> float:
        """Seconds until the run is done, if its workers have a core each."""
        return START_S + self.cpu_s / max(1, min(self.workers, cores()))

    def __str__(self) -> str:
        parts = [counted(self.controls, "control")] * bool(self.controls)
        parts += [counted(self.baselines, "baseline")] * bool(self.baselines)
        others = f" ({' and '.join(parts)} among them)" if parts else ""
        what = f"{counted(self.pairs, 'pair')}, {counted(self.episodes, 'episode')}{others}"
        where = f" with {self.workers} workers" if self.workers > 1 else ""
        most = "at most " if self.at_most else ""
        cost = (
            f"{most}about {spoken(self.cpu_s + START_S)} of CPU, {spoken(self.wall_s)}{where}, {size(self.disk_bytes)}"
        )
        unknown = f"; a guess, because nobody measured {', '.join(self.unknown)}" if self.unknown else ""
        return f"{what}: {cost}{unknown}"


def counted(number: int, noun: str) -> str:
    """A number with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def spoken(seconds: float) -> str:
    """A time in one word and a unit: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90:
        return f"{max(seconds, 1):.0f} s"
    if seconds < 1.5 * HOUR:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / HOUR:.1f} h" if seconds < 48 * HOUR else f"{seconds / HOUR / 24:.1f} days"


def size(count: float) -> str:
    """A number of bytes: 2 MB, 1.4 GB."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{max(count / 1e6, 1):.0f} MB"


Rows = Mapping[str, Mapping[str, Mapping[str, float]]]


@cache
def table() -> dict[str, Any]:
    """The measured costs by track."""
    return dict(json.loads((files("cavbench.run") / "costs.json").read_text(encoding="utf-8")))


@dataclass(frozen=True)
class Rates:
    """What a pair costs, in CPU seconds.

    Args:
        artefact: of what is prepared once for each training seed.
        batch: of each batch that drives all steps; it ends with its longest episode.
        episode: of each episode in it.
        unknown: its components whose cost nobody measured.
        length: mean length of an episode, as a share of all steps.
        alone: whether each unit is a batch of its own, because the victim's answers depend on the batch.
    """

    artefact: float
    batch: float
    episode: float
    unknown: tuple[str, ...] = ()
    length: float = 1.0
    alone: bool = False

    def of(self, episodes: int) -> float:
        """A batch of so many episodes."""
        return self.batch * longest(self.length, episodes) + self.episode * episodes


@cache
def longest(length: float, episodes: int) -> float:
    """How long the longest of so many episodes is, as a share of all steps, if at every step as many fail as at another.

    Args:
        length: their mean length, as a share of all steps.
        episodes: how many there are.
    """
    if length >= ENDURING:
        return 1.0
    low, high = 0.0, 1.0 / length
    for _ in range(30):
        rate = (low + high) / 2
        low, high = (rate, high) if -math.expm1(-rate) / rate > length else (low, rate)
    steps = 100
    return sum(1 - (-math.expm1(-rate * (step + 0.5) / steps)) ** episodes for step in range(steps)) / steps


ENDURING = 0.99
"""Episodes that are so long on average go to the end."""


def rates(pair: Pair) -> Rates:
    """The costs of a pair, from those that were measured of it, or of pairs like it."""
    known = table().get(pair.track)
    if known is None:
        return Rates(0.0, 0.5, 0.1, (f"the track {pair.track}",))
    rows: Rows = known["rows"]
    attack, unknown = SAME.get(pair.attack.name, pair.attack.name), []
    measured = {name for row in rows.values() for name in row}
    if attack not in measured:
        unknown.append(attack)
        attack = LIKE.get(pair.track, {}).get(pair.attack.component.access, "none")
    defense, victim = pair.defense.name, pair.victim.name
    own = victim if defense == "none" else f"{victim}+{defense}"
    if own not in rows:
        unknown += [
            link for link in split(defense) if link != "none" and not any(link in row.split("+") for row in rows)
        ]
    times = effort(pair.attack.component)
    batch, episode, artefact = (_of_row(rows, own, attack, kind) for kind in ("batch", "episode", "artefact"))
    worlds: Mapping[str, Mapping[str, float]] = known.get("worlds", {})
    if not worlds:
        return Rates(artefact * times, batch, episode, tuple(unknown))
    if pair.world.name not in worlds:
        unknown.append(pair.world.name)
    usual = worlds[HOME]
    here = worlds.get(pair.world.name, usual)
    # An attack with twice the steps asks twice as often, while the world moves as before.
    times *= getattr(pair.world.component, "max_steps", STEPS) / STEPS
    batch = here["batch"] + max(batch - usual["batch"], 0.0) * times
    episode = here["episode"] + max(episode - usual["episode"], 0.0) * times
    length = _of_row(rows, own, attack, "length") or 1.0
    # Answers may be the same in every batch, and gradients not.
    asks = "pgd" if pair.attack.component.access in ("gradients", "dynamics") else "none"
    costs = rows.get(own, {})
    alone = bool(costs.get(attack, costs.get(asks, {})).get("alone"))
    return Rates(0.0, batch, episode, tuple(unknown), _there(length, usual, here), alone)


def _there(length: float, usual: Mapping[str, float], here: Mapping[str, float]) -> float:
    """The length of episodes in another world, from that in the usual one.

    Between a clean drive and one under `pgd`, which are known of both worlds, it is as far on.
    """
    if not all(name in world for name in ("length", "attacked") for world in (usual, here)):
        return length
    on = (usual["length"] - length) / (usual["length"] - usual["attacked"] or 1.0)
    return min(max(here["length"] + on * (here["attacked"] - here["length"]), 0.02), 1.0)


HOME, STEPS = "highway", 450
"""The world that rows of driving are measured in, and the decisions of its episodes."""


def _of_row(rows: Rows, own: str, attack: str, kind: str) -> float:
    """The seconds of an attack on a defended victim: its own, or those on others times how much dearer it is otherwise."""
    if (found := rows.get(own, {}).get(attack, {}).get(kind)) is not None:
        return found
    others = {name: row[attack][kind] for name, row in rows.items() if kind in row.get(attack, {})}
    if not others:
        return 0.0
    if own in rows:
        name, ratios = max(
            ((name, _ratios(rows[own], rows[name], kind)) for name in others), key=lambda one: len(one[1])
        )
        if ratios:
            return others[name] * median(ratios)
    victim, _, defense = own.partition("+")
    for part in (defense, victim):
        alike = [
            cost for name, cost in others.items() if part and part in (name.partition("+")[0], name.partition("+")[2])
        ]
        if alike:
            return median(alike)
    return median(others.values())


def _ratios(own: Mapping[str, Mapping[str, float]], other: Mapping[str, Mapping[str, float]], kind: str) -> list[float]:
    """How many times as dear as another row a row is, under each attack that both have."""
    return [own[name][kind] / other[name][kind] for name in own if other.get(name, {}).get(kind) and kind in own[name]]


def effort(attack: Any) -> float:
    """How many times as much as with its default parameters an attack does."""
    found = 1.0
    for name, parameter in parameters(type(attack)).items():
        value, usual = getattr(attack, name), parameter.default
        if name in EFFORT and usual and isinstance(value, (int, float)) and isinstance(usual, (int, float)):
            found *= (value / usual) ** EFFORT[name]
    return found


def shares(units: Sequence[Unit], workers: int, recorded: Collection[str] = ()) -> list[float]:
    """The CPU seconds of each unit; of several in one batch each has its share of that.

    Args:
        units: the units.
        workers: number of worker processes.
        recorded: fingerprints of the units that are recorded, which are driven alone; none if they are not known yet.
    """
    alike = batches([Task(unit=unit) for unit in units], recorded, workers)
    found: dict[int, float] = {}
    known: dict[str, Rates] = {}
    for batch in alike:
        own = known.setdefault(batch[0].pair.id, rates(batch[0].pair))
        episodes = sum(len(task.unit.seeds) for task in batch)
        for task in batch:
            size = len(task.unit.seeds)
            found[id(task.unit)] = own.of(size) if own.alone else own.of(episodes) * size / episodes
    return [found[id(unit)] for unit in units]


def preparing_s(unit: Unit) -> float:
    """The CPU seconds of what is prepared for a unit; an attacker who knows the scenarios prepares something for each."""
    return rates(unit.pair).artefact * (1 if unit.known is None else len(unit.seeds))


def cost_of(plan: Any) -> Cost:
    """What a `cavbench.run.plan.Plan` costs, all of it; of a run with `until` the most. No network is loaded for it."""
    asked = {pair.id for pair in plan.pairs}
    baselines = {pair.id for pair in plan.baselines} - asked
    every = {pair.id: rates(pair) for pair in plan.driven}
    weights = {task.unit.networks: ("", "") for task in plan.loadings}
    units = [unit for part in plan.rounds for unit in part.units(weights)]
    units = dearest(plan, units, lambda pair: every[pair.id].episode)
    workers = 1 if plan.executor == "serial" else plan.workers or cores()
    made = {
        (unit.pair.id, unit.training_seed, unit.known): preparing_s(unit)
        for unit in units
        if every[unit.pair.id].artefact
    }
    by_pair = dict.fromkeys(every, (0, 0.0))
    for (name, *_), seconds in made.items():
        by_pair[name] = (0, by_pair[name][1] + seconds)
    for unit, seconds in zip(units, shares(units, workers), strict=True):
        before = by_pair[unit.pair.id]
        by_pair[unit.pair.id] = (before[0] + len(unit.seeds), before[1] + seconds)
    episodes = sum(count for count, _ in by_pair.values())
    return Cost(
        pairs=len(plan.pairs),
        episodes=episodes,
        controls=sum(count for name, (count, _) in by_pair.items() if name not in asked | baselines),
        baselines=sum(count for name, (count, _) in by_pair.items() if name in baselines),
        cpu_s=sum(seconds for _, seconds in by_pair.values()),
        workers=min(workers, max(1, len(units))),
        disk_bytes=_disk(plan, units, episodes) + len(made) * ARTEFACT_BYTES,
        unknown=tuple(dict.fromkeys(name for one in every.values() for name in one.unknown)),
        at_most=plan.until is not None or bool(plan.racing),
        by_pair=by_pair,
    )


def _disk(plan: Any, units: Sequence[Unit], episodes: int) -> int:
    recorded = len(plan.pairs) * (1 if plan.record is None else plan.record * len(plan.grid.cells()))
    loose = len(units) % UNITS
    return loose * UNIT_BYTES + episodes * EPISODE_BYTES + recorded * RECORDING_BYTES
