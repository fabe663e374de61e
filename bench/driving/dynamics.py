"""What an attacker with access `dynamics` knows: how a world moves, never the hidden state of an episode."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from cavbench.driving.features import ActionType
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View
from cavbench.errors import UserError


@dataclass(frozen=True)
class Forecast:
    """The predicted course of B episodes under P plans each.

    Args:
        failed: int64 [B, P], number of decisions before the car crashes or leaves the road; T if it does neither.
        crashed: bool [B, P], whether the failure is a crash.
        progress: float32 [B, P], progress summed over the decisions, in [0, T]; 0 from a failure on.
    """

    failed: Tensor
    crashed: Tensor
    progress: Tensor


class Rehearsal(ABC):
    """Simulated episodes that begin with a belief, in several copies: [K, B] for K copies of B episodes.

    Attributes:
        observation: the true observation in the simulation, without sensor noise, [K, B, V, F].
        progress: progress of the last decision, [K, B]; 0 from a failure on.
        failed: bool [K, B], whether the car has crashed or left the road.
    """

    observation: Tensor
    progress: Tensor
    failed: Tensor

    @abstractmethod
    def step(self, action: Tensor) -> None:
        """Simulate one decision: int64 [K, B], or float [K, B, 2] for continuous actions."""

    def order(self, orders: Tensor, view: View, bounds: Traffic) -> None:
        """Give orders to cars of the traffic for the next decision.

        Args:
            orders: [K, B, N, 3] (`cavbench.driving.traffic.Orders`). A car that the belief does not have takes none.
            view: the traffic at the moment of the belief, which numbers the N cars; the same in every call.
            bounds: what the cars may do.

        Raises:
            UserError: if the world has no cars to give orders to.
        """
        raise UserError(
            "the attack needs cars of the traffic to drive, which the simulation of this world does not offer"
        )


class Dynamics(ABC):
    """A world's rules of motion, for attackers. It is bound to the roads of B episodes and a kind of control.

    An attacker keeps a `belief` for each of its episodes, a TensorDict of batch size [B] whose content belongs to the world; the
    road is part of it, so the methods also take the beliefs of some of the episodes. It is computed from true observations alone.
    A belief may be edited: it is the attacker's own.

    Attributes:
        action_type: kind of the actions in a plan.
        actions: number of discrete actions; 0 for continuous ones.
        period: seconds per decision.
    """

    action_type: ActionType
    actions: int
    period: float

    @abstractmethod
    def unknown(self) -> TensorDict:
        """The belief about each episode before anything was seen, batch size [B]."""

    @abstractmethod
    def believe(self, observation: Tensor, before: TensorDictBase) -> TensorDict:
        """The belief after one more true observation.

        Args:
            observation: the true observation, [B, V, F].
            before: the belief one decision earlier, batch size [B].
        """

    @abstractmethod
    def roll(self, belief: TensorDictBase, plans: Tensor) -> Forecast:
        """Predict what happens if the victim executes plans.

        Args:
            belief: the state to start from, batch size [B].
            plans: actions of T decisions: int64 [P, T] or [B, P, T], or for continuous actions float [P, T, 2] or [B, P, T, 2].
        """

    def rehearsal(self, belief: TensorDictBase, copies: int) -> Rehearsal:
        """Simulated episodes, decision by decision.

        Args:
            belief: the state to start from, batch size [B].
            copies: K, copies of each episode.

        Raises:
            UserError: if the world has no such simulation.
        """
        raise UserError("the attack needs a simulation of the world step by step, which this world does not offer")
