"""The units of work, pure functions of their configuration: a pair on every scenario seed of a cell, and crafting a patch."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from bench.driving.contracts import DrivingVictim
from bench.plugins import registry
from bench.plugins.contracts import Track
from bench.plugins.fingerprint import canonical, code_digest, digest, libraries, machine
from bench.plugins.pair import Chosen, Pair
from bench.scenarios.grid import GRIDS, Cell

WORK: dict[Track, str] = {"driving": "bench.driving.drive", "detection": "bench.detection.approach"}
"""The module that does the work of a track's units."""
CRAFT = "bench.detection.crafting"
"""The module that crafts patches."""


@dataclass(frozen=True, kw_only=True)
class _Work:
    """What units of both kinds have.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: of the victim; of a patch too.
        weights_sha256: of the victim's weights.
    """

    pair: Pair
    training_seed: int
    weights_sha256: str

    @property
    def module(self) -> str:
        """The module that does the work."""
        raise NotImplementedError

    @property
    def modules(self) -> tuple[str, ...]:
        """Those whose source computes it, with all they import."""
        return (__name__, self.module, *sorted(type(part.component).__module__ for part in self.parts))

    @property
    def code_digest(self) -> str:
        """Of the source that computes it: the framework's and its components', with what they import."""
        return code_digest(self.modules)

    @property
    def parts(self) -> tuple[Chosen[Any], ...]:
        """The four components."""
        return self.pair.attack, self.pair.defense, self.pair.victim, self.pair.world

    @property
    def libraries(self) -> dict[str, str]:
        """Versions of what computes it beside that source."""
        return libraries(tuple(sorted({name for part in self.parts for name in part.component.libraries})))

    @property
    def origin(self) -> dict[str, object]:
        """What decides the result."""
        return {
            "pair": self.pair.identity,
            "training_seed": self.training_seed,
            "weights": self.weights_sha256,
            "code": self.code_digest,
            "shipped_by": [_entry(part).shipped_by for part in self.parts],
            "libraries": self.libraries,
        }


@dataclass(frozen=True, kw_only=True)
class Crafting(_Work):
    """One patch of an attack on a defended detector, crafted on the training scenes of a world."""

    module = CRAFT

    @property
    def fingerprint(self) -> str:
        """sha256 of everything that decides the patch."""
        return digest(self.origin)

    @property
    def attack_seed(self) -> int:
        """Of the attack's random generator: the same for every pair."""
        return int(digest(["patch", self.training_seed])[:15], 16)

    def __str__(self) -> str:
        return f"{self.pair} | patch, seed {self.training_seed}"


@dataclass(frozen=True, kw_only=True)
class Unit(_Work):
    """One batch of episodes: a pair on every scenario seed of a cell, with one training seed.

    Args:
        cell: lanes, density, weather.
        seeds: the scenario seed of each episode.
    """

    cell: Cell
    seeds: range

    @property
    def module(self) -> str:
        return WORK[self.pair.track]

    @property
    def attack_seed(self) -> int:
        """Of the attack's random generator: the same for every pair and every order of work."""
        return int(digest([canonical(self.cell), self.training_seed])[:15], 16)

    @property
    def crafting(self) -> Crafting | None:
        """What makes the patch it shows; None where there is none to make."""
        if self.pair.track != "detection" or self.pair.is_clean:
            return None
        return Crafting(pair=self.pair, training_seed=self.training_seed, weights_sha256=self.weights_sha256)

    @property
    def fingerprint(self) -> str:
        """sha256 of everything that decides the result."""
        patch = {"patch": self.crafting.fingerprint} if self.crafting else {}
        scenarios = {"cell": canonical(self.cell), "seeds": [self.seeds.start, self.seeds.stop]}
        return digest(self.origin | scenarios | patch)

    @property
    def grid(self) -> str:
        """The named grid that has this cell and these seeds; `custom` if none has."""
        own = (grid for grid in GRIDS.values() if grid.track == self.pair.track)
        return next((grid.name for grid in own if self.cell in grid.cells() and self.seeds == grid.seeds()), "custom")

    def constants(self, wall_s: float) -> dict[str, object]:
        """What every record of the unit says: the columns IDENTITY (but `seed`) and PROVENANCE of `bench.records.store`."""
        pair, cell, threat = self.pair, self.cell, self.pair.threat
        victim = pair.victim.component
        driver = victim if isinstance(victim, DrivingVictim) else None
        return {
            "unit": self.fingerprint,
            "pair": pair.id,
            **{part.kind: part.name for part in self.parts},
            **{f"{part.kind}_params": part.params for part in self.parts},
            "action_type": driver.action_type if driver else "",
            "sees": driver.sees if driver else True,
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
            "libraries": canonical(self.libraries),
            "machine": machine(),
            "created_at": datetime.now(UTC),
            "wall_s": wall_s,
        }

    def __str__(self) -> str:
        seed = f", seed {self.training_seed}" if self.pair.is_seeded else ""
        return f"{self.pair} | {self.cell}{seed}"


def _entry(part: Chosen[Any]) -> registry.Entry:
    return registry.find(registry.GROUPS[part.kind], part.name, part.kind)
