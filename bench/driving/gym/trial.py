"""A short drive with random actions, to compare what a `GymWorld` declares with what its environments return."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from cavbench.driving import ActionType, Features
from cavbench.driving.gym.batch import Batch
from cavbench.driving.gym.declaration import SUCCESS, Declaration
from cavbench.driving.gym.repeats import repeats
from cavbench.scenarios import Cell, SeedBlock

STEPS, CELLS = 1000, 4
"""Length of the drive: steps of all episodes together, on so many cells of the grid."""
CPU_S, WALL_S = 5.0, 15.0
"""A slow environment is driven for so many seconds at most."""
USED, LEFT = 0.05, 0.01
"""A range is doubtful if less than this share of it is used, or if more than this share of the values leaves it."""
LONGEST = 100_000
"""A limit of time of more decisions is none."""
NAMED = 2
"""So many features are named in a line."""
SHARE_OF_RANGE = 1e-6
"""A value may leave its range by this share of it: environments compute in float32."""
LATE = 3
"""So many episodes that last to the end, and all fail there, are no chance."""
ENOUGH = 100
"""In fewer steps nothing is said about a range that is hardly used."""


class Seen:
    """What the environments returned.

    Args:
        features: the declared features.
    """

    def __init__(self, features: Features) -> None:
        self.low, self.high = np.array(features.low, np.float64), np.array(features.high, np.float64)
        slack = SHARE_OF_RANGE * (self.high - self.low)
        self._low, self._high = self.low - slack, self.high + slack
        self.least, self.most = np.full(len(self.low), np.inf), np.full(len(self.low), -np.inf)
        self.outside = np.zeros(len(self.low))
        self.observations = 0
        self.rewards: list[float] = []
        self.tells = False
        """Whether `info` says what an episode is that terminates."""
        self.late = {"crashed": 0, "truncated": 0}
        """How many episodes that reached `max_steps` count as failed, and how many were truncated."""

    def saw(self, observation: NDArray[np.float64]) -> None:
        self.observations += 1
        np.fmin(self.least, observation, out=self.least)
        np.fmax(self.most, observation, out=self.most)
        # NaN is outside, too.
        self.outside += ~((observation >= self._low) & (observation <= self._high))

    def earned(self, reward: float, info: Mapping[str, Any]) -> None:
        self.rewards.append(reward)
        self.tells = self.tells or any(name in info for name in ("crashed", *SUCCESS))

    def unused(self) -> NDArray[np.bool_]:
        """[n] the features that use less than 5 % of their range.

        A value that never changes says nothing about the range if it is 0 or an end of it: a flag, or an absent row.
        """
        constant = (self.least == self.most) & ((self.most == 0) | (self.most == self.low) | (self.most == self.high))
        used = np.minimum(self.most, self.high) - np.maximum(self.least, self.low)
        return (used < USED * (self.high - self.low)) & ~constant

    def left(self) -> NDArray[np.bool_]:
        """[n] the features of which more than 1 % of the values are outside their range."""
        return self.outside > LEFT * self.observations


def doubts(world: Declaration, cells: Sequence[Cell]) -> list[str]:
    """What random steps say against the declarations of a world, one line each.

    Args:
        world: the world.
        cells: cells that it will be driven in; the drive is on a few of them, in scenarios that are never reported.

    Raises:
        UserError: if the spaces of an environment are not those that the world declares.
    """
    seen = Seen(world.features)
    tried = cells[:: -(-len(cells) // CELLS)]
    kind: ActionType = "discrete" if world.actions else "continuous"
    with closing(Batch(world, tried, kind, seen)) as batch:
        limits = [found for env in batch.envs if (found := time_limit(env)) is not None]
        early = _drive(batch, seen)
    limits += early if len(early) > 1 and len(set(early)) == 1 else []
    declared = [
        *_of_ranges(world, seen),
        *_of_rewards(world, seen),
        *_of_length(world, limits),
        *_of_ends(seen),
        *_of_meaning(world, seen),
    ]
    return [*repeats(world, cells), *declared]


def _drive(batch: Batch, seen: Seen) -> list[int]:
    """Drive with random actions, and return the lengths of the episodes that the environments truncated too early."""
    generator = np.random.default_rng(0)
    size, seed = len(batch.envs), int(SeedBlock.TUNE)
    wall, cpu = time.monotonic() + WALL_S, time.process_time() + CPU_S
    early = []
    td = batch.reset(TensorDict({"seed": torch.arange(seed, seed + size)}, batch_size=[size]))
    while len(seen.rewards) < STEPS and time.monotonic() < wall and time.process_time() < cpu:
        if batch.discrete:
            action = torch.from_numpy(generator.integers(len(batch.world.actions), size=size))
        else:
            action = torch.from_numpy(generator.uniform(-1, 1, (size, len(batch.world.controls))).astype(np.float32))
        td = batch.step(td.set("action", action))["next"]
        early += batch.time[(td["truncated"][:, 0].numpy()) & (batch.time < batch.world.max_steps)].tolist()
        last = batch.time >= batch.world.max_steps
        for name in seen.late:
            seen.late[name] += int((last & batch.flags[name][:, 0] & td["done"][:, 0].numpy()).sum())
        if td["done"].any():
            seed += size
            asked = {"_reset": td["done"], "seed": torch.arange(seed, seed + size)}
            td = batch.reset(td.update(asked))
    return early


def _of_ranges(world: Declaration, seen: Seen) -> Iterator[str]:
    features = world.features
    forged = np.array([name not in features.fixed for name in features.names])
    steps = len(seen.rewards)
    named: list[tuple[NDArray[np.bool_], str]] = [(seen.left(), f"is left by more than {100 * LEFT:g} % of the values")]
    if steps >= ENOUGH and not world.ranges_known:
        named.insert(0, (seen.unused() & forged, f"is used by less than {100 * USED:g} %"))
    for which, what in named:
        if which.any():
            yield (
                f"the declared range of {_listed(features, seen, which)} {what} in {steps} random steps; values outside are "
                f"clipped and budgets follow the range: {world.writes_ranges()}"
            )


def _listed(features: Features, seen: Seen, which: NDArray[np.bool_]) -> str:
    places = np.flatnonzero(which)
    parts = [
        f"{features.names[at]} ({seen.low[at]:g} to {seen.high[at]:g}, seen {seen.least[at]:.3g} to {seen.most[at]:.3g})"
        for at in places[:NAMED]
    ]
    more = [f"{len(places) - NAMED} more"] if len(places) > NAMED else []
    return " and ".join([", ".join([*parts, *more][:-1]), *[*parts, *more][-1:]]) if len(parts + more) > 1 else parts[0]


def _of_rewards(world: Declaration, seen: Seen) -> Iterator[str]:
    if not world.clips_rewards:
        return
    rewards = np.array(seen.rewards)
    outside = ~((rewards >= -SHARE_OF_RANGE) & (rewards <= 1 + SHARE_OF_RANGE))
    if outside.mean() > LEFT:
        yield (
            f"{100 * outside.mean():.0f} % of the rewards are outside [0, 1] ({rewards.min():.3g} to {rewards.max():.3g} in "
            f"{len(rewards)} random steps), and safe_progress clips them: {world.writes_progress()}"
        )


def _of_length(world: Declaration, lengths: Sequence[int]) -> Iterator[str]:
    shortest = min(lengths, default=world.max_steps)
    if shortest < world.max_steps:
        yield (
            f"the environment ends every episode after {shortest} steps, but max_steps is {world.max_steps}: no safe_progress "
            f"can be above {shortest / world.max_steps:.2g}; write {world.writes('max_steps', shortest)}"
        )


def _of_ends(seen: Seen) -> Iterator[str]:
    if seen.late["crashed"] >= LATE and not seen.late["truncated"]:
        yield (
            f"all {seen.late['crashed']} episodes that reached max_steps count as failed, as the environment terminates them: at "
            "a limit of time return truncated=True and terminated=False, or override failed()"
        )


def _of_meaning(world: Declaration, seen: Seen) -> Iterator[str]:
    if type(world).failed is Declaration.failed and world.ending == "unknown" and not seen.tells:
        yield (
            f"the environment of {world.label} does not tell in info whether an episode that terminates has failed or arrived "
            f"(crashed, is_success): each counts as failed; write {world.writes('terminated', 'failure')} or "
            f"{world.writes('terminated', 'success')}"
        )


def time_limit(env: gymnasium.Env[Any, Any]) -> int | None:
    """The decisions after which an environment truncates an episode; None if it does not say.

    Read are the limits of gymnasium's `TimeLimit`, and highway-env's `duration`, in decisions of its `policy_frequency`.
    """
    found = []
    wrapped: Any = env
    while isinstance(wrapped, gymnasium.Wrapper):
        if isinstance(wrapped, gymnasium.wrappers.TimeLimit):
            found.append(int(wrapped._max_episode_steps))
        wrapped = wrapped.env
    config = getattr(wrapped, "config", None)
    config = config if isinstance(config, dict) else {}
    if {"duration", "policy_frequency"} <= set(config) and config["duration"] * config["policy_frequency"] <= LONGEST:
        found.append(_decisions(config["duration"], config["policy_frequency"]))
    return min(found, default=None)


def _decisions(duration: float, rate: float) -> int:
    """The decisions of an episode of highway-env, whose clock adds fractions of a second: 30 s at 15 Hz are 451."""
    count, clock = 0, 0.0
    while count == 0 or clock < duration:
        count, clock = count + 1, clock + 1 / rate
    return count
