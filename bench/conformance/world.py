"""The rules for worlds to drive in."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase

from bench.conformance.check import Check, Suite, require
from bench.driving import ActionType, DrivingWorld
from bench.scenarios import Cell

MEASURES = ("progress", "speed", "x", "ttc", "crashed", "offroad")
CELL = Cell(lanes=3, density=1.0)
SEEDS = (5, 6, 7)
STEPS = 12


class WorldSuite(Suite):
    """Of a `DrivingWorld`, a dozen steps at a time."""

    component: DrivingWorld

    def checks(self) -> Mapping[str, Check]:
        return {
            "features": self.describes_its_observation,
            "shape and type": self.shapes,
            "range": self.ranges,
            "determinism": self.same_seed_same_traffic,
            "batching": self.neighbours_do_not_matter,
            "both kinds of action": self.takes_both,
        }

    def describes_its_observation(self) -> None:
        """Every feature has a range and a unit."""
        features = self.component.features
        sizes = {len(part) for part in (features.names, features.low, features.high, features.units)}
        require(len(sizes) == 1, "features needs as many low, high and units as names")
        require(bool((features.half_range() > 0).all()), "the range of a feature is empty: low must be below high")
        require(self.component.max_steps >= 1, "max_steps must be at least 1")

    def shapes(self) -> None:
        """What `DrivingWorld` says is written, in the shapes it says."""
        first, *_, last = self._driven(SEEDS)
        batch = len(SEEDS)
        width = 1 + len(self.component.features.names)
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
        """Sensors end at -1 and 1, presence is 0 or 1, nothing is NaN."""
        for step in self._driven(SEEDS):
            observation = step["observation"]
            require(bool(observation.isfinite().all()), "an observation has NaN or infinity")
            require(bool((observation.abs() <= 1).all()), "an observation leaves [-1, 1], the range of every sensor")
            presence = observation[..., 0]
            require(bool(((presence == 0) | (presence == 1)).all()), "presence, column 0, must be 0 or 1")
            require(bool((observation[presence == 0] == 0).all()), "absent rows must be all zero")
            if ("info", "progress") in step.keys(include_nested=True):
                progress = step["info", "progress"]
                require(bool(((progress >= 0) & (progress <= 1)).all()), "info.progress leaves [0, 1]")

    def same_seed_same_traffic(self) -> None:
        """A scenario seed fixes the scenario."""
        first, second = self._driven(SEEDS), self._driven(SEEDS)
        for one, other in zip(first, second, strict=True):
            require(torch.equal(one["observation"], other["observation"]), "the same seeds give different traffic")
        other = self._driven(tuple(seed + 100 for seed in SEEDS))[0]
        require(not torch.equal(first[0]["observation"], other["observation"]), "other seeds give the same traffic")

    def neighbours_do_not_matter(self) -> None:
        """An episode is the same alone and among others."""
        together, alone = self._driven(SEEDS), self._driven(SEEDS[1:2])
        for one, other in zip(together, alone, strict=True):
            require(
                torch.equal(one["observation"][1:2], other["observation"]),
                "an episode changes with the others of the batch: give every episode a generator of its own",
            )

    def takes_both(self) -> None:
        """Discrete decisions, and steering."""
        for action_type in ("discrete", "continuous"):
            steps = self._driven(SEEDS, action_type)
            require(
                bool(steps[-1]["reward"].isfinite().all()), f"the reward of {action_type} actions is NaN or infinite"
            )

    def _driven(self, seeds: tuple[int, ...], action_type: ActionType = "discrete") -> list[TensorDictBase]:
        """The reset and a dozen steps of always the same action."""
        env = self.component.make([CELL] * len(seeds), action_type=action_type)
        try:
            td = env.reset(TensorDict({"seed": torch.tensor(seeds)}, batch_size=env.batch_size))
            found = [td.clone()]
            action = torch.ones(len(seeds), dtype=torch.int64)
            steering = torch.tensor([0.2, 0.0]).expand(len(seeds), 2)
            for _ in range(min(STEPS, self.component.max_steps)):
                td = env.step(td.set("action", action if action_type == "discrete" else steering))["next"]
                found.append(td.clone())
            return found
        finally:
            env.close(raise_if_closed=False)
