"""The world `gym`: any registered gymnasium environment, by its id."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

from cavbench.core.ranges import Count, Positive
from cavbench.driving.features import CONTROLS, DrivingFacts
from cavbench.driving.gym import entries, made
from cavbench.driving.gym.declaration import Ending
from cavbench.driving.gym.known import Known, known_of
from cavbench.driving.gym.parameters import GivenFeatures, axes_of, grid_of, mapping, without_units
from cavbench.driving.gym.trial import time_limit
from cavbench.driving.gym.world import GymWorld
from cavbench.errors import UserError, short
from cavbench.scenarios import Cell, Grid, SeedBlock

HIGH = "1 is the best step"


@dataclass(frozen=True, kw_only=True)
class RegisteredWorld(GymWorld):
    """A gymnasium environment: one that is registered, by its id. Observations of any shape are flattened, with names.

    Names, ranges, actions, rate and length are asked of the environment. The tasks of highway-env, and the classic ones of
    gymnasium, need nothing else. Of others the ranges are those of its `Box`; where these are infinite, `features` gives them.

    Args:
        id: the registered name, for instance merge-v0. MODULE:NAME imports the module that registers it; no other code of the
            environment's author runs.
        config: values by name, the same in every cell: keys of the configuration in highway-env, otherwise arguments of the
            environment: {lanes_count: 4}.
        axes: lists of such values, one for each axis: {vehicles_density: [1, 2], lanes_count: [3, 4]}. Cells are their
            combinations.
        part: the part of a `Dict` observation that attackers can change. Victims see all parts.
        features: the range of a sensor by the name of the entry: {vx: [-4, 4]}. With as many names as there are entries, or
            columns of an array, the entries get these names.
        fixed: names of entries that nobody can forge, such as flags.
        floors: resolutions of sensors by name, by which a value near 0 may change.
        units: units by name, for tables: {vx: m/s}.
        terminated: what it means that the environment ends an episode and does not say why in `info`: failure; success, as a
            goal that is reached; or reward, a success if the last reward is above 0. It is known of gymnasium's own tasks.
        reward: the rewards of the worst and the best step, which count as 0 and 1 of `safe_progress`.
        max_steps: decisions in an episode; None for the limit of the environment.
        hz: decisions a second, by which defences reckon; None asks the environment.
    """

    grid: ClassVar[str] = "gym-v1"

    id: str
    config: Any = None
    axes: Any = None  # type: ignore[misc] # given as values, kept as axes
    part: str = ""
    features: Any = None  # type: ignore[misc] # given as ranges, kept as features
    fixed: tuple[str, ...] = ()
    floors: Any = None
    units: Any = None
    terminated: Ending = "unknown"  # type: ignore[misc]
    reward: tuple[float, ...] = ()
    max_steps: Count | None = None  # type: ignore[assignment]
    hz: Positive | None = None  # type: ignore[misc, assignment]

    @classmethod
    def imports(cls, params: Mapping[str, Any]) -> str:
        return made.stranger(str(params.get("id", "")))

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("config", "axes", "features", "floors", "units"):
            value = getattr(self, name)
            value = value.given_parameter if hasattr(type(value), "given_parameter") else value
            self._set(name, mapping(name, value))
        self._set("fixed", tuple(self.fixed))
        self._set("reward", tuple(float(number) for number in self.reward))
        if self.reward and not (len(self.reward) == 2 and self.reward[0] < self.reward[1]):
            raise ValueError(f"reward is [worst, best] of a step, for instance [-1, 0], got {list(self.reward)}")
        spec = self._spec()
        self._set("axes", axes_of(self.axes, spec.id))
        if shared := [name for name in self.axes if name in (self.config or {})]:
            raise ValueError(f"{shared[0]} is in axes and in config: leave it out of one")
        env = self.environment(self.own_grid().cells()[0])
        try:
            self._ask(env)
        finally:
            env.close()

    @property
    def known(self) -> Known:
        """What is known of the environment."""
        found: Known = vars(self)["_known"]
        return found

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _spec(self) -> Any:
        return made.found(self.id)

    def _ask(self, env: gymnasium.Env[Any, Any]) -> None:
        """Take from an environment what was not given."""
        # The ranges of highway-env are known after a reset.
        env.reset(seed=int(SeedBlock.TUNE))
        known = known_of(env)
        self._set("ranges_known", known.entries is not list and not self.features)
        # What it was asked for is in the features.
        self._set("_known", replace(known, entries=list))
        self._set("actions", _actions(env.action_space, known))
        self._set("controls", _controls(env.action_space, known))
        self._set("features", GivenFeatures.of(self._described(env, known), self.features))
        steps = self.max_steps or time_limit(env) or known.max_steps
        if not steps:
            raise UserError(f"{self.id} has no limit of time: write world.max_steps=, the decisions of an episode")
        self._set("max_steps", steps)
        self._set("libraries", tuple(dict.fromkeys(["gymnasium", *filter(None, [made.distribution(self._home())])])))

    def _described(self, env: gymnasium.Env[Any, Any], known: Known) -> Any:
        """The features of its observation."""
        space = env.observation_space
        found = known.entries(entries.of_space(space))
        found = self._measured(space, found, self.part or known.part)
        if self.features:
            columns = space.shape[-1] if isinstance(space, spaces.Box) and len(space.shape) > 1 else 0
            found = entries.ranged(found, self.features, columns)
        found = entries.told(found, "floors", self.floors or {}, "floor")
        found = entries.told(found, "units", self.units or {}, "unit")
        found = entries.told(found, "fixed", dict.fromkeys(self.fixed, True), "fixed")
        if all(entry.fixed for entry in found):
            raise UserError(
                f"{self.id} observes {short(str(space))}, in which an attacker can change nothing: only numbers of a Box are "
                "measured"
            )
        return without_units(entries.features_of(found))

    def _measured(self, space: Any, found: list[entries.Entry], part: str) -> list[entries.Entry]:
        """The entries, of which only those of one part can be changed."""
        parts = list(dict.fromkeys(entry.part for entry in found if not entry.fixed and entry.part))
        if not parts:
            if self.part:
                raise UserError(f"{self.id} observes {short(str(space))}, which has no parts: leave out world.part")
            return found
        if not part and len(parts) > 1:
            raise UserError(
                f"{self.id} observes the parts {', '.join(parts)}: say which one attackers can change, world.part={parts[-1]}"
            )
        part = part or parts[0]
        if part not in parts:
            raise UserError(f"{self.id} has no part {part!r} that is measured: it has {', '.join(parts)}")
        return [entry if entry.part == part else entries.replace(entry, fixed=True) for entry in found]

    def environment(self, cell: Cell) -> gymnasium.Env[Any, Any]:
        """A new environment of this id."""
        values = {name: cell[name] for name in (self.axes.given_parameter or ())}
        return made.made(self._spec(), {**(self.config.plain() if self.config else {}), **values})

    def own_grid(self) -> Grid:
        """The cells of `axes`, with 20 scenarios each."""
        return grid_of(self.axes, "gym", self.grid)

    @property
    def ending(self) -> Ending:
        return self.known.terminated if self.terminated == "unknown" else self.terminated

    @property
    def decision_hz(self) -> float:
        return self.hz or self.known.hz

    @property
    def facts(self) -> DrivingFacts:
        return replace(super().facts, decision_hz=self.decision_hz)

    def progress(self, reward: float, info: Any) -> float:
        """The reward as a share of the range between the worst and the best step."""
        worst, best = self.reward or self.known.reward or (0.0, 1.0)
        return float(np.clip((reward - worst) / (best - worst), 0.0, 1.0))

    @property
    def label(self) -> str:
        return self.id

    def writes(self, name: str, value: object) -> str:
        return f"world.{name}={value}"

    def writes_ranges(self) -> str:
        return "write world.features={NAME: [low, high]} in the units of the environment"

    @property
    def clips_rewards(self) -> bool:
        return not (self.reward or self.known.reward)

    def writes_progress(self) -> str:
        return "write world.reward=[WORST, BEST], the rewards of the worst and the best step"

    def _home(self) -> str:
        return made.home(self._spec())

    def modules(self) -> tuple[str, ...]:  # type: ignore[override]
        """The modules of the environment, too."""
        return (type(self).__module__, self._home())


def _actions(space: Any, known: Known) -> tuple[str, ...]:
    """The names of discrete actions; empty for a Box.

    Raises:
        UserError: if it is neither.
    """
    if isinstance(space, spaces.Box):
        return ()
    if not isinstance(space, spaces.Discrete):
        raise UserError(
            f"its environment takes actions of {short(str(space))}: it must be Discrete or Box (several cars, or several choices "
            "at once, need a wrapper)"
        )
    count = int(space.n)
    return known.actions if len(known.actions) == count else tuple(f"action{place}" for place in range(count))


def _controls(space: Any, known: Known) -> tuple[str, ...]:
    """The names of the entries of a Box of actions."""
    if not isinstance(space, spaces.Box):
        return CONTROLS
    count = int(np.prod(space.shape))
    return known.controls if len(known.controls) == count else tuple(f"control{place}" for place in range(count))
