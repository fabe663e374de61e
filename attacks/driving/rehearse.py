"""A planning attack in closed loop: it rehearses what the victim does under each of a few lies, and tells the worst one."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, NotNegative, Positive
from cavbench.driving import DrivingAttack, Oracle, State

SIGNS = torch.tensor(list(product((1.0, -1.0), repeat=3)))
"""[8, 3] the lies, of the cars in the ego's lane, on its left and on its right: 1 is nearer and closing, -1 the opposite."""
HALF_LANE = 2.0
"""A car is in the ego's lane if its place across the road differs by less than this, in m."""
SOON_S = 1.0
"""It counts where the ego will be after this time in s."""
KEEPING = 0.05
"""A lie is kept unless another one takes more than this, in decisions of full progress."""
NEEDED = ("x", "y", "vx", "vy")


@dataclass(frozen=True, kw_only=True)
class Rehearse(DrivingAttack):
    """Simulates the next seconds with a copy of the victim under each of eight lies, and shows it the worst one for a while.

    White box with access `dynamics`. It computes a belief about the traffic from the true observations (as `plan` does), starts
    a simulation of the world from it, and lets a copy of the victim drive there, with its state and whatever defends it
    (`Oracle.rehearse`). A lie shifts every other car by the whole budget: those in the ego's lane, on its left and on its right
    are each shown nearer, closing and drifting towards the ego, or the opposite; the ego itself is shown farther to the right.
    So it finds what no single step shows: a lane change that will be regretted, or a place behind a slow car that is never
    left. It needs no gradients, and no decision has to change at once. This is model-predictive control by enumeration (Garcia,
    Prett and Morari 1989), with the victim in the loop. Distance: the perturbation set of the threat model.

    Args:
        horizon: length of a rehearsal in seconds, above 0 (default 4).
        renew: frames for which a lie is kept, at least 1 (default 10).
        crash: what a failure is worth to the attack, in decisions of full progress (default 250).

    Shapes: observation [B, V, F] in, the same out. Queries: 8 for each simulated decision, in every `renew`-th step (480 by
    default). With a smaller query budget it looks less far ahead.

    Raises:
        UserError: if the world cannot be simulated step by step.
        ValueError: if it does not measure `x`, `y`, `vx` and `vy`.
    """

    access: ClassVar[Access] = "dynamics"
    needs: ClassVar[tuple[str, ...]] = NEEDED
    joint: ClassVar[bool] = True

    horizon: Positive = 4.0
    renew: Count = 10
    crash: NotNegative = 250.0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        if missing := set(NEEDED) - set(oracle.features.names):
            raise ValueError(
                f"the attack needs the features {', '.join(NEEDED)}, the world lacks {', '.join(sorted(missing))}"
            )
        state = oracle.dynamics.unknown()
        state["age"] = torch.zeros(len(state), dtype=torch.int64)
        state["lie"] = torch.zeros(len(state), dtype=torch.int64)
        return state

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert state is not None
        if not len(observation):
            return observation, state
        belief = oracle.dynamics.believe(observation, state)
        belief["age"], belief["lie"] = state["age"] + 1, state["lie"]
        # All episodes of a step have the same age.
        if int(state["age"][0]) % self.renew == 0:
            belief["lie"] = self._worst(belief, oracle)
        return shown(observation, SIGNS[belief["lie"]], oracle), belief

    def _worst(self, belief: TensorDict, oracle: Oracle) -> Tensor:
        """The number of the worst lie [B], int64; the present one if no other is worse by more than `KEEPING`."""
        lies = len(SIGNS)
        # A rehearsal has its own draws of a random victim.
        affordable = int(oracle.remaining.min()) * oracle.draws // lies
        decisions = min(max(1, round(self.horizon / oracle.dynamics.period)), affordable)
        world, victim = oracle.dynamics.rehearsal(belief, lies), oracle.imagined(lies)
        signs = SIGNS[:, None].expand(-1, len(belief), -1)
        worth = torch.zeros(signs.shape[:2])
        for _ in range(decisions):
            told = shown(world.observation.to(oracle.observation), signs, oracle)
            action, victim = oracle.rehearse(told, victim)
            world.step(action)
            worth += world.progress
        worth -= self.crash * world.failed
        worth.scatter_add_(0, belief["lie"][None], torch.full((1, len(belief)), -KEEPING))
        return worth.argmin(0)


def shown(observation: Tensor, signs: Tensor, oracle: Oracle) -> Tensor:
    """The observation [..., V, F] under a lie `signs` [..., 3], in the perturbation set of the observation."""
    features = oracle.features
    x, y, vx, vy = (1 + features.names.index(name) for name in NEEDED)
    place = features.physical(observation)
    # During a lane change the lanes count from the one that the ego steers to.
    ahead, side = place[..., 1:, x - 1], place[..., 1:, y - 1] - SOON_S * place[..., :1, vy - 1]
    role = torch.where(side.abs() < HALF_LANE, 0, torch.where(side < 0, 1, 2))
    sign = signs.gather(-1, role)
    shift = torch.zeros_like(observation)
    # A car level with the ego counts as ahead.
    shift[..., 1:, x] = shift[..., 1:, vx] = torch.where(ahead < 0, sign, -sign)
    shift[..., 1:, y] = shift[..., 1:, vy] = -sign * side.sign()
    shift[..., 0, y] = 1.0
    # Each value is at an end of the set, or as it is: only the sensor's range limits it further.
    return (observation + shift * oracle.threat.radius(observation, features)).clamp(-1, 1)
