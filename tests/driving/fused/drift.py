"""How far rounding carries two trainings of SAC apart: torch's from a compiled one, and from torch's begun 1e-7 away.

    python -m tests.driving.fused.drift

Each line is one draw of batches: how far weights have moved after 40 updates, and the largest differences of a weight.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from rich.console import Console

from cavbench.driving.victims.learner import CHUNK
from cavbench.driving.victims.practice import Practice
from cavbench.driving.victims.sac import SAC
from tests.driving.fused.both import both, learner, only
from tests.driving.fused.test_soft import weights_of

DRAWS, UPDATES, APART = 8, 40, 1e-7
RECIPE = SAC(decisions=400, copies=1, hidden=32, batch=64, memory=5000, tau=0.1, behind="shield", critics=2)


def drift(draw: int) -> tuple[float, float, float]:
    """For one draw of batches: what the weights moved by, and how far a compiled and a shifted training are from torch's."""
    compiled, torchs, env, entered = both(RECIPE, 1)
    shifted, _, _ = learner(RECIPE, 1, compiled=False)
    begun = copy.deepcopy(torchs.policy.state_dict())
    torch.manual_seed(draw)
    with torch.no_grad():
        for weight in shifted.policy.parameters():
            weight.mul_(1 + APART * torch.randn_like(weight))
    practice = Practice(env, torchs, entered, crash_penalty=40.0)
    only(practice, torch.tensor([False, True, True, True, True]))
    practice.drive(60, 0.0)
    for _ in range(UPDATES // CHUNK):
        for _ in range(CHUNK):
            sample = torchs.buffer.sample()
            sample["truth"] = sample["observation"]
            for each in (compiled, torchs, shifted):
                each.update(sample.clone(), 1e-3)
        for each in (compiled, torchs, shifted):
            each.anneal()
    after = torchs.policy.state_dict()
    moved = max(float((begun[name] - after[name]).abs().max()) for name in begun)
    return moved, *(_apart(torchs, each) for each in (compiled, shifted))


def _apart(one: Any, other: Any) -> float:
    pairs = zip(weights_of(one, 2), weights_of(other, 2), strict=True)
    return max(float((own - its).abs().max()) for own, its in pairs)


if __name__ == "__main__":
    for draw in range(DRAWS):
        Console().print("moved {:.3f}, compiled {:.1e}, begun 1e-7 away {:.1e}".format(*drift(draw)))
