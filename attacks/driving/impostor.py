"""False messages by search: the attacker rehearses what the victim does under each of a few lies, and tells the worst one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.attacks.driving.false_data import NEEDED, VALUES, Aim, nearest, offsets
from cavbench.attacks.driving.forgers import Chooser
from cavbench.core.ranges import Count, Positive
from cavbench.driving import Forgery, Oracle, State

LIES = torch.tensor(
    [
        [0.0, 0.0, 0.0],
        [1.0, 1.0, 1.0],
        [-1.0, -1.0, -1.0],
        [1.0, 1.0, -1.0],
        [-1.0, -1.0, 1.0],
        [0.0, 0.0, 1.0],
        [0.0, 0.0, -1.0],
    ]
)
"""[K, 3] shares of what position, speed and acceleration may be off by. The first lie is the truth."""
CRASH = 1e3
KEEPING = 1e-3
"""A lie is kept unless another one is better by more than this."""


@dataclass(frozen=True, kw_only=True)
class Impostor(Chooser):
    """Simulates the next seconds with a copy of the victim under seven lies of the nearest senders, and tells the worst one.

    White box with access `dynamics`. The cars ahead are simulated from their true messages, with their present command for a
    second. So it knows when they brake, and tells the victim the opposite. This is model-predictive control by enumeration
    (Garcia, Prett and Morari 1989), with the victim and its defence in the loop.

    Args:
        aim: `closer`: the smallest time gap, a crash before all. `away`: the least progress.
        horizon: length of a rehearsal in s (default 4).
        renew: decisions for which a lie is kept, at least 1 (default 5).

    Shapes: observation [B, V, F] in, a `Forgery` out. Queries: 7 for each simulated decision, in every `renew`-th step (280 by
    default). With a smaller query budget it looks less far ahead.
    """

    made_for: ClassVar[str] = "platoon"
    needs: ClassVar[tuple[str, ...]] = NEEDED
    forges: ClassVar[tuple[str, ...]] = VALUES

    aim: Aim = "closer"
    horizon: Positive = 4.0
    renew: Count = 5

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        assert state is not None
        if not len(observation) or not oracle.threat.messages.senders:
            return observation, state
        belief = self.believed(observation, oracle, state, self.renew)
        return Forgery(messages=_told(observation, belief["which"], oracle)), belief

    def worst(self, belief: TensorDict, oracle: Oracle) -> Tensor:
        """The number of the worst lie [B], int64."""
        copies = len(LIES)
        affordable = int(oracle.remaining.min()) * oracle.draws // copies
        decisions = min(max(1, round(self.horizon / oracle.dynamics.period)), affordable)
        world, victim = oracle.dynamics.rehearsal(belief, copies), oracle.imagined(copies)
        which = torch.arange(copies)[:, None].expand(-1, len(belief))
        progress, nearest_s = torch.zeros(which.shape), torch.full(which.shape, torch.inf)
        for _ in range(decisions):
            action, victim = oracle.rehearse(_told(world.observation, which, oracle), victim)
            world.step(action)
            progress += world.progress
            nearest_s = torch.minimum(nearest_s, _time_gap(world.observation, oracle))
        worth = (progress if self.aim == "away" else nearest_s) - CRASH * world.failed
        worth.scatter_add_(0, belief["which"][None], torch.full((1, len(belief)), -KEEPING))
        return worth.argmin(0)


def _told(observation: Tensor, which: Tensor, oracle: Oracle) -> Tensor:
    """The observation [..., B, V, F] with the lies `which` [..., B] of the nearest senders."""
    columns = [1 + oracle.features.names.index(name) for name in NEEDED]
    share = torch.zeros(*which.shape, 1, observation.shape[-1])
    share[..., columns] = LIES[which].unsqueeze(-2)
    senders = nearest(observation, oracle) & (observation[..., 0] > 0)
    return (observation + share * offsets(observation, oracle) * senders[..., None]).clamp(-1.0, 1.0)


def _time_gap(observation: Tensor, oracle: Oracle) -> Tensor:
    """[..., B] distance of the nearest car over the own speed in s, as the radar measures it, or else its message."""
    features = oracle.features
    values = features.physical(observation)
    x, speed = values[..., features.names.index("x")], values[..., 0, features.names.index("vx")]
    rows = torch.where(observation[..., 1:, 0] > 0, x[..., 1:], torch.inf)
    return rows.amin(-1) / speed.clamp(min=1.0)
