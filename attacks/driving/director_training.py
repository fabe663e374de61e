"""The training of a director: a DQN that drives the victim's car through the actions that it orders.

The director is a DQN (`cavbench.driving.victims.dqn`) in a world of its own, whose actions are targets. Its reward is minus that
of a driver. `AdversaryWorld` turns a target into an action of the car: directly, or by an attack on the victim.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Categorical
from torchrl.envs import EnvBase

from cavbench.attacks.driving.targets import Targets
from cavbench.core.ranges import Count, Share
from cavbench.driving import ActionType, Control, DrivingFacts, DrivingWorld, ObservationThreat, Oracle, Policy, State
from cavbench.driving.access import Enforcer
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.dqn import DQN
from cavbench.scenarios import Cell

Induce = Callable[[Tensor, Oracle, Tensor], Tensor]
"""The perturbed observation [B, V, F], from the true one, the oracle and the target of each episode [B]."""


@dataclass(frozen=True, kw_only=True)
class Director(DQN):
    """A DQN whose actions are targets and whose reward is minus that of a driver; the fields are those of `DQN`."""

    sign: ClassVar[float] = -1.0
    selection_episodes: ClassVar[int] = 12

    fine: Share = 0.2
    updates: Count = 2
    checkpoints: Count = 2


@dataclass(frozen=True)
class Victim:
    """The victim of a training, and how to attack it.

    Args:
        policy: the (defended) victim.
        threat: threat model, enforced.
        induce: attacks the victim, to make it take a target.
        seed: seed of the attack's random generator.
    """

    policy: Policy
    threat: ObservationThreat
    induce: Induce
    seed: int


class AdversaryWorld(DrivingWorld):
    """A world whose actions are the targets of a director.

    Args:
        world: the world of the victim.
        action_type: action type of the car.
        count: number of targets.
        driver: what a target does: the car takes the target action itself, or an attacked victim decides.
    """

    def __init__(self, world: DrivingWorld, action_type: ActionType, count: int, driver: Targets | Victim) -> None:
        self.world, self.action_type, self.count, self.driver = world, action_type, count, driver
        self.max_steps = world.max_steps
        # `cavbench.driving.victims` asks the object, never the class.
        self.axes, self.grid = world.axes, world.grid  # type: ignore[misc]

    @property
    def decision_hz(self) -> float:
        return self.world.decision_hz

    @property
    def facts(self) -> DrivingFacts:
        return self.world.facts

    def build(self, cells: Sequence[Cell], control: Control) -> EnvBase:
        """An environment as of `world`, with int64 targets [B] as actions; the victim decides at every frame."""
        env = self.world.make(cells, action_type=self.action_type, driver=control.driver)
        return _AdversaryEnv(env, self.facts, self.count, self.driver, control.action_repeat)


class _AdversaryEnv(EnvBase):
    """Executes each target for `repeat` frames. Arguments as in `AdversaryWorld`."""

    batch_locked = True

    def __init__(self, env: EnvBase, facts: DrivingFacts, count: int, driver: Targets | Victim, repeat: int) -> None:
        super().__init__(device="cpu", batch_size=env.batch_size)
        self.env, self.driver, self.repeat = env, driver, repeat
        self.observation_spec = env.observation_spec.clone()
        self.reward_spec, self.done_spec = env.reward_spec.clone(), env.full_done_spec.clone()
        self.action_spec = Categorical(count, shape=env.batch_size, dtype=torch.int64)
        self.now: TensorDictBase = TensorDict()
        self.state: State = None
        self.started = 0
        if isinstance(driver, Victim):
            generator = torch.Generator().manual_seed(driver.seed)
            subject = CountedPolicy(driver.policy)
            self.enforcer = Enforcer(subject, driver.threat, "gradients", facts.features, generator)

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        asked = None if tensordict is None else tensordict.select("_reset", "seed", strict=False)
        chosen = None if asked is None else asked.get("_reset", None)
        self.now = self.env.reset(asked)
        if isinstance(self.driver, Victim):
            everyone = torch.ones(self.batch_size, dtype=torch.bool)
            self._begin(self.driver.policy, everyone if chosen is None else chosen.squeeze(-1))
        return self.now.exclude("seed", "_reset", "reward", "action").clone()

    def _begin(self, policy: Policy, chosen: Tensor) -> None:
        """Set the victim's state in the episodes `chosen`, bool [B]."""
        first = policy.initial(self.started + torch.arange(len(chosen)))
        self.started += len(chosen)
        if first is None or self.state is None:
            self.state = first
        else:
            self.state[chosen] = first[chosen]

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        target = tensordict["action"]
        reward, progress = torch.zeros(2, *self.batch_size, 1)
        for _ in range(self.repeat):
            running = ~self.now["done"]
            action = self._action(self.now["observation"], target, running.squeeze(-1))
            self.now = self.env.step(self.now.set("action", action))["next"]
            reward = reward + self.now["reward"] * running
            progress = progress + self.now["info", "progress"] * running
        result = self.now.clone()
        result["reward"], result["info", "progress"] = reward, progress
        return result

    def _action(self, observation: Tensor, target: Tensor, running: Tensor) -> Tensor:
        """The action of the car: the target, or what the victim does when it is attacked."""
        if isinstance(self.driver, Targets):
            return self.driver.action(target)
        policy, shown = self.driver.policy, observation.clone()
        rows = running.nonzero().squeeze(-1)
        if len(rows):
            oracle = self.enforcer.begin(observation[rows], None if self.state is None else self.state[rows])
            shown[rows] = self.enforcer.project(self.driver.induce(observation[rows], oracle, target[rows]))[0]
        action = policy.decide(shown, self.state)
        self.state = policy.advance(shown, action, self.state)
        return action
