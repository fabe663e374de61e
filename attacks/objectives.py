"""What an attacker minimises: small functions of the victim's scores, shared by the black-box and the white-box attacks.

Scores are Q-values [..., B, A] of a discrete victim or the action [..., B, 2] of a continuous one; `clean` [B, A] or
[B, 2] are its scores on the true observation. A loss is [..., B]: lower is better for the attacker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

Objective = Literal["collision", "expected", "margin", "target"]

TIE_BREAK = 1e-3
"""Weight of the soft loss beside what the greedy action is worth, when points are compared."""


def expected(scores: Tensor, worth: Tensor, tau: Tensor) -> Tensor:
    """The worth of an action, expected under the attacked policy: softmax(Q(x') / tau) . Q(x).

    Least where the victim is driven to what it itself thinks the worst action; needs nothing but scores.

    Args:
        scores: Q(x') [..., B, A].
        worth: of each action, Q(x) or what `spared` makes of it, [B, A].
        tau: temperature [B, 1].
    """
    return (torch.softmax(scores / tau, -1) * worth).sum(-1)


def spared(clean: Tensor, braking_action: int) -> Tensor:
    """Q(x) [B, A] with braking raised to the best action's: an attacker who wants a collision never wants it.

    On an open road a victim's own worst action is to brake. Driven to it, it crawls, and is safe.
    """
    worth = clean.clone()
    worth[..., braking_action] = clean.amax(-1)
    return worth


def margin(scores: Tensor, action: Tensor) -> Tensor:
    """Lead of `action` [B] over the best other one (Carlini and Wagner 2017); negative once it is no longer taken."""
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
class DiscreteLoss:
    """An objective bound to the step it is used on: what to minimise, and when it is met. For Q-values.

    Args:
        objective: `collision` or `expected`: the worth expected, with braking spared or not; `margin`: away from the clean
            action; `target`: towards one action.
        clean: Q(x) [B, A].
        temperature: of the expectation, as a share of the spread (standard deviation over the actions) of what they are
            worth, so it is scale-free.
        target_action: index of the action that `target` asks for.
        braking_action: index of the action that `collision` spares.
        enough: share in (0, 1] of what there is to lose that the greedy action must give up for an expectation to be met.

    Raises:
        ValueError: if the victim has no such action.
    """

    objective: Objective
    clean: Tensor
    temperature: float
    target_action: int
    braking_action: int
    enough: float = 1.0

    def __post_init__(self) -> None:
        actions = self.clean.shape[-1]
        for objective, name in (("target", "target_action"), ("collision", "braking_action")):
            if self.objective == objective and getattr(self, name) >= actions:
                raise ValueError(f"{name} must be below the victim's {actions} actions, got {getattr(self, name)}")

    def __call__(self, scores: Tensor) -> Tensor:
        """The loss [..., B] of `scores` [..., B, A]."""
        if self.objective == "margin":
            return margin(scores, self.clean.argmax(-1))
        if self.objective == "target":
            return -margin(scores, torch.full(scores.shape[-2:-1], self.target_action))
        return expected(scores, self._worth, self._tau)

    def key(self, scores: Tensor, loss: Tensor) -> Tensor:
        """What the best of several asked points is chosen by, [..., B], lower is better; `loss` is that of `scores`.

        The victim takes its greedy action, so an expectation is compared by what that action is worth, and the loss decides
        between points where it is the same. Elsewhere it is the loss.
        """
        if self.objective in ("margin", "target"):
            return loss
        return self._given(scores) + TIE_BREAK * loss

    def met(self, scores: Tensor) -> Tensor:
        """Whether the victim already does what the attacker wants, bool [..., B]."""
        if self.objective in ("margin", "target"):
            return self(scores) < 0
        return self._given(scores) <= self._goal

    def of(self, rows: Tensor) -> DiscreteLoss:
        """The same for some of the episodes."""
        return replace(self, clean=self.clean[rows])

    @cached_property
    def _worth(self) -> Tensor:
        """Of each action, [B, A]."""
        return spared(self.clean, self.braking_action) if self.objective == "collision" else self.clean

    @cached_property
    def _tau(self) -> Tensor:
        """Of the expectation, [B, 1]."""
        spread = self._worth.std(-1, keepdim=True)
        return (self.temperature * spread).clamp(min=torch.finfo(spread.dtype).tiny)

    @cached_property
    def _goal(self) -> Tensor:
        """What the greedy action may be worth at most for an expectation to be met, [B]."""
        best = self._worth.amax(-1)
        return best - self.enough * (best - self._worth.amin(-1))

    def _given(self, scores: Tensor) -> Tensor:
        """What the greedy action is worth, [..., B]."""
        return self._worth.expand(scores.shape).gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)


@dataclass(frozen=True, kw_only=True)
class ContinuousLoss:
    """The same for a continuous action: its distance to a target, or minus its distance from the clean action.

    Args:
        clean: mu(x) [B, 2].
        target: [acceleration, steering] to come to; None goes away from the clean action, and is never met.
        tolerance: an action within this distance of the target has reached it.
    """

    clean: Tensor
    target: tuple[float, float] | None
    tolerance: float = 0.1

    def __call__(self, scores: Tensor) -> Tensor:
        """The loss [..., B] of actions [..., B, 2]."""
        if self.target is None:
            return -distance(scores, self.clean)
        return distance(scores, torch.tensor(self.target).to(scores))

    def key(self, scores: Tensor, loss: Tensor) -> Tensor:
        """What the best of several asked points is chosen by: the loss."""
        return loss

    def met(self, scores: Tensor) -> Tensor:
        """Whether the victim already does what the attacker wants, bool [..., B]."""
        if self.target is None:
            return torch.zeros(scores.shape[:-1], dtype=torch.bool)
        return self(scores) <= self.tolerance

    def of(self, rows: Tensor) -> ContinuousLoss:
        """The same for some of the episodes."""
        return replace(self, clean=self.clean[rows])


Loss = DiscreteLoss | ContinuousLoss
