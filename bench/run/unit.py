"""Units of work, pure functions of their configuration: a pair on every scenario seed of a cell, and its preparation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import Any

from cavbench.core import registry
from cavbench.core.device import CPU, said
from cavbench.core.pair import Chosen, Pair, weights_of
from cavbench.core.track import Job, Track, track_of
from cavbench.errors import RefusedNetworkError, UserError, message, reason
from cavbench.identity.fingerprint import canonical, code_digest, digest, libraries, machine
from cavbench.isolation.foreign import contained
from cavbench.records.schema import AUDIT, SEQUENTIAL
from cavbench.scenarios import Cell, SeedBlock


@dataclass(frozen=True, kw_only=True)
class Loading:
    """Loads the networks of a pair once, before anything is driven, to hash their weights.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: seed of the victim.
        cells: cells of the run, whose observations the network is tried on.
        asks_world: whether to ask the world, too, what it doubts about these cells; one loading of a world does.
    """

    pair: Pair
    training_seed: int
    cells: tuple[Cell, ...] = ()
    asks_world: bool = False

    def doubts(self) -> tuple[str, ...]:
        """What makes the scores doubtful, one line each.

        Raises:
            UserError: if the world cannot be driven in its cells.
        """
        world = self.pair.world
        of_world = world.component.doubts(self.cells) if self.asks_world else ()
        return (*(f"world {world}: {line}" for line in of_world), *track_of(self.pair).doubts(self.pair))

    def weights(self) -> tuple[str, str]:
        """The hashes of the weights of the defended victim, and of an attack that learns (otherwise empty).

        Raises:
            UserError: if a network cannot be loaded.
        """
        return self.pair.weights_sha256(self.training_seed), self.pair.adversary_sha256(self.training_seed)

    def tried(self) -> tuple[tuple[str, str], tuple[str, ...]]:
        """As `weights`, with what makes the scores doubtful (`doubts`), and the warnings about the network (`Track.try_network`).

        Raises:
            UserError: if a network cannot be loaded.
            RefusedNetworkError: if its score would be wrong.
        """
        pair, named, doubts = self.pair, self.pair.defended, self.doubts()
        network = pair.network(self.training_seed)
        weights = weights_of(network)
        try:
            with contained():
                warnings = track_of(pair).try_network(network, pair, self.cells)
        except UserError as error:
            raise RefusedNetworkError(f"it {message(error)}") from error
        # The network of a stranger may raise anything.
        except Exception as error:
            raise RefusedNetworkError(f"it fails when it is tried: {reason(error)} (--debug shows why)") from error
        lines = (*doubts, *(f"{named} {line}" for line in warnings))
        return (weights, pair.adversary_sha256(self.training_seed)), lines

    def __str__(self) -> str:
        seed = f", seed {self.training_seed}" if self.pair.is_seeded else ""
        named = str(self.pair) if self.pair.attack.component.learns else self.pair.defended
        return f"{named}{seed}"


@dataclass(frozen=True, kw_only=True)
class Work:
    """The common part of units and preparations.

    Args:
        pair: attack, defence, victim, world, threat model.
        training_seed: seed of the victim and of the preparation.
        weights_sha256: hash of the defended victim's weights.
        adversary_sha256: hash of the weights of an attack that learns; otherwise empty.
        device: where the victim computes: `cpu` or `cuda`.
        cell: one value on each axis of the world.
        seeds: the scenario seed of each episode.
    """

    pair: Pair
    training_seed: int
    weights_sha256: str
    cell: Cell
    seeds: range
    adversary_sha256: str = ""
    device: str = CPU

    @property
    def track(self) -> Track:
        """The track of the pair."""
        return track_of(self.pair)

    @property
    def module(self) -> str:
        """The module that does the work."""
        raise NotImplementedError

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules hashed into the code digest, with their imports."""
        shipped = (part for part in self.pair.parts if not part.code)
        return (self.module, *sorted(module for part in shipped for module in part.component.modules()))

    @property
    def code_digest(self) -> str:
        """Hash of the source code that computes it: the track's and the components' modules, with their imports."""
        own = [part.code for part in self.pair.parts if part.code]
        return digest([code_digest(self.modules), *own]) if own else code_digest(self.modules)

    @property
    def libraries(self) -> dict[str, str]:
        """Versions of the libraries that it is computed with."""
        return libraries(tuple(sorted({name for part in self.pair.parts for name in part.component.libraries})))

    @property
    def attack_seed(self) -> int:
        """Seed of the attack's random generator."""
        raise NotImplementedError

    @property
    def job(self) -> Job:
        """What its track is asked to do."""
        return Job(
            pair=self.pair,
            training_seed=self.training_seed,
            attack_seed=self.attack_seed,
            cell=self.cell,
            seeds=self.seeds,
            artefact=self.artefact,
            device=self.device,
        )

    @property
    def artefact(self) -> str:
        """Fingerprint of what was prepared for it; empty for nothing."""
        return ""

    @property
    def origin(self) -> dict[str, object]:
        """Everything that determines the result."""
        return {
            "pair": self.pair.identity,
            "training_seed": self.training_seed,
            "attack_seed": self.attack_seed,
            "weights": self.weights_sha256,
            **({"adversary": self.adversary_sha256} if self.adversary_sha256 else {}),
            **({"device": self.device} if self.device != CPU else {}),
            "code": self.code_digest,
            "shipped_by": [part.shipped_by for part in self.pair.parts],
            "libraries": self.libraries,
        }


@dataclass(frozen=True, kw_only=True)
class Preparation(Work):
    """What an attack prepares once for a defended victim, before any cell is driven: for instance a patch.

    Its cell and seeds are those of the unit that needs it; the result does not depend on them.
    """

    @property
    def module(self) -> str:
        return self.track.preparation

    @cached_property
    def fingerprint(self) -> str:
        """sha256 of everything that determines it."""
        return digest(self.origin)

    @property
    def attack_seed(self) -> int:
        """Seed of the attack's random generator; the same for every pair."""
        assert self.track.artefact
        return int(digest([self.track.artefact[0], self.training_seed])[:15], 16)

    def __str__(self) -> str:
        noun = self.track.artefact[0] if self.track.artefact else "preparation"
        return f"{self.pair} | {noun}, seed {self.training_seed}"


@dataclass(frozen=True, kw_only=True)
class Unit(Work):
    """One batch of episodes: a pair on every scenario seed of a cell, with one training seed.

    Args:
        sequential: whether it is part of a round (`cavbench.run.rounds`).
    """

    sequential: bool = False

    @property
    def module(self) -> str:
        return self.track.work

    @property
    def attack_seed(self) -> int:
        """Seed of the attack's random generator; the same for every order of work, and for every pair with the same `draw`."""
        draw = getattr(self.pair.attack.component, "draw", 0)
        return int(digest([canonical(self.cell), self.training_seed, *([draw] if draw else [])])[:15], 16)

    @cached_property
    def preparation(self) -> Preparation | None:
        """The preparation that it needs; None if it needs none."""
        if not self.track.artefact or self.pair.is_clean:
            return None
        return Preparation(
            pair=self.pair,
            training_seed=self.training_seed,
            weights_sha256=self.weights_sha256,
            cell=self.cell,
            seeds=self.seeds,
            adversary_sha256=self.adversary_sha256,
            device=self.device,
        )

    @property
    def artefact(self) -> str:
        return self.preparation.fingerprint if self.preparation else ""

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
        grids = registry.grids(self.pair.world.name)
        return next(
            (grid.name for grid in grids if self.cell in grid.cells() and self.seeds in grid.blocks()), "custom"
        )

    def constants(self, wall_s: float) -> dict[str, object]:
        """The columns that all records of the unit share: IDENTITY (without `seed`) and PROVENANCE of `cavbench.records.schema`.

        Call it in the process that did the work: it reads machine, code and libraries there.
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
            "world_facts": json.dumps(pair.world.component.facts.written(), separators=(",", ":")),
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
