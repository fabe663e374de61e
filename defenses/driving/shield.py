"""A safety filter around a driver: of its actions only those that the worst case of the intervals leaves safe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.core.ranges import NotNegative
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, Passed, Policy, State
from cavbench.driving.intervals.boxes import Assumed, Boxes
from cavbench.driving.intervals.corridor import Corridor, CorridorJudge
from cavbench.driving.intervals.ego import Ego, Step
from cavbench.driving.intervals.margins import Judge, Margins
from cavbench.driving.intervals.mask import Mask
from cavbench.driving.intervals.policy import IntervalPolicy, remembers, with_inner
from cavbench.driving.intervals.rooms import Caution, cars_of
from cavbench.driving.threat import Norm
from cavbench.driving.victims.networks import compiled
from cavbench.errors import UserError

SOFTNESS = 2.0
"""Width in m over which the gradient of the filter is spread around its threshold."""


@dataclass(frozen=True, kw_only=True)
class Shield(DrivingDefense):
    """Allows only actions that are safe in the worst case and not needlessly slow; clips continuous actions.

    The worst case is over the true values that an assumed perturbation set allows behind the shown ones. The ego's own motion
    is reckoned from its actions; the victim receives the reckoned row. An action is safe if the gap to every car ahead lasts
    when the ego brakes from the next decision on. Where FASTER leaves a margin of at least `band`, IDLE and SLOWER are masked,
    so that an attack cannot make the car crawl. If no action is safe, it brakes, or leaves its lane for one with room.
    Continuous actions are clipped to what this leaves of acceleration and steering.

    Args:
        assumed_budget: budget of the perturbation set that it assumes.
        assumed_norm: kind of this set.
        assumed_noise: by how much the sensor may be wrong about other cars along the road besides, in m and m/s.
        band: margin of FASTER in m from which on slower actions are masked.
        braking: least deceleration that is assumed of a car ahead, in m/s2; it is higher behind a queue.
        braking_s: how long a car ahead is assumed to brake, in s.
        distance: room between two cars that is always kept, in m.
    """

    brakes_to: ClassVar[float | None] = 10.0
    reckons: ClassVar[bool] = True

    assumed_budget: Annotated[float, Interval(ge=0, le=0.9)] = 0.1
    assumed_norm: Norm = "relative"
    assumed_noise: NotNegative = 0.05
    band: NotNegative = 0.0
    braking: NotNegative = 0.5
    braking_s: NotNegative = 2.0
    distance: NotNegative = 0.4

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        if not victim.sees:
            raise UserError("defense 'shield' needs a victim that sees")
        shielded = Shielded if victim.action_type == "discrete" else ShieldedControls
        return shielded(self, victim.load(seed, facts), facts).eval()


class Filter(IntervalPolicy):
    """A policy behind a filter. Its state is the reckoned ego, and the inner policy's state."""

    def __init__(self, settings: Shield, policy: Policy, facts: DrivingFacts) -> None:
        super().__init__(
            facts, policy.action_type, settings.assumed_norm, settings.assumed_budget, settings.assumed_noise
        )
        self.policy, self.band = policy, settings.band
        self.driver, self.weights_sha256 = policy.driver, policy.weights_sha256
        self.caution = Caution(braking=settings.braking, seconds=settings.braking_s, distance=settings.distance)

    def initial(self, episodes: Tensor) -> State:
        own = {"ego": self.reckoning.unknown(episodes)}
        return with_inner(own, self.policy.initial(episodes), episodes.shape)

    def moved(self, observation: Tensor, boxes: Boxes, step: Step, action: Tensor, state: State) -> State:
        assert state is not None
        ego, after = step
        inner = state.get("inner", None)
        if remembers(self.policy):
            inner = self.policy.advance(self.reckoning.corrected(observation, ego, boxes, self.assumed), action, inner)
        return with_inner({"ego": after, **self.kept(ego, boxes, state)}, inner, state.batch_size)

    def kept(self, ego: Ego, boxes: Boxes, state: TensorDictBase) -> dict[str, Tensor]:
        """What the next state has besides."""
        return {}

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        assert state is not None
        boxes = self.boxes(observation, state)
        ego = self.ego(boxes, state)
        return self.policy.value(
            self.reckoning.corrected(observation, ego, boxes, self.assumed), action, state.get("inner", None)
        )

    def ego(self, boxes: Boxes, state: TensorDictBase) -> Ego:
        return self.reckoning.now(boxes, state["ego"])


class Shielded(Filter):
    """The filter for discrete actions: a mask."""

    def __init__(self, settings: Shield, policy: Policy, facts: DrivingFacts) -> None:
        super().__init__(settings, policy, facts)
        self.judge = Judge(self.reckoning, self.period, self.caution)
        self.mask = Mask(self.judge, self.assumed, self.band, SOFTNESS)

    def answered(self, observation: Tensor, assumed: Assumed, tracks: Tensor | None, state: State) -> Tensor:
        assert state is not None
        network = compiled(self.policy, observation)
        # What weighs otherwise is no mask in front of a network.
        if network is None or type(self).weighed is not Shielded.weighed or not self.mask.fits(observation, state):
            return super().answered(observation, assumed, tracks, state)
        return self.mask.scores(observation, assumed, tracks, state["ego"], network)

    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        if self.mask.fits(observation, state):
            found = self.mask(observation, boxes, state["ego"])
            return self.mask.lowered(self.policy.scores(found.seen, state.get("inner", None)), found)
        ego = self.ego(boxes, state)
        values = self.policy.scores(
            self.reckoning.corrected(observation, ego, boxes, self.assumed), state.get("inner", None)
        )
        allowed = self.allowed(self.margins(ego, boxes))
        # The masked values are below the others; no step of this hides the victim's gradient.
        spread = (values.amax(-1, keepdim=True) - values.amin(-1, keepdim=True)).detach() + 1
        return values - spread * (1 - allowed)

    def filtered(self, observation: Tensor, boxes: Boxes, state: State) -> Passed:
        assert state is not None
        if self.mask.fits(observation, state):
            found = self.mask(observation, boxes, state["ego"])
            return Passed(found.seen, found.hard[..., self.reckoning.order] > 0)
        ego = self.ego(boxes, state)
        return Passed(
            self.reckoning.corrected(observation, ego, boxes, self.assumed),
            self.allowed(self.margins(ego, boxes)) > 0.5,
        )

    def safe(self, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        # What was shown counts only for what is passed on.
        shown = boxes.low.new_zeros(*boxes.present.shape, 1 + boxes.low.shape[-1])
        if self.mask.fits(shown, state):
            return self.mask(shown, boxes, state["ego"]).safe
        return self.margins(self.ego(boxes, state), boxes).safe

    def margins(self, ego: Ego, boxes: Boxes) -> Margins:
        return self.judge(ego, cars_of(ego, boxes, self.reckoning.kinematics))

    def allowed(self, margins: Margins) -> Tensor:
        """[..., A] 1 for the allowed actions and 0 for the others, with the gradient of a soft threshold (straight-through)."""
        stay, change = margins.stay, margins.worth_changing
        safe = stay >= 0
        needless = stay[..., :1] >= self.band
        keeps = torch.cat((safe[..., :1], safe[..., 1:] & ~needless), -1)
        changes = (change >= 0) & margins.changeable
        none = ~keeps.any(-1, keepdim=True) & ~changes.any(-1, keepdim=True)
        hard = torch.cat((keeps | (none & margins.most), changes), -1).to(stay)
        soft = torch.cat((stay, change), -1).div(SOFTNESS).sigmoid()
        ordered = hard + soft - soft.detach()
        return ordered[..., self.reckoning.order]


class ShieldedControls(Filter):
    """The filter for continuous actions: a projection onto what is left of acceleration and steering.

    Its state has the highest lane that was seen besides.
    """

    def __init__(self, settings: Shield, policy: Policy, facts: DrivingFacts) -> None:
        super().__init__(settings, policy, facts)
        self.judge = CorridorJudge(self.reckoning, self.period, self.caution, self.band)

    def initial(self, episodes: Tensor) -> State:
        state = super().initial(episodes)
        assert state is not None
        state["edge"] = torch.zeros(len(episodes), device=episodes.device)
        return state

    def kept(self, ego: Ego, boxes: Boxes, state: TensorDictBase) -> dict[str, Tensor]:
        return {"edge": self.edge(ego, boxes, state)}

    def weighed(self, observation: Tensor, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        ego = self.ego(boxes, state)
        wanted = self.policy.scores(
            self.reckoning.corrected(observation, ego, boxes, self.assumed), state.get("inner", None)
        )
        left = self.corridor(ego, boxes, state)
        # The gradient of the bound that holds, and that of the victim as if there were none (straight-through).
        return torch.minimum(torch.maximum(wanted.detach(), left.low), left.high) + wanted - wanted.detach()

    def filtered(self, observation: Tensor, boxes: Boxes, state: State) -> Passed:
        assert state is not None
        ego = self.ego(boxes, state)
        left = self.corridor(ego, boxes, state)
        return Passed(
            self.reckoning.corrected(observation, ego, boxes, self.assumed), torch.stack([left.low, left.high], -2)
        )

    def safe(self, boxes: Boxes, state: State) -> Tensor:
        assert state is not None
        return self.corridor(self.ego(boxes, state), boxes, state).safe

    def corridor(self, ego: Ego, boxes: Boxes, state: TensorDictBase) -> Corridor:
        return self.judge(ego, cars_of(ego, boxes, self.reckoning.kinematics), self.edge(ego, boxes, state))

    def edge(self, ego: Ego, boxes: Boxes, state: TensorDictBase) -> Tensor:
        """The highest lane [...] that is known to exist: the ego was in it, or a car surely was."""
        lane = cars_of(ego, boxes, self.reckoning.kinematics).rightmost(self.reckoning.kinematics.lane_width)
        return torch.maximum(torch.maximum(lane, ego.target_lane), state["edge"])
