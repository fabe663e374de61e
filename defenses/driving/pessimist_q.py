"""Acts on the worst case of what the true state may be: the action whose lowest value over a belief is highest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.core.ranges import Count, Share
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.intervals.belief import Belief
from cavbench.driving.intervals.boxes import Assumed, Boxes
from cavbench.driving.intervals.ego import Ego, Step
from cavbench.driving.intervals.policy import IntervalPolicy, remembers, with_inner
from cavbench.driving.threat import Norm
from cavbench.driving.victims.networks import compiled
from cavbench.errors import UserError

SEED = 0
"""Of the corners; a policy is a function of what it sees."""


@dataclass(frozen=True, kw_only=True)
class PessimistQ(DrivingDefense):
    """Takes the action whose lowest value over a belief is highest (after Sun and Zheng 2024, arXiv 2403.04050, Algorithm 1).

    The paper is "Belief-Enriched Pessimistic Q-Learning against Adversarial State Perturbations". The belief is the box of true
    values that an assumed perturbation set allows behind the shown ones; with `tracker` in front, behind all shown so far. Of
    each action the lowest value over points of the belief counts: its middle, the corner where every car is nearer and closing
    faster, the opposite one, and random corners, the same at every step. The paper also trains with this rule; here the victim
    is not trained again. The ego's row is reckoned from its actions. For discrete actions.

    Args:
        assumed_budget: budget of the perturbation set that it assumes.
        assumed_norm: kind of this set.
        pessimism: weight of the lowest value; the rest of the weight is on the value at the middle.
        corners: number of random corners.
    """

    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1
    assumed_norm: Norm = "relative"
    pessimism: Share = 1.0
    corners: Count = 13

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if not victim.sees or victim.action_type != "discrete":
            raise UserError("defense 'pessimist_q' needs a victim that sees and whose actions are discrete")
        return Believing(self, victim.load(seed, facts), facts).eval()


class Believing(IntervalPolicy):
    """A policy that is asked at points of the belief. Its state is the reckoned ego and the inner policy's state."""

    def __init__(self, settings: PessimistQ, policy: Policy, facts: DrivingFacts) -> None:
        super().__init__(facts, policy.action_type, settings.assumed_norm, settings.assumed_budget)
        if self.reckoning.kinematics.way is not None:
            raise UserError("defense 'pessimist_q' needs straight parallel lanes: on this world's road they bend")
        self.policy, self.settings = policy, settings
        self.driver, self.weights_sha256 = policy.driver, policy.weights_sha256
        self.compiled = Belief(self.reckoning, self.assumed)

    def initial(self, episodes: Tensor) -> State:
        own = {"ego": self.reckoning.unknown(episodes)}
        return with_inner(own, self.policy.initial(episodes), episodes.shape)

    def answered(self, observation: Tensor, assumed: Assumed, tracks: Tensor | None, state: State) -> Tensor:
        assert state is not None
        network = compiled(self.policy, observation)
        # What weighs otherwise does not ask for the least answers of a network.
        if network is None or type(self).weighed is not Believing.weighed or not self.compiled.fits(observation, state):
            return super().answered(observation, assumed, tracks, state)
        signs = _signs(self.settings.corners, observation.shape[-2], observation.shape[-1] - 1)
        of = assumed, tracks, state["ego"], signs, self.settings.pessimism
        return self.compiled.scores(observation, *of, network)

    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        if self.compiled.fits(observation, state):
            signs = _signs(self.settings.corners, observation.shape[-2], observation.shape[-1] - 1)
            points = self.compiled(observation, boxes, state["ego"], signs)
        else:
            points, ego = self.belief(observation, boxes), self.reckoning.now(boxes, state["ego"])
            ego = Ego(*(value.expand(len(points), *value.shape) for value in ego))
            points = self.reckoning.corrected(points, ego, boxes, self.assumed)
        inner = state.get("inner", None)
        inner = None if inner is None else inner.expand(len(points), *state.batch_size)
        values = self.policy.scores(points, inner)
        lowest = values.amin(0)
        return values[0] + self.settings.pessimism * (lowest - values[0])

    def moved(self, observation: Tensor, boxes: Boxes, step: Step, action: Tensor, state: State) -> State:
        assert state is not None
        ego, after = step
        inner = state.get("inner", None)
        if remembers(self.policy):
            middle = self.belief(observation, boxes, corners=False)[0]
            middle = self.reckoning.corrected(middle, ego, boxes, self.assumed)
            inner = self.policy.advance(middle, action, inner)
        return with_inner({"ego": after}, inner, state.batch_size)

    def safe(self, boxes: Boxes, state: State) -> None:
        """It promises nothing."""

    def belief(self, observation: Tensor, boxes: Boxes, *, corners: bool = True) -> Tensor:
        """Points of the belief about the other cars, [P, ..., V, F]: the middle, and after it the corners, if wanted."""
        low, high = self.assumed.normalised(boxes.low), self.assumed.normalised(boxes.high)
        middle, half = (low + high) / 2, (high - low) / 2
        sides = torch.zeros_like(half).unsqueeze(0)
        if corners:
            sides = torch.cat((sides, self._corners(half, boxes)))
        measured = torch.where(boxes.present.unsqueeze(-1), middle + sides * half, observation[..., 1:])
        return torch.cat((observation[..., :1].expand(len(measured), *observation[..., :1].shape), measured), -1)

    def _corners(self, half: Tensor, boxes: Boxes) -> Tensor:
        """Sides of the boxes [K, ..., V, F - 1], -1 to 1: nearer and closing faster, the opposite, and random corners."""
        ahead = (boxes.low[..., 0] + boxes.high[..., 0] >= 0).to(half)
        nearer = torch.zeros_like(half)
        nearer[..., 0] = nearer[..., 2] = 1 - 2 * ahead
        drawn = _signs(self.settings.corners, *half.shape[-2:]).to(half)
        drawn = drawn.reshape(-1, *[1] * (half.dim() - 2), *half.shape[-2:]).expand(-1, *half.shape)
        return torch.cat((torch.stack((nearer, -nearer)), drawn))


@cache
def _signs(count: int, rows: int, features: int) -> Tensor:
    """[K, V, F - 1] random signs."""
    drawn = torch.randint(2, (count, rows, features), generator=torch.Generator().manual_seed(SEED))
    return drawn * 2.0 - 1
