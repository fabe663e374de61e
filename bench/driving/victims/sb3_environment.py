"""The environments that a Stable-Baselines3 model still has: what they say of the world of its training."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from cavbench.core.pair import Chosen
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.spaces import UNKNOWN
from cavbench.errors import UserError, short
from cavbench.identity.content import content
from cavbench.scenarios import Grid

RESHAPING = ("FlattenObservation", "DtypeObservation")
"""Wrappers that change no number of an observation."""
STACKING = ("VecFrameStack", "FrameStackObservation")
"""Wrappers of `LIBRARIES` that stack frames; a model's stack is rebuilt (`cavbench.driving.victims.sb3_model`)."""
HARMLESS = (
    *STACKING,
    *("OrderEnforcing", "PassiveEnvChecker", "TimeLimit", "Autoreset", "RecordEpisodeStatistics", "RecordVideo"),
    *("HumanRendering", "RenderCollection", "AddWhiteNoise", "ObstructView", "NormalizeReward", "Monitor"),
    *("VecMonitor", "VecCheckNan", "VecVideoRecorder"),
)
"""Wrappers of `LIBRARIES` that change neither observations, actions nor the rate of decisions."""
LIBRARIES = ("gymnasium", "stable_baselines3")
"""Their other wrappers change one of these."""

CELLS = 16
"""So many environments of the world are compared at most: a model may be trained in any cell."""
DRAWN = ("render", "offscreen", "screen", "show", "scaling", "centering", "real_time", "manual")
"""Options of an environment that begin so say how it is drawn."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """The chain of wrappers of an environment.

    Args:
        inner: the innermost environment.
        changing: names of the wrappers that change observations, actions or the rate of decisions, from the outside in.
        settings: a hash of the arguments and of the statistics of each.
        known: whether all the others are known to change nothing.
    """

    inner: Any
    changing: tuple[str, ...]
    settings: tuple[str, ...]
    known: bool

    @property
    def id(self) -> str:
        """The registered name of the environment; empty if it has none."""
        return str(getattr(getattr(self.inner, "spec", None), "id", "") or "")

    def world_of(self, world: Chosen[Any], grid: Grid, label: Callable[[DrivingWorld], str]) -> str:
        """The world of the training, as tables print it; the name of an environment that is no world; or `unknown`.

        Args:
            world: the world of the run.
            grid: its grid.
            label: the name of a world.

        Raises:
            UserError: if it is the environment of the run's world, with wrappers that the world does not have.
        """
        trained = getattr(self.inner, "world", None)
        if isinstance(trained, DrivingWorld) and type(self.inner).__module__ == "cavbench.driving.gym.environment":
            self._refuse(None)
            return label(trained) if self.known else UNKNOWN
        owns = self._of_gym(world.component, grid)
        own = next(owns, None)
        if own is None or (self.id or type(self.inner)) != (own.id or type(own.inner)):
            return self.id or UNKNOWN
        self._refuse(own)
        if differs := self._differences(own):
            # It may have been trained in another cell.
            differs = min([differs, *map(self._differences, owns)], key=len)
        if differs:
            return f"{self.id}({', '.join(differs)})" if self.id else UNKNOWN
        return str(world) if self.known else UNKNOWN

    def _differences(self, own: Training) -> list[str]:
        """The options of its environment that are others than those of an environment of the world."""
        found, there = _options(self.inner), _options(own.inner)
        names = [name for name in sorted({*found, *there}) if content(found.get(name)) != content(there.get(name))]
        return [f"{name}={short(str(found.get(name)))}" for name in names]

    def _of_gym(self, world: DrivingWorld, grid: Grid) -> Iterator[Training]:
        """The environments of some cells of a world that stands for a gymnasium environment; none for another world."""
        if not callable(getattr(world, "environment", None)):
            return
        for cell in grid.cells()[:CELLS]:
            env = world.environment(cell)  # type: ignore[attr-defined]
            try:
                yield chain(env)
            finally:
                env.close()

    def _refuse(self, own: Training | None) -> None:
        """Refuse wrappers that the environment of the world, if it is made of one, does not have."""
        wrapped = own.changing if own else ()
        instead = "train it without, or give a torch.nn.Module that does the same to the world's observation"
        if (found := self.changing) != wrapped:
            other = [name for name in found if name not in wrapped] or list(found) or list(wrapped)
            raise UserError(
                f"the model was trained behind {', '.join(other)}, which the world does not have: {instead}"
            )
        for name, here, there in zip(found, self.settings, own.settings if own else (), strict=True):
            if here != there:
                raise UserError(
                    f"the model was trained behind {name} with other settings or statistics than in the world: {instead}"
                )


def chain(env: Any) -> Training:
    """The wrappers of an environment of gymnasium."""
    import gymnasium

    changing, known = [], True
    while isinstance(env, gymnasium.Wrapper):
        changes = isinstance(env, gymnasium.ObservationWrapper | gymnasium.ActionWrapper) or hasattr(env, "obs_rms")
        harmless = isinstance(env, gymnasium.RewardWrapper) or type(env).__name__ in (*HARMLESS, *RESHAPING)
        ours = _package(env) in LIBRARIES
        if (changes and type(env).__name__ not in (*RESHAPING, *STACKING)) or (ours and not harmless):
            changing.append(env)
        known = known and (changes or ours)
        env = env.env
    return Training(
        inner=env,
        changing=tuple(type(one).__name__ for one in changing),
        settings=tuple(_settings(one) for one in changing),
        known=known,
    )


def _options(inner: Any) -> dict[str, Any]:
    """The arguments that a registered environment was made with, and highway-env's configuration, without what is drawn."""
    made = getattr(getattr(inner, "spec", None), "kwargs", None) or {}
    config = getattr(inner, "config", None)
    found = {
        **{name: value for name, value in made.items() if name != "config"},
        **(config if isinstance(config, dict) else {}),
    }
    return {name: value for name, value in found.items() if not str(name).startswith(DRAWN)}


def _settings(wrapper: Any) -> str:
    """A hash of the arguments that gymnasium keeps of a wrapper, and of its statistics."""
    statistics = getattr(wrapper, "obs_rms", None)
    return content([getattr(wrapper, "_saved_kwargs", None), statistics and [statistics.mean, statistics.var]])


def _package(wrapper: Any) -> str:
    return type(wrapper).__module__.partition(".")[0]


def training_of(model: Any) -> Training | None:
    """The environment of a model; None if it has none in this process, or several that differ."""
    env, changing, known = model.get_env(), [], True
    while hasattr(env, "venv"):
        name = type(env).__name__
        # The statistics of the outermost one are used.
        normalises = name == "VecNormalize" and env.norm_obs and env is not model.get_vec_normalize_env()
        harmless = name in HARMLESS or (name == "VecNormalize" and not normalises)
        if _package(env) in LIBRARIES and not harmless:
            changing.append(name)
        known = known and _package(env) in LIBRARIES
        env = env.venv
    found = [chain(one) for one in getattr(env, "envs", ())]
    first = found[0] if found else None
    alike = all(
        (one.id, one.changing, one.known, getattr(one.inner, "world", None), content(_options(one.inner)))
        == (first.id, first.changing, first.known, getattr(first.inner, "world", None), content(_options(first.inner)))
        for one in found
        if first is not None
    )
    if first is None or not alike:
        return None
    return replace(
        first,
        changing=(*changing, *first.changing),
        settings=(*[content(name) for name in changing], *first.settings),
        known=known and first.known,
    )
