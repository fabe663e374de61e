"""When to attack: only where the victim clearly prefers one action (Lin et al. 2017)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from cavbench.driving import DrivingVictim, Oracle


def timed(
    attacked: Callable[[Tensor, Tensor, Oracle], Tensor],
    observation: Tensor,
    clean: Tensor,
    oracle: Oracle,
    *,
    gap: float,
    temperature: float,
) -> Tensor:
    """Attack the episodes whose preference gap is at least `gap` and show the truth in the others: [B, V, F].

    Args:
        attacked: the attack: (observation, clean, oracle) of some episodes -> what is shown in them.
        observation: the true observation [B, V, F].
        clean: the victim's Q-values on it [B, A].
        oracle: access to the victim.
        gap: least preference gap, in [0, 1]; 0 attacks every episode, whatever the kind of its actions.
        temperature: temperature of the gap.
    """
    if gap == 0:
        return attacked(observation, clean, oracle)
    rows = (preference_gap(clean, temperature) >= gap).nonzero().squeeze(-1)
    shown = observation.clone()
    if len(rows):
        shown[rows] = attacked(observation[rows], clean[rows], oracle.select(rows))
    return shown


def gap_misfit(gap: float, victim: DrivingVictim) -> str:
    """Why no gap can be computed for a victim, as `DrivingAttack.misfit`; empty if it can, or is not needed."""
    if gap > 0 and victim.action_type != "discrete":
        return f"whose actions are {victim.action_type}: a preference gap needs discrete ones"
    return ""


def preference_gap(scores: Tensor, temperature: float) -> Tensor:
    """[B] how much the victim prefers its best action: the largest minus the smallest entry of softmax(Q / T).

    Lin et al. 2017, "Tactics of Adversarial Attack on Deep Reinforcement Learning Agents", Eq. 3.
    """
    preferred = torch.softmax(scores / temperature, -1)
    return preferred.amax(-1) - preferred.amin(-1)
