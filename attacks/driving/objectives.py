"""Attack objectives: functions of the victim's scores, shared by the black-box and the white-box attacks.

Scores are the Q-values [..., B, A] of a discrete victim or the action [..., B, 2] of a continuous one; `clean` [B, A] or
[B, 2] are its scores on the true observation. A loss is [..., B]; lower is better for the attacker.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor

from cavbench.driving.features import CONTROLS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cavbench.driving import DrivingWorld

Objective = Literal["collision", "expected", "margin", "target"]

TIE_BREAK = 1e-3
"""Weight of the soft loss, relative to the worth of the greedy action, when points are compared."""


def expected(scores: Tensor, worth: Tensor, tau: Tensor) -> Tensor:
    """The expected worth of the action under the attacked policy: softmax(Q(x') / tau) . Q(x).

    Smallest if the victim takes its own worst action; needs only scores.

    Args:
        scores: Q(x') [..., B, A].
        worth: worth of each action, Q(x) or the result of `spared`, [B, A].
        tau: temperature [B, 1].
    """
    return (torch.softmax(scores / tau, -1) * worth).sum(-1)


def temperature(scores: Tensor, share: float) -> Tensor:
    """[B, 1] the temperature of an expectation: a share of the standard deviation of the values [B, A]."""
    spread = scores.std(-1, keepdim=True)
    return (share * spread).clamp(min=torch.finfo(spread.dtype).tiny)


def taken(scores: Tensor, worth: Tensor) -> Tensor:
    """The worth [..., B] of the greedy action of `scores` [..., B, A], from the worth of each action [B, A]."""
    return worth.expand(scores.shape).gather(-1, scores.argmax(-1, keepdim=True)).squeeze(-1)


def spared(clean: Tensor, braking_action: int) -> Tensor:
    """Q(x) [B, A] with the value of braking raised to that of the best action, so that no attack aims for braking.

    On an open road braking is the victim's worst action, but it causes no collision.
    """
    worth = clean.clone()
    worth[..., braking_action] = clean.amax(-1)
    return worth


def margin(scores: Tensor, action: Tensor) -> Tensor:
    """Lead of `action` [B] over the best other action (Carlini and Wagner 2017); negative if it is not the greedy action."""
    index = action.expand(scores.shape[:-1]).unsqueeze(-1)
    others = scores.scatter(-1, index, -torch.inf).amax(-1)
    return scores.gather(-1, index).squeeze(-1) - others


def distance(action: Tensor, reference: Tensor) -> Tensor:
    """Euclidean distance of continuous actions [..., B, 2] from `reference` [B, 2] or [2], with a gradient at 0."""
    return ((action - reference).square().sum(-1) + 1e-12).sqrt()


def distortion(perturbed: Tensor, observation: Tensor) -> Tensor:
    """Eq. 4.9 of the thesis: the L2 norm of the squared perturbation, [..., B]."""
    return (perturbed - observation).square().flatten(-2).norm(dim=-1)


BRAKE, BRAKING = "SLOWER", 4
"""Name and, on the highway, number of the action that brakes."""


def without_brake(
    objective: str, braking_action: int, world: DrivingWorld, anywhere: Sequence[str] = ("margin",)
) -> str:
    """What an attack misses whose objective spares braking, or aims at an acceleration; empty for nothing.

    Args:
        objective: its objective.
        braking_action: the number of the action that `collision` spares.
        world: the world.
        anywhere: the objectives that need no particular controls of a continuous victim.
    """
    actions, controls = world.actions, world.facts.controls
    if not actions and objective not in anywhere and controls != CONTROLS:
        return (
            f"its objective {objective} needs acceleration and steering, the controls here are {', '.join(controls)}: write "
            "attack.objective=margin"
        )
    if objective != "collision" or not actions or actions[braking_action : braking_action + 1] == (BRAKE,):
        return ""
    if braking_action < len(actions) and braking_action != BRAKING:
        # Its user says that this action brakes.
        return ""
    there = f", or attack.braking_action={actions.index(BRAKE)}" if BRAKE in actions else ""
    return (
        f"its objective collision spares the action that brakes, number {braking_action} on the highway, which here is "
        f"{actions[braking_action] if braking_action < len(actions) else 'none'}: write attack.objective=margin{there}"
    )


@dataclass(frozen=True, kw_only=True)
class DiscreteLoss:
    """The loss and the goal of an attack in one step, for a victim with Q-values.

    Args:
        objective: `collision` or `expected`: expected worth, with or without sparing the braking action; `margin`: away from
            the clean action; `target`: towards one action.
        clean: Q(x) [B, A].
        temperature: temperature of the expectation, as a share of the standard deviation of the worth over the actions.
        target_action: index of the action for `target`.
        braking_action: index of the action that `collision` spares.
        enough: goal of `expected` and `collision`: share in (0, 1] of the range from best to worst action that the greedy
            action must lose.

    Raises:
        ValueError: if the victim has no such action.
    """

    price: ClassVar[int] = 1
    """Queries for one point."""

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
        """The key to choose the best of several queried points, [..., B], lower is better; `loss` is the loss of `scores`.

        For an expectation it is the worth of the greedy action, which the victim takes; the loss breaks ties. For the other
        objectives it is the loss.
        """
        if self.objective in ("margin", "target"):
            return loss
        return self._given(scores) + TIE_BREAK * loss

    def met(self, scores: Tensor) -> Tensor:
        """Whether the goal is met, bool [..., B]."""
        if self.objective in ("margin", "target"):
            return self(scores) < 0
        return self._given(scores) <= self._goal

    def judge(self, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The loss, the key and whether the goal is met, [..., B] each: as one call each, without computing anything twice."""
        value = self(scores)
        if self.objective in ("margin", "target"):
            return value, value, value < 0
        given = self._given(scores)
        return value, given + TIE_BREAK * value, given <= self._goal

    def of(self, rows: Tensor) -> DiscreteLoss:
        """This loss for the episodes `rows`."""
        part = replace(self, clean=self.clean[rows])
        for name in ("_worth", "_tau", "_goal"):
            if name in self.__dict__:
                part.__dict__[name] = self.__dict__[name][rows]
        return part

    @cached_property
    def _worth(self) -> Tensor:
        """Worth of each action, [B, A]."""
        return spared(self.clean, self.braking_action) if self.objective == "collision" else self.clean

    @cached_property
    def _tau(self) -> Tensor:
        """Temperature of the expectation, [B, 1]."""
        return temperature(self._worth, self.temperature)

    @cached_property
    def _goal(self) -> Tensor:
        """Largest worth of the greedy action at which the goal of an expectation is met, [B]."""
        best = self._worth.amax(-1)
        return best - self.enough * (best - self._worth.amin(-1))

    def _given(self, scores: Tensor) -> Tensor:
        """Worth of the greedy action, [..., B]."""
        return taken(scores, self._worth)


@dataclass(frozen=True, kw_only=True)
class ContinuousLoss:
    """The loss for a continuous action: its distance to a target, or its negative distance from the clean action.

    Args:
        clean: mu(x) [B, 2].
        target: [acceleration, steering] to reach; None moves away from the clean action and is never met.
        tolerance: an action within this distance of the target has reached it.
    """

    price: ClassVar[int] = 1
    """Queries for one point."""

    clean: Tensor
    target: tuple[float, float] | None
    tolerance: float = 0.1

    def __call__(self, scores: Tensor) -> Tensor:
        """The loss [..., B] of actions [..., B, 2]."""
        if self.target is None:
            return -distance(scores, self.clean)
        return distance(scores, torch.tensor(self.target).to(scores))

    def key(self, scores: Tensor, loss: Tensor) -> Tensor:
        """The key to choose the best of several queried points: the loss."""
        return loss

    def met(self, scores: Tensor) -> Tensor:
        """Whether the goal is met, bool [..., B]."""
        if self.target is None:
            return torch.zeros(scores.shape[:-1], dtype=torch.bool)
        return self(scores) <= self.tolerance

    def judge(self, scores: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The loss, the key and whether the goal is met, [..., B] each."""
        value = self(scores)
        return value, value, self.met(scores) if self.target is None else value <= self.tolerance

    def of(self, rows: Tensor) -> ContinuousLoss:
        """This loss for the episodes `rows`."""
        return replace(self, clean=self.clean[rows])


Loss = DiscreteLoss | ContinuousLoss
