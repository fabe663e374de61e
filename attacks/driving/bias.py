"""A biased sensor: one random offset, constant over the episode."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from tensordict import TensorDict
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, Oracle, State


@dataclass(frozen=True, kw_only=True)
class Bias(DrivingAttack):
    """Shifts every measured value by the same share of its radius, with the same sign, for a whole episode.

    This models a badly calibrated or spoofed sensor. The offset is constant over time, so smoothing does not remove it. It makes
    no queries. Signs are drawn for each feature of each row. Distance: the perturbation set of the threat model.

    Args:
        scale: size of the offset as a share of the radius.

    Shapes: observation [B, V, F] in, the same out; its state is the signs [B, V, F].
    """

    access: ClassVar[Access] = "oblivious"

    scale: Annotated[float, Interval(gt=0, le=1)] = 1.0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        signs = torch.randint(0, 2, observation.shape, generator=oracle.generator) * 2.0 - 1.0
        return TensorDict({"signs": signs.to(observation)}, batch_size=observation.shape[:1])

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert state is not None
        return oracle.project(observation + self.scale * state["signs"] * oracle.radius), state
