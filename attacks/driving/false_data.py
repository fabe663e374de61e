"""False data in messages, by rule: the attacker tells one story for the whole episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.core.ranges import Positive
from cavbench.driving import DrivingAttack, Forgery

if TYPE_CHECKING:
    from cavbench.driving import Oracle, State

Mode = Literal["offset", "ramp", "random", "replay", "frozen", "drop"]
Aim = Literal["closer", "away"]
NEEDED = ("x", "vx", "ax")
VALUES = ("messages.position=20", "messages.speed=5", "messages.acceleration=3")
OLD = ("messages.delay=10",)


@dataclass(frozen=True, kw_only=True)
class FalseData(DrivingAttack):
    """Forges the messages of the nearest cars ahead by one rule, within the set `messages`, and asks the victim nothing.

    The rules are those of VeReMi (van der Heijden et al. 2018), as far as they fit a platoon.

    | mode | what is told |
    |---|---|
    | `offset` | position, speed and acceleration, off by as much as is allowed |
    | `ramp` | the same, growing evenly for `ramp_s` |
    | `random` | the same, off by anything up to that, drawn anew in each frame |
    | `replay` | what was true `threat.messages.delay` decisions ago |
    | `frozen` | one message for up to `threat.messages.delay` decisions, then the next one |
    | `drop` | nothing, as long as `threat.messages.dropped` lasts |

    Args:
        mode: the rule.
        aim: `closer`: the cars ahead seem to be farther, faster and to speed up, so that the victim comes too close. `away`: the
            opposite, so that it falls back, or brakes for nothing.
        ramp_s: seconds until a ramp has its height.

    Shapes: observation [B, V, F] in, a `Forgery` out. It asks nothing.
    """

    access: ClassVar[Access] = "oblivious"
    made_for: ClassVar[str] = "platoon"
    joint: ClassVar[bool] = True
    needs: ClassVar[tuple[str, ...]] = NEEDED

    mode: Mode = "offset"
    aim: Aim = "closer"
    ramp_s: Positive = 10.0

    @property
    def forges(self) -> tuple[str, ...]:
        return {"replay": OLD, "frozen": OLD, "drop": ("messages.dropped=0.5",)}.get(self.mode, VALUES)

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        return TensorDict({"step": torch.zeros(len(observation), dtype=torch.int64)}, batch_size=[len(observation)])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor | Forgery, State]:
        assert state is not None
        after = state.clone()
        after["step"] = after["step"] + 1
        threat, senders = oracle.threat.messages, nearest(observation, oracle)
        if not threat.senders or not len(observation):
            return observation, after
        if self.mode == "drop":
            held = senders & (oracle.left("messages") > 0)[:, None]
            return Forgery(dropped=held), after
        if self.mode in ("replay", "frozen"):
            age = torch.full_like(state["step"], threat.delay)
            if self.mode == "frozen":
                age = state["step"] % (threat.delay + 1)
            return Forgery(content=age[:, None] * senders), after
        share = torch.ones(len(observation))
        if self.mode == "ramp":
            share = (state["step"] * oracle.period / self.ramp_s).clamp(max=1.0)
        lie = offsets(observation, oracle) * share[:, None, None]
        if self.mode == "random":
            drawn = [torch.rand(observation[part.rows].shape, generator=part.generator) for part in oracle.parts]
            lie = lie * (2 * torch.cat(drawn) - 1)
        elif self.aim == "away":
            lie = -lie
        return Forgery(messages=observation + lie * senders[..., None]), after


def nearest(observation: Tensor, oracle: Oracle) -> Tensor:
    """bool [..., V] the rows of the nearest senders, as many as the threat model allows; they stay the same in an episode."""
    rows = torch.arange(observation.shape[-2])
    first = oracle.features.messages
    return ((rows >= first) & (rows < first + oracle.threat.messages.senders)).expand(observation.shape[:-1])


def offsets(observation: Tensor, oracle: Oracle) -> Tensor:
    """[V, F] how far messages may be off, on the normalised scale."""
    features, threat = oracle.features, oracle.threat.messages
    half, lie = features.half_range(), torch.zeros(observation.shape[-2:])
    for name, most in zip(NEEDED, (threat.position, threat.speed, threat.acceleration), strict=True):
        column = features.names.index(name)
        lie[:, 1 + column] = most / half[column]
    return lie
