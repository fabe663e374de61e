"""A gymnasium environment whose observations are attacked, to train a policy against an attack with any library."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from cavbench.core import registry
from cavbench.core.contracts import Attack, permits
from cavbench.core.pair import Chosen, Pair, choose
from cavbench.driving import DrivingVictim, DrivingWorld, ObservationThreat
from cavbench.driving.gym.environment import DrivingEnv
from cavbench.driving.gym.given import world as world_of
from cavbench.driving.one_step import Form, Session
from cavbench.driving.victims.in_process import in_process
from cavbench.errors import UserError
from cavbench.isolation.modes import usual
from cavbench.scenarios import Cell


class AttackedEnv(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Shows the learner what an attack on a policy makes of each observation, within a threat model.

        env = cavbench.gym.AttackedEnv(cavbench.gym.make("highway", lanes=3), "noise")
        model = DQN("MlpPolicy", env)
        env.policy = model  # pgd attacks the model as it is at the beginning of each episode
        model.learn(20_000)

    Rewards and the ends of episodes are those of the environment. `info` has `attack`: `queries`, `gradients`, `size` and
    `changed` (`cavbench.driving.one_step.Attacked`), and `truth`, the true observation.

    Args:
        env: an environment of `cavbench.gym.make`, or any gymnasium environment that can be a world.
        attack: a name, or an object.
        policy: the policy that is attacked, as in `cavbench.score`. It is copied at the beginning of each episode, so a model in
            training is attacked as it is then. None: nothing is attacked until `env.policy` is set.
        world: the world of another environment than those of `cavbench.gym.make`; by default one made of `env`.
        threat: the threat model, or a mapping of its parameters.

    Raises:
        UserError: if something does not fit; says what.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        attack: str | Attack,
        policy: Any = None,
        *,
        world: DrivingWorld | None = None,
        threat: ObservationThreat | Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__(env)
        inner: Any = env.unwrapped
        own = inner.world if isinstance(inner, DrivingEnv) else None
        found = world or own or world_of(env)
        self._world = Chosen(kind="world", name=type(found).__name__, component=found)
        self._attack = (
            choose("attack", attack)
            if isinstance(attack, str)
            else Chosen(kind="attack", name=type(attack).__name__, component=attack)
        )
        self._facts = found.facts
        self._threat = _threat(threat, self._attack.component)
        self.policy = policy
        self._session: Session | None = None
        self._seed, self._episodes = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and copy the policy as it is now."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._seed, self._episodes = seed, 0
        self._episodes += 1
        self._session = None if self.policy is None else self._begun(observation)
        return self._shown(observation, info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Carry out the action of the learner, and attack what it sees then."""
        if self._session is not None and self._session.state is not None:
            self._session.advance(self._last, self._as_tensor(action))
        observation, reward, terminated, truncated, info = self.env.step(action)
        return *self._shown(observation, info)[:1], reward, terminated, truncated, self._info

    @usual()
    def _begun(self, observation: Any) -> Session:
        form = Form(self._facts, self._flat(observation))
        if isinstance(self.policy, str | DrivingVictim):
            victim: Any = choose("victim", self.policy).component if isinstance(self.policy, str) else self.policy
        else:
            kind = "discrete" if isinstance(self.action_space, spaces.Discrete) else "continuous"
            try:
                victim = in_process([self.policy], self._facts, form.shown(), kind)
            except ValueError as error:
                raise UserError(str(error)) from error
        pair = Pair(
            attack=self._attack,
            defense=choose("defense", "none"),
            victim=Chosen(kind="victim", name=type(victim).__name__, component=victim),
            world=self._world,
            threat=self._threat,
        )
        # Each episode of each seed has numbers of its own.
        return Session(pair, pair.network(0), [self._cell()], self._seed * 100_000 + self._episodes)

    def _cell(self) -> Cell:
        """The cell of this episode."""
        inner: Any = self.env.unwrapped
        return inner.cell if isinstance(inner, DrivingEnv) else registry.grid_of(self._world.component).cells()[0]

    def _shown(self, observation: Any, info: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """What the learner sees, and the info with what that cost."""
        if self._session is None:
            self._info = info
            return observation, info
        form = Form(self._facts, self._flat(observation))
        truth = form.shown()
        shown, clean, taken = self._session.show(truth)
        self._last = shown.observation
        cost = {
            "queries": int(shown.queries[0]),
            "gradients": int(shown.gradients[0]),
            "size": float((shown.observation - truth).abs().max()),
            "changed": bool((clean != taken).any()),
        }
        self._info = {**info, "attack": cost, "truth": observation}
        found = form.back(shown.observation, truth)
        space = self.env.observation_space
        return (found if isinstance(space, spaces.Box) else spaces.unflatten(space, found)), self._info

    def _flat(self, observation: Any) -> Any:
        space = self.env.observation_space
        return observation if isinstance(space, spaces.Box) else spaces.flatten(space, observation)

    def _as_tensor(self, action: Any) -> torch.Tensor:
        """The learner's action as a policy answers it: its number, or controls in [-1, 1]; [1] or [1, A]."""
        space: Any = self.action_space
        if isinstance(space, spaces.Discrete):
            return torch.tensor([int(action) - int(space.start)])
        share = (np.asarray(action, np.float32) - space.low) / (space.high - space.low)
        return torch.as_tensor(2 * share - 1, dtype=torch.float32).reshape(1, -1)


def _threat(given: ObservationThreat | Mapping[str, Any] | None, attack: Any) -> ObservationThreat:
    """The threat model; unless it is given, it allows what the attack needs."""
    if isinstance(given, ObservationThreat):
        return given
    values = dict(given or {})
    if "access" not in values and not permits("gradients", attack.access):
        values["access"] = attack.access
    try:
        return ObservationThreat(**values)
    except (ValueError, TypeError) as error:
        raise UserError(f"threat: {str(error).splitlines()[0]}") from error
