"""Rules for worlds of the driving track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase

from cavbench.checks.check import Check, DoubtError, Suite, one_line, require
from cavbench.checks.scenarios import first_cell
from cavbench.core import registry
from cavbench.driving import ActionType, Driver, DrivingFacts, DrivingWorld
from cavbench.errors import UserError
from cavbench.scenarios import Cell

MEASURES = ("progress", "speed", "x", "ttc", "crashed", "offroad")
SEEDS = (5, 6, 7)
STEPS = 12
CELLS = 64
"""Maximum number of cells of the default grid that are started."""


class WorldSuite(Suite):
    """Checks of a `DrivingWorld`, mostly over twelve steps in the first cell of its default grid."""

    component: DrivingWorld

    def checks(self) -> Mapping[str, Check]:
        return {
            "features": self.describes_its_observation,
            "decisions": self.describes_its_decisions,
            "cells": self.starts_every_cell,
            "drivers": self.makes_every_driver,
            "shape and type": self.shapes,
            "range": self.ranges,
            "determinism": self.same_seed_same_traffic,
            "batching": self.neighbours_do_not_matter,
            "actions": self.takes_its_actions,
            "doubts": self.is_as_declared,
        }

    def describes_its_observation(self) -> None:
        """Every feature has a range and a unit."""
        facts = self.component.facts
        require(
            isinstance(facts, DrivingFacts), f"facts is a {type(facts).__name__}, not a cavbench.driving.DrivingFacts"
        )
        features = facts.features
        require(
            features == self.component.features,
            "facts.features differ from the world's features: use the same object for both",
        )
        sizes = {len(part) for part in (features.names, features.low, features.high, features.units)}
        require(len(sizes) == 1, "features.low, high and units must be as long as features.names")
        require(
            len(features.floors) in (0, len(features.names)),
            "features.floors must be empty or as long as features.names",
        )
        require(bool((features.half_range() > 0).all()), "the range of a feature is empty: low must be below high")

    def describes_its_decisions(self) -> str:
        """Decision rate, episode length and actions are valid: defences and baselines rely on them."""
        facts = self.component.facts
        require(
            facts.decision_hz > 0,
            f"decision_hz must be above 0, got {facts.decision_hz}: give the decisions per second",
        )
        require(facts.max_steps >= 1, f"max_steps must be at least 1, got {facts.max_steps}")
        require(
            all(isinstance(name, str) and name for name in facts.actions),
            "facts.actions must name every discrete action",
        )
        if facts.actions:
            env = self._env([first_cell(self.component)], "discrete")
            count = getattr(env.action_spec, "n", None)
            env.close(raise_if_closed=False)
            require(
                count == len(facts.actions),
                f"the environment's action_spec has {count} actions, but facts.actions has {len(facts.actions)}: "
                "use torchrl.data.Categorical(len(actions))",
            )
        seconds = facts.max_steps / facts.decision_hz
        return f"{facts.decision_hz:g} Hz for {seconds:g} s, {len(facts.actions)} discrete actions"

    def starts_every_cell(self) -> str:
        """All cells of the default grid can be started in one batch."""
        grid = registry.grid_of(self.component)
        cells = grid.cells()[:CELLS]
        env = self._env(cells, self._action_types()[0])
        try:
            td = _reset(env, [grid.first_seed] * len(cells))
        finally:
            env.close(raise_if_closed=False)
        count = td["observation"].shape[0]
        require(
            count == len(cells),
            f"build({len(cells)} cells) creates {count} episodes: create one for each cell, in order",
        )
        require(not bool(td["done"].any()), "an episode is done before its first step")
        return f"{len(cells)} of {len(grid.cells())} cells" if len(cells) < len(grid.cells()) else f"{len(cells)} cells"

    def makes_every_driver(self) -> str:
        """Every driver in facts.drivers can drive."""
        drivers = self.component.facts.drivers
        require("agent" in drivers, "facts.drivers lacks 'agent', the driver that carries out the actions: add it")
        for driver in drivers:
            self._driven(SEEDS[:1], driver=driver)
        return ", ".join(drivers)

    def shapes(self) -> None:
        """The environment returns all entries that `DrivingWorld` requires, in the required shapes."""
        first, *_, last = self._driven(SEEDS)
        batch = len(SEEDS)
        width = 1 + len(self.component.facts.features.names)
        observation = first["observation"]
        require(
            observation.ndim == 3 and (observation.shape[0], observation.shape[2]) == (batch, width),
            f"observation is {list(observation.shape)}, not [B, V, {width}]: presence and each of features.names",
        )
        flags = ("done", "terminated", "truncated")
        for key in ("reward", *flags, *(("info", name) for name in MEASURES)):
            shape = tuple(last[key].shape)
            require(shape == (batch, 1), f"{key} is {list(shape)}, not [{batch}, 1]")
        for key in (*flags, ("info", "crashed"), ("info", "offroad")):
            require(last[key].dtype == torch.bool, f"{key} is {last[key].dtype}, not bool")
        for key in ("observation", "reward"):
            require(last[key].dtype == torch.float32, f"{key} is {last[key].dtype}, not float32")

    def ranges(self) -> None:
        """Observations are in [-1, 1], presence is 0 or 1, nothing is NaN."""
        for step in self._driven(SEEDS):
            observation = step["observation"]
            require(bool(observation.isfinite().all()), "an observation contains NaN or infinity")
            require(bool((observation.abs() <= 1).all()), "an observation is outside [-1, 1]: normalise and clip it")
            presence = observation[..., 0]
            require(bool(((presence == 0) | (presence == 1)).all()), "presence, column 0, must be 0 or 1")
            require(bool((observation[presence == 0] == 0).all()), "rows with presence 0 must be all zero")
            if ("info", "progress") in step.keys(include_nested=True):
                progress = step["info", "progress"]
                # Who arrives has the progress of the steps that are left, too.
                most = torch.where(step["terminated"], float(self.component.facts.max_steps), 1.0)
                require(bool(((progress >= 0) & (progress <= most)).all()), "info.progress is outside [0, 1]")

    def same_seed_same_traffic(self) -> None:
        """The scenario seed determines the scenario."""
        first, second = self._driven(SEEDS), self._driven(SEEDS)
        for one, other in zip(first, second, strict=True):
            require(
                torch.equal(one["observation"], other["observation"]),
                "the same seed gives different traffic: draw only from a generator with the episode's seed",
            )
        other = self._driven(tuple(seed + 100 for seed in SEEDS))[0]
        require(not torch.equal(first[0]["observation"], other["observation"]), "different seeds give the same traffic")

    def neighbours_do_not_matter(self) -> None:
        """An episode does not depend on the others of its batch."""
        together, alone = self._driven(SEEDS), self._driven(SEEDS[1:2])
        for one, other in zip(together, alone, strict=True):
            require(
                torch.equal(one["observation"][1:2], other["observation"]),
                "an episode depends on the others of its batch: use one generator per episode",
            )

    def takes_its_actions(self) -> str:
        """It accepts every discrete action that it names, and continuous actions unless it refuses them."""
        refused = ""
        for action_type in ("discrete", "continuous"):
            if action_type not in self._action_types() and action_type == "discrete":
                continue
            try:
                steps = self._driven(SEEDS, action_type, every=True)
            except UserError as error:
                require(action_type == "continuous", f"it refuses an action of facts.actions: {one_line(error)}")
                refused = f"continuous actions are refused: {one_line(error)}"
                continue
            require(
                bool(steps[-1]["reward"].isfinite().all()), f"the reward of {action_type} actions is NaN or infinite"
            )
        return refused

    def is_as_declared(self) -> None:
        """A short drive finds nothing that makes scores in the default grid doubtful."""
        if doubts := self.component.doubts(registry.grid_of(self.component).cells()):
            raise DoubtError(*doubts)

    def _action_types(self) -> tuple[ActionType, ...]:
        """The action types to check: discrete only if the world names discrete actions."""
        return ("discrete", "continuous") if self.component.facts.actions else ("continuous",)

    def _env(self, cells: Sequence[Cell], action_type: ActionType, driver: Driver = "agent") -> EnvBase:
        return self.component.make(cells, action_type=action_type, driver=driver)

    def _driven(
        self,
        seeds: Sequence[int],
        action_type: ActionType | None = None,
        *,
        driver: Driver = "agent",
        every: bool = False,
    ) -> list[TensorDictBase]:
        """The results of a reset and twelve steps, with one action or, if `every`, with each action in turn."""
        action_type = action_type or self._action_types()[0]
        env = self._env([first_cell(self.component)] * len(seeds), action_type, driver)
        try:
            td = _reset(env, seeds)
            steps = [td.clone()]
            steering = torch.zeros(len(seeds), len(self.component.facts.controls))
            steering[:, :1] = 0.2
            for step in range(min(STEPS, self.component.facts.max_steps)):
                number = step % len(self.component.facts.actions) if every and action_type == "discrete" else 0
                action = torch.full((len(seeds),), number) if action_type == "discrete" else steering
                td = env.step(td.set("action", action))["next"]
                steps.append(td.clone())
            return steps
        finally:
            env.close(raise_if_closed=False)


def _reset(env: EnvBase, seeds: Sequence[int]) -> TensorDictBase:
    return env.reset(TensorDict({"seed": torch.tensor(list(seeds))}, batch_size=env.batch_size))
