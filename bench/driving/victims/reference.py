"""Baseline drivers that ignore the observation; a victim that does not beat them is not worth attacking."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.registry import unknown
from cavbench.driving import ActionType, Driver, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.features import CONSTANT_CONTROLS, CONSTANT_SHARES, RIGHT_THEN_SLOWER
from cavbench.errors import UserError

RIGHT_S = 4.0
"""Seconds of lane changes to the right: enough to cross four lanes at 25 m/s, one after the other."""
DRAWS = 1024
"""Number of random actions drawn for an episode; a longer episode repeats them."""


class _Constant(Policy):
    """The same scores at every step."""

    def __init__(self, scores: Tensor, action_type: ActionType, driver: Driver = "agent") -> None:
        super().__init__()
        self.always, self.action_type, self.driver = scores, action_type, driver

    def forward(self, observation: Tensor) -> Tensor:
        return self.always.expand(*observation.shape[:-2], len(self.always))


class _FirstThen(Policy):
    """One action for a number of steps, then another; its state counts the steps."""

    action_type = "discrete"

    def __init__(self, first: Tensor, steps: int, then: Tensor) -> None:
        super().__init__()
        self.first, self.steps, self.then = first, steps, then

    def initial(self, episodes: Tensor) -> State:
        return TensorDict({"step": torch.zeros_like(episodes)}, batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        return torch.where(state["step"].unsqueeze(-1) < self.steps, self.first, self.then)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        return TensorDict({"step": state["step"] + 1}, batch_size=state.batch_size)


@dataclass(frozen=True, kw_only=True)
class Blind(DrivingVictim):
    """An input-independent policy: a constant action, or a change to the rightmost lane and then braking.

    The best of these policies in a cell is the baseline under attack: a victim with a lower score would do better without input.

    Args:
        policy: `throttle`, `coast` and `brake` are continuous (`all_low`, `all_middle` and `all_high` in a world with other
            controls). Other values are names of the world's discrete actions, in lower case; `right_then_slower` changes to the
            rightmost lane, then slows down.
    """

    sees: ClassVar[bool] = False
    policy: str = RIGHT_THEN_SLOWER

    @property
    def action_type(self) -> ActionType:
        return "continuous" if self.policy in {*CONSTANT_CONTROLS, *CONSTANT_SHARES} else "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        known = facts.blind_policies(self.action_type)
        if self.policy not in known:
            every = dict.fromkeys([*known, *facts.constant_controls()])
            raise UserError(unknown(f"victim.policy {self.policy!r}", self.policy, every))
        if self.action_type == "continuous":
            return _Constant(torch.tensor(facts.constant_controls()[self.policy]), "continuous").eval()
        actions = torch.eye(len(facts.actions))
        place = [name.lower() for name in facts.actions].index
        if self.policy == RIGHT_THEN_SLOWER:
            steps = round(RIGHT_S * facts.decision_hz)
            return _FirstThen(actions[place("lane_right")], steps, actions[place("slower")]).eval()
        return _Constant(actions[place(self.policy)], "discrete").eval()


class _RandomPolicy(Policy):
    """Random actions from one generator per episode, so that they do not depend on the rest of the batch."""

    def __init__(self, action_type: ActionType, actions: int, controls: int) -> None:
        super().__init__()
        self.action_type, self.actions, self.controls = action_type, max(actions, controls), controls

    def initial(self, episodes: Tensor) -> State:
        generators = [torch.Generator().manual_seed(int(episode)) for episode in episodes]
        draws = torch.stack([torch.rand(DRAWS, self.actions, generator=generator) for generator in generators])
        return TensorDict(
            {"step": torch.zeros_like(episodes), "draws": draws.to(episodes.device)}, batch_size=episodes.shape
        )

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        assert state is not None
        step = (state["step"] % DRAWS).view(-1, 1, 1).expand(-1, 1, self.actions)
        draw = state["draws"].gather(1, step).squeeze(1)
        return draw if self.action_type == "discrete" else 2 * draw[:, : self.controls] - 1

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        return TensorDict({"step": state["step"] + 1, "draws": state["draws"]}, batch_size=state.batch_size)


@dataclass(frozen=True, kw_only=True)
class RandomDriver(DrivingVictim):
    """Uniformly random actions.

    Args:
        actions: discrete lane-changing decisions, or continuous acceleration and steering.
    """

    sees: ClassVar[bool] = False
    actions: Literal["discrete", "continuous"] = "discrete"

    @property
    def action_type(self) -> ActionType:
        return self.actions

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return _RandomPolicy(self.actions, len(facts.actions), len(facts.controls)).eval()


@dataclass(frozen=True, kw_only=True)
class IDMDriver(DrivingVictim):
    """The world's own traffic driver: IDM for speed, MOBIL for lane changes (Treiber et al. 2000, Kesting et al. 2007).

    It reads the simulator's true state instead of the observation, so attacks and weather have no effect on it.
    """

    sees: ClassVar[bool] = False
    driver: ClassVar[Driver] = "idm"

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        if "idm" not in facts.drivers:
            raise UserError("the world has no IDM driver")
        return _driven_by_the_world(facts, "idm")


@dataclass(frozen=True, kw_only=True)
class ClairvoyantDriver(DrivingVictim):
    """A planner with perfect information, a reference above all other drivers (random-shooting model-predictive control).

    Three times a second it tries 64 plans of 4 s in copies of the simulator, hidden state included, and follows the best one. It
    reads no observation, so attacks and weather have no effect on it.
    """

    sees: ClassVar[bool] = False
    driver: ClassVar[Driver] = "clairvoyant"

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        if "clairvoyant" not in facts.drivers:
            raise UserError("the world has no planner with perfect information")
        return _driven_by_the_world(facts, "clairvoyant")


def _driven_by_the_world(facts: DrivingFacts, driver: Driver) -> Policy:
    """A policy whose actions the world ignores."""
    idle = facts.actions.index("IDLE") if "IDLE" in facts.actions else 0
    return _Constant(torch.eye(len(facts.actions))[idle], "discrete", driver=driver).eval()
