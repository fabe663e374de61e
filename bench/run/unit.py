"""Units of work, pure functions of their configuration: a pair on every scenario seed of a cell."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

from cavbench.core import registry
from cavbench.core.device import CPU, said
from cavbench.core.pair import Chosen, Pair
from cavbench.core.track import Job, Track, track_of
from cavbench.identity.fingerprint import canonical, code_digest, digest, libraries, machine
from cavbench.records.schema import AUDIT, SEQUENTIAL
from cavbench.scenarios import Cell, SeedBlock


@dataclass(frozen=True, kw_only=True)
class Unit:
    """One batch of episodes: a pair on every scenario seed of a cell, with one training seed.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: seed of the victim and of the artefact.
        weights_sha256: hash of the defended victim's weights; empty until they are loaded.
        adversary_sha256: hash of the weights of an attack that learns; otherwise empty.
        device: where the victim computes: `cpu` or `cuda`.
        cell: one value on each axis of the world.
        seeds: the scenario seed of each episode.
        sequential: whether it is part of a round (`cavbench.run.rounds`).
    """

    pair: Pair
    training_seed: int
    weights_sha256: str
    cell: Cell
    seeds: range
    adversary_sha256: str = ""
    device: str = CPU
    sequential: bool = False

    @property
    def track(self) -> Track:
        """The track of the pair."""
        return track_of(self.pair)

    @property
    def networks(self) -> str:
        """Equal for units with the same networks: of the same defended victim, training seed and, if it learns, attack."""
        pair = self.pair
        parts: list[Chosen[Any]] = [pair.defense, pair.victim, pair.world]
        parts += [pair.attack] if pair.attack.component.learns else []
        return canonical([*([part.kind, part.name, part.params] for part in parts), self.training_seed])

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules hashed into the code digest, with their imports."""
        return self._modules(self.track.work)

    @property
    def code_digest(self) -> str:
        """Hash of the source code that computes it: the track's and the components' modules, with their imports."""
        return self._code(self.modules)

    @property
    def libraries(self) -> dict[str, str]:
        """Versions of the libraries that it is computed with."""
        return libraries(tuple(sorted({name for part in self.pair.parts for name in part.component.libraries})))

    @property
    def attack_seed(self) -> int:
        """Seed of the attack's random generator; the same for every order of tasks, and for every pair with the same `draw`."""
        draw = getattr(self.pair.attack.component, "draw", 0)
        return int(digest([canonical(self.cell), self.training_seed, *([draw] if draw else [])])[:15], 16)

    @property
    def job(self) -> Job:
        """What its track is asked to drive."""
        return self._job(self.attack_seed, self.artefact)

    @property
    def origin(self) -> dict[str, object]:
        """Everything that determines the result, but for its scenarios and its artefact."""
        return self._origin(self.attack_seed, self.modules)

    @cached_property
    def artefact(self) -> str:
        """Fingerprint of its artefact: what the attack prepares once for a defended victim, such as a patch; empty for none.

        Units of a pair that differ in cell and scenarios have the same, unless the attacker knows them (`ThreatModel.known`).
        """
        return digest(self.artefact_origin) if self.track.artefact and not self.pair.is_clean else ""

    @property
    def artefact_modules(self) -> tuple[str, ...]:
        """As `modules`, of its artefact."""
        return self._modules(self.track.preparation)

    @property
    def artefact_origin(self) -> dict[str, object]:
        """Everything that determines its artefact."""
        origin = self._origin(self._artefact_seed, self.artefact_modules)
        if self.known is None:
            return origin
        return origin | {"cell": canonical(self.known), "seeds": [self.seeds.start, self.seeds.stop]}

    @property
    def known(self) -> Cell | None:
        """What the attack knows of the cell when it prepares; None if it knows none of the scenarios."""
        return self.pair.threat.known(self.cell, self.pair.world.component.facts.axes)

    @property
    def preparing_job(self) -> Job:
        """What its track is asked to prepare."""
        return self._job(self._artefact_seed, "")

    @property
    def _artefact_seed(self) -> int:
        """Seed of the attack's random generator when it prepares; the same for every pair."""
        assert self.track.artefact
        return int(digest([self.track.artefact[0], self.training_seed])[:15], 16)

    def _modules(self, own: str) -> tuple[str, ...]:
        shipped = (part for part in self.pair.parts if not part.code)
        return (own, *sorted(module for part in shipped for module in part.component.modules()))

    def _code(self, modules: tuple[str, ...]) -> str:
        own = [part.code for part in self.pair.parts if part.code]
        return digest([code_digest(modules), *own]) if own else code_digest(modules)

    def _job(self, attack_seed: int, artefact: str) -> Job:
        return Job(
            pair=self.pair,
            training_seed=self.training_seed,
            attack_seed=attack_seed,
            cell=self.cell,
            seeds=self.seeds,
            artefact=artefact,
            device=self.device,
        )

    def _origin(self, attack_seed: int, modules: tuple[str, ...]) -> dict[str, object]:
        return {
            "pair": self.pair.identity,
            "training_seed": self.training_seed,
            "attack_seed": attack_seed,
            "weights": self.weights_sha256,
            **({"adversary": self.adversary_sha256} if self.adversary_sha256 else {}),
            **({"device": self.device} if self.device != CPU else {}),
            "code": self._code(modules),
            "shipped_by": [part.shipped_by for part in self.pair.parts],
            "libraries": self.libraries,
        }

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of everything that determines the result."""
        return self._digest(self.origin, self.artefact)

    def fingerprint_with(self, *, code: str, libraries: Mapping[str, str], device: str, artefact: str) -> str:
        """The fingerprint that it has where it is driven by other code, with other libraries, or on another device.

        Args:
            code: hash of the source code.
            libraries: versions of the libraries.
            device: where the victim computes.
            artefact: fingerprint of what was prepared there; empty for nothing.
        """
        there = {key: value for key, value in self.origin.items() if key != "device"}
        there |= {"code": code, "libraries": libraries} | ({"device": device} if device != CPU else {})
        return self._digest(there, artefact)

    def _digest(self, origin: Mapping[str, object], artefact: str) -> str:
        before = {"artefact": artefact} if artefact else {}
        scenarios = {"cell": canonical(self.cell), "seeds": [self.seeds.start, self.seeds.stop]}
        rule = {"rule": SEQUENTIAL} if self.sequential else {}
        return digest({**origin, **scenarios, **before, **rule})

    @property
    def grid(self) -> str:
        """Name of the grid of its world with this cell and this block of seeds; `audit` for drawn seeds, `custom` for others.

        `sequential` for those of a round.
        """
        if self.sequential:
            return SEQUENTIAL
        if self.seeds.start >= SeedBlock.AUDIT:
            return AUDIT
        own = self.pair.world.component.own_grid()
        grids = registry.grids(self.pair.world.name) if own is None else [own]
        return next(
            (grid.name for grid in grids if self.cell in grid.cells() and self.seeds in grid.blocks()), "custom"
        )

    def constants(self, wall_s: float) -> dict[str, object]:
        """The columns that all records of the unit share: IDENTITY (without `seed`) and PROVENANCE of `cavbench.records.schema`.

        Call it in the process that drove it: it reads machine, code and libraries there.
        """
        pair = self.pair
        return {
            "unit": self.fingerprint,
            "pair": pair.id,
            **{part.kind: part.name for part in pair.parts},
            **{f"{part.kind}_params": part.params for part in pair.parts},
            **self.track.identity(pair),
            "sees": pair.victim.component.sees,
            "training_seed": self.training_seed,
            **pair.threat.columns,
            "grid": self.grid,
            "cell": json.dumps(dict(self.cell), separators=(",", ":")),
            "world_facts": json.dumps(pair.world.component.facts_at(self.cell).written(), separators=(",", ":")),
            **{f"{part.kind}_shipped_by": part.shipped_by for part in pair.parts},
            "weights_sha256": self.weights_sha256,
            "code_digest": self.code_digest,
            "libraries": canonical(self.libraries),
            "machine": machine() + said(self.device),
            "created_at": datetime.now(UTC),
            "wall_s": wall_s,
        }

    def __str__(self) -> str:
        seed = f", seed {self.training_seed}" if self.pair.is_seeded else ""
        return f"{self.pair} | {self.cell}{seed}"


def is_foreign(part: Chosen[Any]) -> bool:
    """Whether cavbench does not ship a component: a plug-in does, or it is an object of Python."""
    return (
        bool(part.code) or registry.find(registry.GROUPS[part.kind], part.name, part.kind).distribution != registry.OWN
    )
