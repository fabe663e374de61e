"""The observation and action spaces of a policy from outside, checked against those of the world that it shall drive in."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from cavbench.driving import ActionType, DrivingFacts
from cavbench.errors import UserError

UNKNOWN = "unknown"
"""The value of `trained_in` for a policy that does not say in which world it was trained."""
UNBOUNDED = 1e30
"""Bounds beyond this are none: some environments write the largest float32 instead of infinity."""
TASKS = ("highway-fast-v0", "highway-v0")
"""The worlds that are highway-env's own tasks."""
OTHER_TASK = "world=gym world.id=TASK, for instance world.id=merge-v0"
"""Where policies of any other environment are scored."""
FEATURES_THERE = "{observation: {features: [presence, x, y, vx, vy, cos_h, sin_h]}}"
ACTION_THERE = "{action: {type: ContinuousAction, lateral: false}}"
"""Examples of what only highway-env's own environments can be told."""
ROWS = 5
"""Rows of their observations, unless `vehicles_count` says otherwise."""
SPARE = 0.01
"""A declared range may leave the bounds of a policy's space by this share of itself."""


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """A `Box` of gymnasium, as a file or a model states it.

    Args:
        shape: its shape.
        low, high: lowest and highest value of each entry, in order; one value if they are all equal.
    """

    shape: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @classmethod
    def of(cls, space: Any) -> Bounds:
        """The bounds of a `gymnasium.spaces.Box`."""
        low, high = ([float(number) for number in side.reshape(-1)] for side in (space.low, space.high))
        return cls(shape=tuple(int(side) for side in space.shape), low=_short(low), high=_short(high))

    @classmethod
    def of_parts(cls, spaces: Mapping[str, Any]) -> Bounds:
        """The bounds of the parts of a `Dict`, one after the other as `gymnasium.spaces.flatten` writes them."""
        limits = [limit for space in spaces.values() for limit in cls.of(space).limits()]
        low, high = zip(*limits, strict=True)
        return cls(shape=(len(limits),), low=_short(low), high=_short(high))

    @property
    def unbounded(self) -> bool:
        """Whether it says nothing about the range of any entry."""
        return all(abs(end) >= UNBOUNDED for end in (*self.low, *self.high))

    def limits(self) -> list[tuple[float, float]]:
        """The lowest and the highest value of each entry."""
        count = math.prod(self.shape)
        low, high = (side * count if len(side) == 1 else side for side in (self.low, self.high))
        return list(zip(low, high, strict=True))

    def __str__(self) -> str:
        return f"Box({_written(self.low)}, {_written(self.high)}, {self.shape})"


def normalised(shape: Sequence[int]) -> Bounds:
    """The observation space of `cavbench.gym.make`."""
    return Bounds(shape=tuple(shape), low=(-1.0,), high=(1.0,))


@dataclass(frozen=True, kw_only=True)
class Expected:
    """What a world shows to policies from outside, from its facts.

    Args:
        facts: facts of the world.
        rows: V, if the world does not say it itself.
    """

    facts: DrivingFacts
    rows: int | None = None

    @property
    def shape(self) -> tuple[int | None, int]:
        """[V, F] of an observation; V is None if nobody says it."""
        own = 1 if self.facts.flat else self.facts.rows
        return own or self.rows, 1 + len(self.facts.features.names)

    @property
    def native(self) -> tuple[int, ...]:
        """The shape of the array that the world's own environment gives, in a flat world."""
        return tuple(self.facts.native(torch.zeros(1, 1, self.shape[1])).shape[1:])

    def fit(self, name: str, shape: Sequence[int], bounds: Bounds | None = None) -> Callable[[Tensor], Tensor] | None:
        """How observations [..., V, F] of the world become those of the policy, before they are flattened; None leaves them.

        Args:
            name: the policy in errors.
            shape: shape of its observations. Only the world's own shape is allowed, and that shape flattened: an array of as
                many numbers in another shape holds other things.
            bounds: its observation space, if it says so.

        Raises:
            UserError: if the policy takes other observations; says what differs and what to do.
        """
        shape = tuple(shape)
        rows, features = self.shape
        if self.facts.flat:
            # Flattened it could be an array of the environment with another entry.
            own = shape == (rows, features)
        else:
            own = shape in self._both((rows, features)) if rows else _has_rows(shape, features)
        native = self.facts.flat and shape in self._both(self.native)
        if native and (bounds is None or not (self._beyond(bounds) or self._other_limits(bounds))):
            return self.facts.native
        if own and (bounds is None or self._declares(bounds)):
            return None
        raise UserError(self._complaint(name, shape, bounds))

    def _declares(self, bounds: Bounds) -> bool:
        """Whether the world's own environment declares these bounds of an observation."""
        if self.facts.unbounded:
            return bounds.unbounded
        return (set(bounds.low), set(bounds.high)) == ({-1.0}, {1.0})

    def _both(self, shape: tuple[int | None, ...]) -> list[tuple[int | None, ...]]:
        return [shape, (math.prod(side or 0 for side in shape),)]

    def _beyond(self, bounds: Bounds) -> str:
        """The entry whose declared range is not within the bounds of the policy's space; empty if there is none."""
        features = self.facts.features
        limits = bounds.limits()
        if len(limits) != len(features.names):
            return ""
        for name, low, high, (lowest, highest) in zip(features.names, features.low, features.high, limits, strict=True):
            spare = SPARE * (high - low)
            if low < lowest - spare or high > highest + spare:
                return f"{name} from {low:g} to {high:g}"
        return ""

    def _other_limits(self, bounds: Bounds) -> str:
        """The space of the world's own environment, if it is another one than the policy's; empty otherwise."""
        own = self.facts.limits
        if not own or all(map(_alike, own, bounds.limits())):
            return ""
        lows, highs = zip(*own, strict=True)
        return str(Bounds(shape=self.native, low=_short(lows), high=_short(highs)))

    def _frames(self, shape: tuple[int, ...]) -> int:
        """How many observations of the world a shape may hold; 0 if it is no whole number of at least 2."""
        own = self.native if self.facts.flat else self.shape
        count = math.prod(side or 0 for side in own)
        whole = count and math.prod(shape) % count == 0 and shape[-1] % (own[-1] or 1) == 0
        return math.prod(shape) // count if whole and math.prod(shape) > count else 0

    def _complaint(self, name: str, shape: tuple[int, ...], bounds: Bounds | None) -> str:
        facts, (rows, features) = self.facts, self.shape
        if facts.flat:
            wanted = f"an array of shape {self.native}"
            if bounds is not None and shape in self._both(self.native):
                beyond = self._beyond(bounds)
                wanted = f"{wanted} with {beyond}" if beyond else self._other_limits(bounds)
            source = "the world's own `environment(cell)`"
        else:
            own = f"({rows if rows else 'V'}, {features})"
            ends = "-inf, inf" if facts.unbounded else "-1, 1"
            wanted = f"Box({ends}, {own})" if bounds is not None else f"{own}, or flattened"
            if bounds is None and rows:
                wanted += f" ({rows * features},)"
            source = facts.environment or "the environment that cavbench.gym.make makes of this world"
        takes = f"was trained on {bounds}" if bounds is not None else f"takes observations {shape}"
        why = ""
        elsewhere = bounds is not None and bounds.unbounded and not facts.flat
        if elsewhere and (home := _home(shape, facts)):
            whose = ". A policy of highway-env's own tasks is scored in its task:"
            whose = "; if its environment had another number of rows, write" if facts.unbounded else whose
            return f"{name} {takes}, this world shows {wanted}{whose} {home}; of another task, {OTHER_TASK}"
        there = bounds is not None and task_of(facts) and (bounds.unbounded or shape[-1] != features)
        if there and not self._frames(shape):
            return f"{name} {takes}, this world shows {wanted}. {configured(facts, FEATURES_THERE)}"
        if elsewhere and not facts.unbounded:
            return f"{name} {takes}, this world shows {wanted}. A policy of another task is scored in that task: {OTHER_TASK}"
        if frames := self._frames(shape):
            why = f"; if these are {frames} frames, add victim.frames={frames} to victim=sb3"
        elif rows and shape not in self._both((rows, features)) and math.prod(shape) == rows * features:
            why = "; these are as many numbers in another arrangement"
        elif not facts.flat and len(shape) == 2 and shape[1] == features and (bounds is None or not bounds.unbounded):
            why = "; if it was trained in this world with other options, score it with the same (world.…=)"
        return (
            f"{name} {takes}, this world shows {wanted}{why}. Train it in {source}, or give cavbench.score a "
            "torch.nn.Module that converts the world's observation for it, and state trained_in="
        )


def check_actions(name: str, found: ActionType, width: int, facts: DrivingFacts) -> None:
    """Refuse a policy with other actions than the world's.

    Raises:
        UserError: says what differs.
    """
    wanted = len(facts.actions) if found == "discrete" else len(facts.controls)
    if width == wanted and wanted:
        return
    there = f". {configured(facts, ACTION_THERE)}" if task_of(facts) else ""
    raise UserError(f"{name} was trained for {width} {found} actions, this world takes {facts.takes()}{there}")


def task_of(facts: DrivingFacts) -> str:
    """The id of highway-env's own task that a world is; empty if it is none."""
    return facts.environment.split('"')[1] if facts.unbounded and '"' in facts.environment else ""


def configured(facts: DrivingFacts, example: str) -> str:
    """What to type for a policy of highway-env's task with a configuration that only highway-env itself knows."""
    return (
        "If its environment had another configuration, it is scored in highway-env itself with the same keys, for instance "
        f"world=gym world.id={task_of(facts)} 'world.config={example}'"
    )


def check_range(name: str, bounds: Bounds, facts: DrivingFacts) -> None:
    """Refuse continuous actions whose range cannot be mapped to the world's.

    A world of the benchmark takes actions in [-1, 1]. In a flat world any range is allowed: it is that of the environment.

    Raises:
        UserError: says what differs.
    """
    limits = bounds.limits()
    if not all(-UNBOUNDED < low < high < UNBOUNDED for low, high in limits):
        raise UserError(f"{name} was trained for actions in {bounds}; both controls need a lowest and a highest value")
    if not facts.flat and any(limit != (-1.0, 1.0) for limit in limits):
        raise UserError(
            f"{name} was trained for actions in {bounds}, not in [-1, 1]. Train it in "
            f"{_continuous(facts.environment)}, where both controls are in [-1, 1]"
        )


def _home(shape: tuple[int, ...], facts: DrivingFacts) -> str:
    """What to type for a policy of one of highway-env's highway tasks, from the shape of its observation; empty if it is none."""
    features = 1 + len(facts.features.names)
    if len(shape) != 2 or shape[1] != features:
        return ""
    rows = f"'world.config={{observation: {{vehicles_count: {shape[0]}}}}}'"
    if facts.unbounded:
        return rows
    return " or ".join(f"world={task}" for task in TASKS) + ("" if shape[0] == ROWS else f", with {rows}")


def _continuous(call: str) -> str:
    made = call or "cavbench.gym.make(…)"
    return f'{made[:-1]}, action_type="continuous")'


def _has_rows(shape: tuple[int, ...], features: int) -> bool:
    """Whether a shape is [V, F] or [V * F] for any V."""
    return (len(shape) == 2 and shape[1] == features) or (len(shape) == 1 and shape[0] % features == 0)


def _alike(own: tuple[float, float], other: tuple[float, float]) -> bool:
    """Whether two ranges are the same, up to the digits that numpy prints; the largest numbers count as infinity."""
    return all(
        one == two or (one * two > 0 and min(abs(one), abs(two)) >= UNBOUNDED) or math.isclose(one, two, rel_tol=1e-5)
        for one, two in zip(own, other, strict=True)
    )


def _short(numbers: Sequence[float]) -> tuple[float, ...]:
    return tuple(numbers[:1]) if len(set(numbers)) == 1 else tuple(numbers)


def _written(numbers: tuple[float, ...]) -> str:
    if len(numbers) == 1:
        return f"{numbers[0]:g}"
    shown = [f"{number:g}" for number in numbers[:6]]
    return f"[{', '.join(shown)}{', …' if len(numbers) > len(shown) else ''}]"
