"""What an attacker minimises: small functions of the victim's scores, shared by the black-box and the white-box attacks.

Scores are Q-values [..., B, A] of a discrete victim or the action [..., B, 2] of a continuous one; `clean` [B, A] or [B, 2] are
its scores on the true observation. A loss is [..., B]: lower is better for the attacker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from bench.contracts import ActionType

Objective = Literal["expected", "margin", "target"]

TIE_BREAK = 1e-3
"""Weight of the soft loss beside the greedy action's clean Q when points are compared."""


def expected(scores: Tensor, clean: Tensor, temperature: float) -> Tensor:
    """The clean Q expected under the attacked policy: softmax(Q(x') / tau) . Q(x).

    Least where the victim is driven to what it itself thinks the worst action; needs nothing but scores.

    Args:
        scores: Q(x') [..., B, A].
        clean: Q(x) [B, A].
        temperature: tau as a share of the spread (standard deviation over the actions) of Q(x), so it is scale-free.
    """
    tau = temperature * clean.std(-1, keepdim=True).clamp(min=torch.finfo(clean.dtype).tiny / temperature)
    return (torch.softmax(scores / tau, -1) * clean).sum(-1)


def margin(scores: Tensor, action: Tensor) -> Tensor:
    """How far `action` [B] is ahead of the best other action (Carlini and Wagner 2017); negative once it is no longer taken."""
    index = action.expand(scores.shape[:-1]).unsqueeze(-1)
    others = scores.scatter(-1, index, -torch.inf).amax(-1)
    return scores.gather(-1, index).squeeze(-1) - others


def distance(action: Tensor, reference: Tensor) -> Tensor:
    """Euclidean distance of continuous actions [..., B, 2] from `reference` [B, 2] or [2], with a gradient at 0."""
    return ((action - reference).square().sum(-1) + 1e-12).sqrt()


def distortion(perturbed: Tensor, observation: Tensor) -> Tensor:
    """Eq. 4.9 of the thesis: the L2 norm of the squared perturbation, [..., B]."""
    return (perturbed - observation).square().flatten(-2).norm(dim=-1)


@dataclass(frozen=True, kw_only=True)
class Loss:
    """An objective bound to the step it is used on: what to minimise, and when it is met.

    Args:
        objective: `expected`, `margin` (away from the clean action) or `target` (towards one action).
        action_type: of the victim.
        clean: its scores on the true observations, Q(x) [B, A] or mu(x) [B, 2].
        temperature: of `expected`, see there.
        target: the target action: an index, or [acceleration, steering].
        tolerance: a continuous action within this distance of the target has reached it.
        enough: `expected` is met once the greedy action gives up this share of what the clean Q-values leave to lose.
    """

    objective: Objective
    action_type: ActionType
    clean: Tensor
    temperature: float
    target: int | tuple[float, float]
    tolerance: float = 0.1
    enough: float = 1.0

    def __call__(self, scores: Tensor) -> Tensor:
        """The loss [..., B] of `scores` [..., B, A] or [..., B, 2]; `expected` is for Q-values only."""
        if self.action_type == "continuous":
            if self.objective == "target":
                return distance(scores, torch.tensor(self.target).to(scores))
            return -distance(scores, self.clean)
        if self.objective == "expected":
            return expected(scores, self.clean, self.temperature)
        if self.objective == "margin":
            return margin(scores, self.clean.argmax(-1))
        return -margin(scores, torch.full(scores.shape[-2:-1], int(self.target)))  # type: ignore[arg-type]

    def key(self, scores: Tensor) -> Tensor:
        """What the best of several asked points is chosen by, [..., B], lower is better.

        The victim takes its greedy action, so for `expected` the clean Q of that action comes first, and the loss decides
        between points with the same one. Elsewhere it is the loss.
        """
        if self.action_type == "continuous" or self.objective != "expected":
            return self(scores)
        return self._given(scores) + TIE_BREAK * self(scores)

    def met(self, scores: Tensor) -> Tensor:
        """Whether the victim already does what the attacker wants, bool [..., B]."""
        if self.action_type == "continuous":
            if self.objective == "target":
                return self(scores) <= self.tolerance
            return torch.zeros(scores.shape[:-1], dtype=torch.bool)
        if self.objective != "expected":
            return self(scores) < 0
        best, worst = self.clean.amax(-1), self.clean.amin(-1)
        return best - self._given(scores) >= self.enough * (best - worst)

    def _given(self, scores: Tensor) -> Tensor:
        """Clean Q of the greedy action, [..., B]."""
        return self.clean.expand(scores.shape).gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)

    def of(self, rows: Tensor) -> Loss:
        """The same for some of the episodes."""
        return replace(self, clean=self.clean[rows])
