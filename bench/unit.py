"""The unit of work: one pair on every scenario seed of a cell, a pure function of its configuration."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import torch

from bench import registry
from bench.fingerprint import canonical, code_digest, digest, libraries, machine
from bench.pair import Chosen, Pair
from bench.rollout import Columns, Trace, rollout
from bench.scenario import GRIDS, Cell


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One batch of episodes: a pair on every scenario seed of a cell, with one training seed.

    Args:
        pair: attack, defence, victim, world, threat model.
        cell: lanes, density, weather.
        training_seed: of the policy.
        seeds: the scenario seed of each episode.
        weights_sha256: of the policy's weights.
    """

    pair: Pair
    cell: Cell
    training_seed: int
    seeds: range
    weights_sha256: str

    @property
    def attack_seed(self) -> int:
        """Of the attack's random generator: the same for every pair and every order of work."""
        return int(digest([canonical(self.cell), self.training_seed])[:15], 16)

    @property
    def code_digest(self) -> str:
        """Of the source that computes the unit: the framework's and its components', with what they import."""
        return code_digest((__name__, *sorted(type(part.component).__module__ for part in self.parts)))

    @property
    def parts(self) -> tuple[Chosen[Any], ...]:
        """The four components."""
        return self.pair.attack, self.pair.defense, self.pair.victim, self.pair.world

    @property
    def fingerprint(self) -> str:
        """sha256 of everything that decides the result."""
        return digest(
            {
                "pair": self.pair.identity,
                "cell": canonical(self.cell),
                "training_seed": self.training_seed,
                "seeds": [self.seeds.start, self.seeds.stop],
                "weights": self.weights_sha256,
                "code": self.code_digest,
                "shipped_by": [_entry(part).shipped_by for part in self.parts],
                "libraries": libraries(),
            }
        )

    @property
    def grid(self) -> str:
        """The named grid that has this cell and these seeds; `custom` if none has."""
        named = (grid.name for grid in GRIDS.values() if self.cell in grid.cells() and self.seeds == grid.seeds())
        return next(named, "custom")

    def constants(self, wall_s: float) -> dict[str, object]:
        """What every record of the unit says: the columns IDENTITY (but `seed`) and PROVENANCE of `bench.results`."""
        pair, cell, threat = self.pair, self.cell, self.pair.threat
        return {
            "unit": self.fingerprint,
            "pair": pair.id,
            **{part.kind: part.name for part in self.parts},
            **{f"{part.kind}_params": part.params for part in self.parts},
            "action_type": pair.victim.component.action_type,
            "sees": pair.victim.component.sees,
            "training_seed": self.training_seed,
            "threat_norm": threat.norm,
            "threat_budget": float(threat.budget),
            "threat_access": threat.access,
            "threat_queries": threat.queries,
            "grid": self.grid,
            "lanes": cell.lanes,
            "density": float(cell.density),
            "weather": cell.weather,
            **{f"{part.kind}_shipped_by": _entry(part).shipped_by for part in self.parts},
            "weights_sha256": self.weights_sha256,
            "code_digest": self.code_digest,
            "libraries": canonical(libraries()),
            "machine": machine(),
            "created_at": datetime.now(UTC),
            "wall_s": wall_s,
        }

    def __str__(self) -> str:
        seed = f", seed {self.training_seed}" if self.pair.victim.component.learns else ""
        return f"{self.pair} | {self.cell}{seed}"


def drive(unit: Unit, trace: Trace | None = None) -> Columns:
    """Do the work of a unit and return the measurements of its episodes, [B] each (`bench.rollout.rollout`).

    Args:
        unit: what to drive.
        trace: filled with every step of its episodes.
    """
    pair, world = unit.pair, unit.pair.world.component
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(unit.attack_seed)
        policy = pair.defense.component.load(pair.victim.component, unit.training_seed)
        cells = [unit.cell] * len(unit.seeds)
        env = world.make(cells, action_type=policy.action_type, driver=policy.driver)
        try:
            return rollout(
                env,
                policy,
                pair.attack.component,
                pair.threat,
                unit.seeds,
                features=world.features,
                max_steps=world.max_steps,
                attack_seed=unit.attack_seed,
                trace=trace,
            )
        finally:
            env.close(raise_if_closed=False)


def _entry(part: Chosen[Any]) -> registry.Entry:
    return registry.find(registry.GROUPS[part.kind], part.name, part.kind)
