"""The threat model of the driving track: the perturbation set, and the projection onto it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
import torch
from annotated_types import Interval
from numpy.typing import NDArray
from torch import Tensor

from cavbench.core import sets
from cavbench.core.contracts import ThreatModel
from cavbench.core.ranges import Natural, Share
from cavbench.driving.features import Features
from cavbench.driving.invented import NEEDED
from cavbench.driving.sets import Actuator, Held, Latency, Messages, Presence, Traffic
from cavbench.driving.surroundings import Surroundings

Norm = Literal["relative", "linf"]


@dataclass(frozen=True, kw_only=True)
class ObservationThreat(ThreatModel):
    """The threat model of the driving track.

    Args:
        norm: `relative`: each measured value of a present row may change by `budget` times its value, or by the feature's
            floor (scaled with the budget) if that is larger (thesis 4.3.1). `linf`: it may change by `budget` on the [-1, 1]
            scale (thesis 4.4.3, read as a range; a stress test).
        budget: size of the set, in [0, 2]. Users may write it in per cent, 10% for 0.1, and must from 100 % of a value on.
        queries: largest number of policy evaluations per episode and step.
        share: share of the frames of a full episode that may be attacked, rounded down; the attack chooses the frames.
        presence: cars that may be hidden or invented.
        latency: how late the sensor may be.
        held: how long the sensor may be frozen.
        actuator: how late and how far off commands may be executed.
        traffic: cars of the traffic that the attacker drives.
        dynamics: how the traffic drives and what the ego weighs, of which the victim is not told.
        messages: messages of other cars that the attacker forges.

    The last seven are empty by default, and combine (`cavbench.driving.sets`). `fixed` features of the world cannot be changed.
    Values are clipped to [-1, 1], the range of every sensor. Without the set `presence` no row comes or goes.
    """

    norm: Norm = "relative"
    budget: Annotated[float, Interval(ge=0, le=2)] = 0.1
    queries: Natural = 1000
    share: Share = 1.0
    presence: Presence = field(default_factory=Presence)
    latency: Latency = field(default_factory=Latency)
    held: Held = field(default_factory=Held)
    actuator: Actuator = field(default_factory=Actuator)
    traffic: Traffic = field(default_factory=Traffic)
    dynamics: Surroundings = field(default_factory=Surroundings)
    messages: Messages = field(default_factory=Messages)

    def slip(self) -> str:
        if self.norm != "relative" or self.budget < 1:
            return ""
        return f"a budget of {self.budget:g} lets each value change by {100 * self.budget:g} % of itself"

    def frames(self, steps: int) -> int:
        """Number of frames that may be attacked in an episode of at most `steps` decisions: floor(share * steps)."""
        # A share such as 0.3 is a little below three tenths.
        return math.floor(self.share * steps + 1e-9)

    def radius(self, observation: Tensor, features: Features, scale: float = 1.0) -> Tensor:
        """[..., V, F] the largest deviation of each entry, on the normalised scale; 0 for presence, fixed features, absent rows.

        Args:
            observation: the true observation [..., V, F].
            features: names and ranges of the measured features.
            scale: multiplies the budget (adversarial training increases it gradually).
        """
        measured = observation[..., 1:]
        budget = self.budget * scale
        if self.norm == "linf":
            bound = torch.full_like(measured, budget)
        else:
            floor = torch.tensor(features.floors or (0.0,)).to(measured) * (budget / 0.1)
            furthest = torch.maximum(budget * features.physical(observation).abs(), floor)
            bound = furthest / features.half_range().to(measured)
        bound = bound * (observation[..., :1] > 0)
        if features.fixed:
            bound = bound * features.forgeable().to(bound)
        if features.present:
            bound = bound * features.there(observation)
        return torch.cat((torch.zeros_like(observation[..., :1]), bound), -1)

    def lacks(self, world: Any, victim: Any) -> str:
        """Which set the world cannot carry out, in one line; empty if it can."""
        for name in sets.present(self):
            if name not in world.offers:
                return f"threat.{name} is a set that the world does not carry out: it has {', '.join(world.offers)}"
        if self.presence != Presence():
            needed = NEEDED if self.presence.invented else NEEDED[:1]
            if missing := [one for one in needed if one not in world.features.names]:
                return f"threat.presence needs rows of cars with {', '.join(needed)}, the world does not measure {missing[0]}"
        if (self.actuator.offset or self.actuator.noise) and victim.action_type != "continuous":
            return "threat.actuator.offset and .noise need continuous actions, the victim's are discrete"
        return ""

    def reach(self, rows: int, features: Features, steps: int) -> float:
        """The largest L2 norm of all that an attack can change in an episode, on the normalised scale; inf if it may change more
        than what is observed.

        Args:
            rows: rows of an observation.
            features: names and ranges of the measured features.
            steps: decisions of a full episode.
        """
        if sets.present(self):
            # Other commands and other traffic make another episode; another frame or another car has other rows, without noise.
            return math.inf
        extremes = torch.ones(rows, 1 + len(features.names)) * torch.tensor([1.0, -1.0])[:, None, None]
        extremes[..., 0] = 1.0
        largest = self.radius(extremes, features).amax(0)
        return float(largest.norm()) * math.sqrt(self.frames(steps))


def project(perturbed: Tensor, observation: Tensor, radius: Tensor) -> Tensor:
    """The nearest point of the perturbation set: within `radius` of `observation` and within the sensors' range [-1, 1].

    NaN is replaced with the true value.
    """
    return within(perturbed, observation, *bounds(observation, radius))


def bounds(observation: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest and the highest value of every entry of the perturbation set."""
    return (observation - radius).clamp(-1.0, 1.0), (observation + radius).clamp(-1.0, 1.0)


def within(perturbed: Tensor, observation: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`perturbed`, clipped to the bounds, with NaN replaced by the observation."""
    clipped = torch.clamp(perturbed, low, high)
    if finite(clipped):
        return clipped
    return torch.where(clipped.isnan(), observation.clamp(-1.0, 1.0), clipped)


def finite(values: Tensor) -> bool:
    """Whether the sum of the values is neither NaN nor infinite: cheaper than a look at each of them in every call."""
    total = values.sum().item()
    return bool(total - total == 0)


class PerturbationSet:
    """The perturbation set of a step as the run holds it: arrays on immutable bytes, which nobody can write to.

    Args:
        observation: the true observation [B, V, F].
        radius: the largest deviation of each entry.
        low, high: its `bounds`.
    """

    def __init__(self, observation: Tensor, radius: Tensor, low: Tensor, high: Tensor) -> None:
        self._truth, self.radius, self._low, self._high = map(_fixed, (observation, radius, low, high))

    def project(self, answer: Tensor) -> tuple[Tensor, Tensor]:
        """The answer [B, V, F] projected onto the set, and its L-inf distance [B] to the set before.

        The distance of an answer with NaN or infinity is not finite.
        """
        given = answer.detach().cpu().numpy()
        inside = np.clip(given, self._low, self._high)
        inside = np.where(np.isnan(inside), np.clip(self._truth, -1.0, 1.0), inside)
        excess = np.abs(given - inside).reshape(len(given), -1).max(1, initial=0.0)
        return torch.from_numpy(inside).to(answer), torch.from_numpy(excess)


def _fixed(values: Tensor) -> NDArray[Any]:
    """A copy that cannot be written to: an array on immutable bytes."""
    found = values.detach().cpu().contiguous().numpy()
    return np.frombuffer(found.tobytes(), found.dtype).reshape(found.shape)
