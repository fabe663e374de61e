"""An attack's only access to the driving policy: a face of the run's enforcer (`cavbench.driving.enforcer`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import ActionType, Features
from cavbench.driving.policy import State
from cavbench.driving.threat import ObservationThreat, within

Loss = Callable[[Tensor], Tensor]

DRAWS = 8
"""How often a random victim is asked about each point."""


class Part(NamedTuple):
    """The episodes of one unit among those of a step, and the random generator of its attack."""

    rows: slice
    generator: torch.Generator


def parts_of(parts: Sequence[Part], rows: Tensor) -> Sequence[Part]:
    """The units of the episodes `rows`, int64 [R] in ascending order, without the units that have none of them."""
    if len(parts) == 1:
        return [Part(slice(0, len(rows)), parts[0].generator)]
    ends = torch.searchsorted(rows, torch.tensor([0, *(part.rows.stop for part in parts)])).tolist()
    found = [Part(slice(start, end), part.generator) for part, (start, end) in zip(parts, pairwise(ends), strict=True)]
    return [part for part in found if part.rows.stop > part.rows.start]


class Door(Protocol):
    """How an oracle reaches the run: queries are counted and answered behind it."""

    def decide(self, observation: Tensor, rows: Tensor | None) -> Tensor:
        """As `Oracle.decide`."""

    def scores(self, observation: Tensor, rows: Tensor | None) -> Tensor:
        """As `Oracle.scores`."""

    def gradient(self, observation: Tensor, loss: Loss, rows: Tensor | None) -> tuple[Tensor, Tensor]:
        """As `Oracle.gradient`."""

    def value(self, observation: Tensor, action: Tensor, rows: Tensor | None) -> Tensor:
        """As `Oracle.value`."""

    def spent(self) -> Tensor:
        """As `Oracle.spent`."""

    def dynamics(self) -> Dynamics:
        """As `Oracle.dynamics`."""

    def imagined(self, copies: int, rows: Tensor | None) -> State:
        """As `Oracle.imagined`."""

    def rehearse(self, observation: Tensor, state: State, rows: Tensor | None) -> tuple[Tensor, State]:
        """As `Oracle.rehearse`."""


class Oracle:
    """The only access to the victim, for one step of the running episodes.

    It refuses access above the declared level, and queries above the budget. A batch of queries has shape [..., B, V, F], where
    B counts the running episodes (or the episodes in `rows`). One evaluation of one episode's observation is one query; a
    gradient and a value of the critic are one query each. The victim answers with its state of this step; queries do not change
    the state.

    A random victim is asked `DRAWS` times about each point, and the mean of its answers counts (of discrete decisions the most
    frequent one): the expectation over transformation of Athalye et al. 2018. Each draw is a query.

    Everything here is the attack's own copy. The run keeps its own truth, perturbation set and counters: nothing that is changed
    on this object changes what the attack may do or what is recorded. After its step the oracle answers no more.

    Args:
        door: answers the queries.
        limits: copies of the true observation, the radius, and the bounds of the perturbation set, [B, V, F] each.
        draws: how often the victim is asked about each point.

    Attributes:
        observation: the true observation, [B, V, F].
        radius: largest deviation of each entry, [B, V, F], on the normalised scale.
        threat: the threat model.
        features: features of the observation.
        generator: the attack's random generator.
        parts: the units of the episodes, one after the other, each with a generator of its own; one unit, unless the attack is
            `joint`.
        action_type: whether the victim decides discretely or continuously.
        draws: how often the victim is asked about each point: 1 unless it is random.
    """

    def __init__(
        self,
        door: Door,
        limits: tuple[Tensor, Tensor, Tensor, Tensor],
        *,
        threat: ObservationThreat,
        features: Features,
        parts: Sequence[Part],
        action_type: ActionType,
        draws: int = 1,
    ) -> None:
        self._door = door
        self.threat, self.features, self.parts, self.action_type = threat, features, parts, action_type
        self.draws = draws
        self.generator = parts[0].generator
        self.observation, self.radius, low, high = limits
        self._set = self._subset = (self.observation, low, high)
        self._rows: Tensor | None = None

    @property
    def spent(self) -> Tensor:
        """[B] number of queries of each episode in this step so far."""
        return self._door.spent()

    @property
    def remaining(self) -> Tensor:
        """[B] number of points that each episode may still ask about in this step: its queries, divided by `draws`."""
        return (self.threat.queries - self._door.spent()) // self.draws

    @property
    def dynamics(self) -> Dynamics:
        """The world's rules of motion; needs access `dynamics`.

        Raises:
            UserError: if the attack declares less access, or the world does not offer them.
        """
        return self._door.dynamics()

    def imagined(self, copies: int, rows: Tensor | None = None) -> State:
        """A copy of the victim's state of this step for simulated episodes, batch size [K * B]; needs access `dynamics`.

        None if the victim has no state. It belongs to the victim: an attack passes it to `rehearse`.

        Args:
            copies: K, copies of each episode.
            rows: int64 [R], the episodes to simulate; the batch size is then [K * R]. None for all.
        """
        return self._door.imagined(copies, rows)

    def rehearse(self, observation: Tensor, state: State, rows: Tensor | None = None) -> tuple[Tensor, State]:
        """What the victim does in simulated episodes, and its state after that; needs access `dynamics`.

        Args:
            observation: what it is shown there, [K, B, V, F] (of all episodes) or [K, R, V, F] (of `rows`). Each is a query of
                its episode.
            state: from `imagined`, or from the last call, for the same copies and rows.
            rows: as in `imagined`.

        Raises:
            UserError: if there are more or fewer observations than episodes, or the state is of others.
        """
        return self._door.rehearse(observation, state, rows)

    def project(self, perturbed: Tensor, rows: Tensor | None = None) -> Tensor:
        """Project `perturbed` [..., B, V, F] (of all episodes, or of `rows`) onto the perturbation set. Costs no query."""
        if rows is None:
            return within(perturbed, *self._set)
        if rows is not self._rows:
            truth, low, high = self._set
            self._rows, self._subset = rows, (truth[rows], low[rows], high[rows])
        return within(perturbed, *self._subset)

    def decide(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's actions; needs access `decisions`."""
        actions = self._door.decide(self._repeated(observation), rows)
        if self.draws == 1:
            return actions
        return actions.mean(0) if actions.is_floating_point() else actions.mode(0).values

    def scores(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's Q-values [..., B, A] or its continuous action [..., B, 2]; needs access `scores`."""
        return self._mean(self._door.scores(self._repeated(observation), rows))

    def gradient(self, observation: Tensor, loss: Loss, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The loss [..., B] of the victim's scores and its gradient [..., B, V, F] in the observation; needs `gradients`.

        The gradient of a non-differentiable victim is 0.
        """
        value, gradient = self._door.gradient(
            self._repeated(observation), lambda scores: loss(self._mean(scores)), rows
        )
        return value, gradient if self.draws == 1 else gradient.sum(0)

    def value(self, observation: Tensor, action: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's own critic Q(observation, action) [..., B], differentiable in a continuous action; needs `gradients`.

        Raises:
            NotImplementedError: if the victim has no critic.
        """
        return self._mean(self._door.value(self._repeated(observation), self._repeated(action), rows))

    def _repeated(self, points: Tensor) -> Tensor:
        """`draws` copies of the points, [D, ...]; the points themselves if one is enough."""
        return points if self.draws == 1 else points.expand(self.draws, *points.shape)

    def _mean(self, answers: Tensor) -> Tensor:
        """The mean over the draws of answers [D, ...]."""
        return answers if self.draws == 1 else answers.mean(0)
