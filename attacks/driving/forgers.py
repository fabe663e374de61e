"""Adversaries on the other sets of the threat model: which car to hide or invent, how late to be, what to steer, and when.

Each rehearses the next seconds with a copy of the victim under a few forgeries, as `rehearse` does under lies about values, and
answers the worst one for a while. Where a set allows a share of the frames only, it waits until a forgery is worth it.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, NotNegative, Positive
from cavbench.driving import DrivingAttack, Features, Forgery, Oracle, State, composed

NEEDED = ("x", "y", "vx", "vy")
LANE = 4.0
"""Width of a lane in m."""
KEEPING = 0.05
"""A forgery is kept unless another one takes more than this, in decisions of full progress."""
PLACES = ((1.0, 0.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 0.0), (-1.0, -1.0), (-1.0, 1.0))
"""Where cars are hidden or invented: ahead (1) or behind (-1); in the lane to the left (-1), the same (0) or to the right (1)."""
GAP = 15.0
"""Distance of an invented car to the ego along the road, in m."""


class Chooser(DrivingAttack):
    """Chooses one of a few numbered lies by a rehearsal, and keeps it for a while."""

    access: ClassVar[Access] = "dynamics"
    joint: ClassVar[bool] = True

    @abstractmethod
    def worst(self, belief: TensorDict, oracle: Oracle) -> Tensor:
        """The number of the worst lie [B], int64."""

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        state = oracle.dynamics.unknown()
        state["time"], state["which"] = torch.zeros(2, len(state), dtype=torch.int64)
        return state

    def believed(self, observation: Tensor, oracle: Oracle, state: TensorDict, renew: int) -> TensorDict:
        """What is believed of the cars, with the number `which` of the lie, chosen anew every `renew` decisions."""
        belief = oracle.dynamics.believe(observation, state)
        belief["time"], belief["which"] = state["time"] + 1, state["which"]
        # All episodes of a step have the same age.
        if int(state["time"][0]) % renew == 0:
            belief["which"] = self.worst(belief, oracle)
        return belief


@dataclass(frozen=True, kw_only=True)
class Forger(Chooser):
    """The search that they share; a forgery has a number, and number 0 is none.

    Args:
        horizon: length of a rehearsal in seconds, above 0 (default 3).
        renew: frames for which a forgery is kept, at least 1 (default 10).
        crash: what a failure is worth to the attack, in decisions of full progress (default 250).
        worth: what a forgery must take to be used where frames are limited, in decisions of full progress (default 5).
    """

    needs: ClassVar[tuple[str, ...]] = NEEDED
    moves: ClassVar[bool] = False
    """Whether a change to another forgery takes a frame without one."""

    horizon: Positive = 3.0
    renew: Count = 10
    crash: NotNegative = 250.0
    worth: NotNegative = 5.0

    @abstractmethod
    def options(self, oracle: Oracle) -> int:
        """Number of forgeries, with none."""

    @abstractmethod
    def forged(
        self, observation: Tensor, past: list[Tensor], which: Tensor, oracle: Oracle
    ) -> tuple[Tensor, Forgery | None]:
        """What a victim is shown of observations [..., B, V, F] under forgeries `which` [..., B]; the answer in a frame.

        Args:
            observation: the truth, simulated or real.
            past: earlier truths of the same shape, newest first.
            which: numbers of forgeries.
            oracle: of this step.
        """

    def executed(self, action: Tensor, which: Tensor, oracle: Oracle) -> Tensor:
        """What a car executes in a rehearsal, of the victim's actions [K, B] or [K, B, 2]."""
        return action

    def limited(self, oracle: Oracle) -> Tensor | None:
        """int64 [B] frames that are left; None if every frame may be forged."""
        return None

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        assert state is not None
        if not len(observation) or self.options(oracle) < 2:
            return observation, state
        belief = self.believed(observation, oracle, state, self.renew)
        left = self.limited(oracle)
        which = belief["which"] if left is None else torch.where(left > 0, belief["which"], 0)
        if self.moves:
            # A car that jumped would be brought back; one that has gone may appear elsewhere.
            which = torch.where((state["which"] > 0) & (belief["which"] != state["which"]), 0, which)
        past = [oracle.past(age) for age in range(1, 1 + oracle.threat.latency.frames)]
        _, forgery = self.forged(observation, past, which, oracle)
        return observation if forgery is None else forgery, belief

    def worst(self, belief: TensorDict, oracle: Oracle) -> Tensor:
        """The number of the worst forgery [B]; the present one if no other is worse by more than `KEEPING`."""
        copies = self.options(oracle)
        # A rehearsal has its own draws of a random victim.
        affordable = int(oracle.remaining.min()) * oracle.draws // copies
        if not affordable:
            return torch.zeros_like(belief["which"])
        decisions = min(max(1, round(self.horizon / oracle.dynamics.period)), affordable)
        world, victim = oracle.dynamics.rehearsal(belief, copies), oracle.imagined(copies)
        which = torch.arange(copies)[:, None].expand(-1, len(belief))
        worth = torch.zeros(which.shape)
        truths = [oracle.past(age).expand(copies, -1, -1, -1) for age in range(1, 1 + oracle.threat.latency.frames)]
        for _ in range(decisions):
            truth = world.observation.to(oracle.observation)
            action, victim = oracle.rehearse(self.forged(truth, truths, which, oracle)[0], victim)
            truths = [truth.clone(), *truths][: oracle.threat.latency.frames]
            world.step(self.executed(action, which, oracle))
            worth += world.progress
        worth -= self.crash * world.failed
        if self.limited(oracle) is None:
            worth.scatter_add_(0, belief["which"][None], torch.full((1, len(belief)), -KEEPING))
        else:
            worth[0] -= self.worth
        return worth.argmin(0)


@dataclass(frozen=True, kw_only=True)
class Hide(Forger):
    """Hides the cars nearest to the ego in one of six places: ahead or behind, in its lane or in one beside it.

    Distance: `threat.presence.hidden` cars at once, in `threat.presence.share` of the frames.

    Shapes: observation [B, V, F] in, a `Forgery` out. Queries: 7 for each simulated decision, in every `renew`-th step.
    """

    @property
    def forges(self) -> tuple[str, ...]:
        return ("presence.hidden=1",)

    def options(self, oracle: Oracle) -> int:
        return 1 + len(PLACES) if oracle.threat.presence.hidden else 1

    def limited(self, oracle: Oracle) -> Tensor | None:
        return oracle.left("presence") if oracle.threat.presence.share < 1 else None

    def forged(
        self, observation: Tensor, past: list[Tensor], which: Tensor, oracle: Oracle
    ) -> tuple[Tensor, Forgery | None]:
        hidden = nearest(observation, which, oracle.features, oracle.threat.presence.hidden)
        return composed(observation, oracle.features, hidden), Forgery(hidden=hidden)


@dataclass(frozen=True, kw_only=True)
class Ghost(Forger):
    """Invents cars beside the ego, as fast as it, on lanes: ahead, behind, or on both sides.

    Distance: `threat.presence.invented` cars at once, in `threat.presence.share` of the frames.

    Shapes: observation [B, V, F] in, a `Forgery` out. Queries: 7 for each simulated decision, in every `renew`-th step.
    """

    moves: ClassVar[bool] = True

    @property
    def forges(self) -> tuple[str, ...]:
        return ("presence.invented=1",)

    def options(self, oracle: Oracle) -> int:
        return 1 + len(PLACES) if oracle.threat.presence.invented else 1

    def limited(self, oracle: Oracle) -> Tensor | None:
        return oracle.left("presence") if oracle.threat.presence.share < 1 else None

    def forged(
        self, observation: Tensor, past: list[Tensor], which: Tensor, oracle: Oracle
    ) -> tuple[Tensor, Forgery | None]:
        cars = invented(observation, which, oracle.features, oracle.threat.presence.invented)
        return composed(observation, oracle.features, invented=cars), Forgery(invented=cars)


@dataclass(frozen=True, kw_only=True)
class Late(Forger):
    """Shows an old frame: the newest, the oldest that `threat.latency` allows, or one half as old.

    Shapes: observation [B, V, F] in, a `Forgery` out. Queries: 3 for each simulated decision, in every `renew`-th step.
    """

    @property
    def forges(self) -> tuple[str, ...]:
        return ("latency.frames=2",)

    def options(self, oracle: Oracle) -> int:
        return len(self._ages(oracle))

    def _ages(self, oracle: Oracle) -> list[int]:
        most = oracle.threat.latency.frames
        return sorted({0, (most + 1) // 2, most})

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        state = super().initial(observation, oracle)
        assert state is not None
        state["age"] = torch.zeros(len(state), dtype=torch.int64)
        return state

    def forged(
        self, observation: Tensor, past: list[Tensor], which: Tensor, oracle: Oracle
    ) -> tuple[Tensor, Forgery | None]:
        wanted = torch.tensor(self._ages(oracle))[which]
        frames = torch.stack([observation, *past])
        chosen = frames.gather(0, wanted[None, ..., None, None].expand(1, *observation.shape))[0]
        return chosen, Forgery(age=wanted)

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        answer, after = super().step(observation, oracle, state)
        assert state is not None
        assert after is not None
        if isinstance(answer, Forgery) and answer.age is not None:
            # A frame grows old by one decision a step.
            after["age"] = torch.minimum(answer.age, state["age"] + 1)
            after["age"] = torch.where(state["time"] == 0, 0, after["age"])
            answer = Forgery(age=after["age"].clone())
        return answer, after


@dataclass(frozen=True, kw_only=True)
class Steer(Forger):
    """Proposes one of the discrete actions, or full throttle, full brake, or full lock, in place of the victim's command.

    Distance: executed with the probability `threat.actuator.replaced` (PR-MDP), or mixed in with `threat.actuator.noise`
    (NR-MDP). A rehearsal executes the expected command: of discrete ones every 1 / `replaced`-th is the attacker's.

    Shapes: observation [B, V, F] in, a `Forgery` out. Queries: 6 for each simulated decision, in every `renew`-th step.
    """

    @property
    def forges(self) -> tuple[str, ...]:
        return "actuator.replaced=0.1", "actuator.noise=0.1"

    def options(self, oracle: Oracle) -> int:
        allowed = oracle.threat.actuator.replaced or oracle.threat.actuator.noise
        return 1 + (oracle.dynamics.actions or len(CORNERS)) if allowed else 1

    def forged(
        self, observation: Tensor, past: list[Tensor], which: Tensor, oracle: Oracle
    ) -> tuple[Tensor, Forgery | None]:
        return observation, Forgery(action=self._proposed(which, oracle))

    def executed(self, action: Tensor, which: Tensor, oracle: Oracle) -> Tensor:
        theirs, actuator = self._proposed(which, oracle), oracle.threat.actuator
        if action.is_floating_point():
            theirs = torch.where(theirs.isnan(), action, theirs)
            return action + max(actuator.replaced, actuator.noise) * (theirs - action)
        tossed = torch.cat(
            [
                torch.rand(len(action), part.rows.stop - part.rows.start, generator=part.generator)
                for part in oracle.parts
            ],
            1,
        )
        return torch.where((tossed < actuator.replaced) & (theirs >= 0), theirs, action)

    def _proposed(self, which: Tensor, oracle: Oracle) -> Tensor:
        if oracle.action_type == "discrete":
            return which - 1
        return torch.cat((torch.full((1, 2), torch.nan), torch.tensor(CORNERS)))[which]


CORNERS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
"""[acceleration, steering] that `steer` proposes."""


def nearest(observation: Tensor, which: Tensor, features: Features, most: int) -> Tensor:
    """bool [..., V] the `most` nearest cars in the place `which` [...] - 1 of `PLACES`; none of them for 0."""
    x, y = (features.names.index(name) for name in ("x", "y"))
    place = features.physical(observation)
    ahead, lane = torch.tensor(((0.0, 9.0), *PLACES))[which].unbind(-1)
    there = (observation[..., 0] > 0) & (place[..., y] / LANE - lane[..., None]).abs().lt(0.5)
    there &= torch.where(place[..., x] < 0, -1.0, 1.0) == ahead[..., None]
    there[..., 0] = False
    # Rows are nearest first.
    return there & (there.cumsum(-1) <= most)


def invented(observation: Tensor, which: Tensor, features: Features, most: int) -> Tensor:
    """[..., K, F] cars in the place `which` [...] - 1 of `PLACES` and in those after it, on the lanes of the road.

    They are as fast as the ego along the road, and do not move across it.
    """
    x, y, vx, vy = (features.names.index(name) for name in NEEDED)
    ego = features.physical(observation[..., 0, :])
    cars = observation.new_zeros(*which.shape, most, observation.shape[-1])
    table = torch.tensor(PLACES)
    for car in range(most):
        ahead, lane = table[(which - 1 + car) % len(PLACES)].unbind(-1)
        centre = (ego[..., y] / LANE).round() * LANE + lane * LANE
        physical = torch.zeros(*which.shape, len(features.names))
        physical[..., x], physical[..., y] = ahead * GAP, centre - ego[..., y]
        physical[..., vx], physical[..., vy] = 0.0, -ego[..., vy]
        cars[..., car, 1:] = features.normalised(physical).clamp(-1.0, 1.0)
        cars[..., car, 0] = (which > 0).to(cars)
    return cars.masked_fill((cars[..., :1] <= 0), 0.0)
