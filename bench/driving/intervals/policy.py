"""Policies that act on the intervals behind the shown values."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.features import ActionType, DrivingFacts
from cavbench.driving.intervals.bends import BentReckoning
from cavbench.driving.intervals.boxes import Assumed, Boxes
from cavbench.driving.intervals.ego import DeadReckoning, Step
from cavbench.driving.policy import Passed, Policy, State
from cavbench.driving.threat import Norm
from cavbench.errors import UserError

FEATURES = ("x", "y", "vx", "vy")
DECISIONS = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")


class IntervalPolicy(Policy):
    """A policy on boxes. A tracker in front of it gives it tighter boxes than a single observation does.

    Its state has the reckoned ego as `ego`, [..., 7] (`cavbench.driving.intervals.ego.reckoned`).

    Args:
        facts: facts of the world.
        action_type: kind of the actions.
        norm, budget: the perturbation set that it assumes.
        noise: the error of the sensor that it assumes, in m and m/s.

    Raises:
        UserError: if the world does not offer what intervals need.
    """

    def __init__(
        self, facts: DrivingFacts, action_type: ActionType, norm: Norm, budget: float, noise: float = 0.0
    ) -> None:
        super().__init__()
        self.action_type = action_type
        self.assumed = Assumed(facts.features, norm, budget, noise)
        self.period = 1 / facts.decision_hz
        self.reckoning = reckoning(facts, action_type)

    def boxes(self, observation: Tensor, state: State) -> Boxes:
        """What is known about every row of an observation [..., V, F]."""
        assert state is not None
        return self.reckoning.boxes(self.assumed, observation, state["ego"])

    @abstractmethod
    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        """The scores, as in `scores`, for given boxes."""

    @abstractmethod
    def moved(self, observation: Tensor, boxes: Boxes, step: Step, action: Tensor, state: State) -> State:
        """The state after a step, as in `advance`, for given boxes, with what `reckoning.step` answers about the ego."""

    @abstractmethod
    def safe(self, boxes: Boxes, state: State) -> Tensor | None:
        """Whether an action has a margin of at least 0, bool [...]; None if it promises nothing."""

    def answered(self, observation: Tensor, assumed: Assumed, tracks: Tensor | None, state: State) -> Tensor:
        """The scores, as in `scores`, with the boxes of a set and of an estimator's tracks (`Assumed.boxes`)."""
        assert state is not None
        return self.weighed(observation, self.reckoning.boxes(assumed, observation, state["ego"], tracks), state)

    def filtered(self, observation: Tensor, boxes: Boxes, state: State) -> Passed:
        """As `passed`, for given boxes."""
        return Passed(observation)

    def passed(self, observation: Tensor, state: State = None) -> Passed:
        return self.filtered(observation, self.boxes(observation, state), state)

    def assured(self, observation: Tensor, state: State) -> Tensor | None:
        return self.safe(self.boxes(observation, state), state)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self.answered(observation, self.assumed, None, state)

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        assert state is not None
        boxes = self.boxes(observation, state)
        return self.moved(observation, boxes, self.reckoning.step(boxes, state["ego"], action), action, state)


def reckoning(facts: DrivingFacts, action_type: ActionType) -> DeadReckoning:
    """Dead reckoning in a world.

    Raises:
        UserError: if the world does not offer what it needs.
    """
    if facts.kinematics is None:
        raise UserError("intervals need the kinematics of cars on parallel lanes: this world declares none")
    if facts.features.names != FEATURES:
        raise UserError(
            f"intervals need the features {', '.join(FEATURES)}, the world measures {', '.join(facts.features.names)}"
        )
    if action_type == "discrete" and not set(DECISIONS) <= set(facts.actions):
        raise UserError(f"intervals need the actions {', '.join(DECISIONS)}, the world has {', '.join(facts.actions)}")
    if facts.kinematics.way is None:
        return DeadReckoning(facts.kinematics, 1 / facts.decision_hz, facts.actions, action_type)
    if action_type == "continuous":
        raise UserError("intervals of continuous actions need straight parallel lanes: on this world's road they bend")
    return BentReckoning(facts.kinematics, 1 / facts.decision_hz, facts.actions, action_type)


def with_inner(own: Mapping[str, Tensor | TensorDictBase], inner: State, shape: torch.Size) -> TensorDict:
    """The state of a defence: its own entries, and the state of the policy behind it as `inner`, if that has one."""
    return TensorDict({**own, **({} if inner is None else {"inner": inner})}, batch_size=shape)


def remembers(policy: Policy) -> bool:
    """Whether a policy has an `advance` of its own: that of the others leaves their state as it is, and needs no observation."""
    return type(policy).advance is not Policy.advance
