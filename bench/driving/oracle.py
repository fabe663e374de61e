"""An attack's only access to the driving policy; enforces the access level, the perturbation set and the query budget."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bench.driving.dynamics import Dynamics
from bench.driving.features import Features
from bench.driving.policy import Policy, State, repeated, rows_of
from bench.driving.threat import ObservationThreat, bounds, within
from bench.errors import UserError
from bench.plugins.contracts import Access, QueryBudgetError, permit

CHUNK = 1024
"""Queries per batch: a larger batch does not fit into the processor's cache and takes twice as long per query."""


class Oracle:
    """The only access to the victim. It enforces the access level, counts every query, and raises at the budget.

    A batch of queries has shape [..., B, V, F], where B counts the running episodes (or the episodes in `rows`). One evaluation
    of one episode's observation is one query; a gradient is one query too. The victim answers with its state of this step;
    queries do not change the state. `gradients` counts the gradients of a step, `zero_gradients` the gradients that were 0
    everywhere; `asked`, if it is a list, collects the queries.

    Args:
        policy: the victim.
        threat: the threat model.
        access: the access level that the attack declares; calls above it are refused.
        features: features of the observation.
        generator: the run's random generator, for randomised attacks.
        dynamics: the world's rules of motion; None if the world does not offer them.
    """

    def __init__(
        self,
        policy: Policy,
        threat: ObservationThreat,
        access: Access,
        features: Features,
        generator: torch.Generator,
        dynamics: Dynamics | None = None,
    ) -> None:
        if not threat.allows(access):
            raise UserError(f"the attack needs access {access!r}, the threat model allows {threat.access!r} at most")
        self._policy = policy
        self._access: Access = access
        self._dynamics = dynamics
        self.threat = threat
        self.features = features
        self.generator = generator
        self.action_type = policy.action_type
        self.observation = torch.empty(0)
        self.radius = torch.empty(0)
        self._set = self._subset = (torch.empty(0), torch.empty(0), torch.empty(0))
        self._rows: Tensor | None = None
        self._state: State = None
        self.spent = self.gradients = self.zero_gradients = torch.empty(0, dtype=torch.int64)
        self.asked: list[tuple[Tensor | None, Tensor]] | None = None

    def begin_step(self, observation: Tensor, state: State = None, scale: float = 1.0) -> None:
        """Start a step: set the perturbation set from the true observations, and the query counters to 0.

        Args:
            observation: the true observation, [B, V, F].
            state: the victim's state for these B episodes.
            scale: multiplies the budget.
        """
        self.observation, self._state = observation, state
        self.radius = self.threat.radius(observation, self.features, scale)
        self._set = self._subset = (observation, *bounds(observation, self.radius))
        self._rows = None
        self.spent, self.gradients, self.zero_gradients = torch.zeros(3, observation.shape[0], dtype=torch.int64)

    @property
    def remaining(self) -> Tensor:
        """[B] number of queries left for each episode in this step."""
        return self.threat.queries - self.spent

    @property
    def dynamics(self) -> Dynamics:
        """The world's rules of motion; needs access `dynamics`.

        Raises:
            UserError: if the attack declares less access, or the world does not offer them.
        """
        permit("dynamics", self._access)
        if self._dynamics is None:
            raise UserError("the attack needs the dynamics of the world, which this world does not offer")
        return self._dynamics

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
        self._spend(observation, rows, "decisions")
        return self._in_chunks(self._policy.decide, observation, rows)

    def scores(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's Q-values [..., B, A] or its continuous action [..., B, 2]; needs access `scores`."""
        self._spend(observation, rows, "scores")
        return self._in_chunks(self._policy.scores, observation, rows)

    def gradient(
        self, observation: Tensor, loss: Callable[[Tensor], Tensor], rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The loss [..., B] of the victim's scores and its gradient [..., B, V, F] in the observation; needs `gradients`.

        The gradient of a non-differentiable victim is 0.
        """
        self._spend(observation, rows, "gradients")
        leaf = observation.detach().requires_grad_(True)
        with torch.enable_grad():
            value = loss(self._scores(leaf, rows))
            found = torch.autograd.grad(value.sum(), leaf, allow_unused=True) if value.requires_grad else (None,)
        gradient = torch.zeros_like(observation) if found[0] is None else found[0]
        zero = (gradient == 0).flatten(-2).all(-1)
        self._count(self.gradients, torch.ones_like(zero), rows)
        self._count(self.zero_gradients, zero, rows)
        return value.detach(), gradient

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """The victim's own critic Q(observation, action) [..., B], differentiable in the action; needs access `gradients`.

        It costs no query: a white-box attacker knows the weights and evaluates the critic itself.
        """
        permit("gradients", self._access)
        if self._state is None:
            return self._policy.value(observation, action)
        state = self._remembered(observation, None)
        return self._policy.value(observation.flatten(0, -3), action.flatten(0, -2), state).unflatten(
            0, observation.shape[:-2]
        )

    def _scores(self, observation: Tensor, rows: Tensor | None) -> Tensor:
        """The victim's scores [..., B, A] in one batch, with the graph back to the observation."""
        if self._state is None:
            return self._policy.scores(observation)
        flat = self._policy.scores(observation.flatten(0, -3), self._remembered(observation, rows))
        return flat.unflatten(0, observation.shape[:-2])

    def _remembered(self, observation: Tensor, rows: Tensor | None) -> State:
        """The victim's state for each observation of [..., B, V, F], flattened to [N]."""
        state = self._state if rows is None else rows_of(self._state, rows)
        return repeated(state, observation.shape[:-3])

    @torch.no_grad()
    def _in_chunks(self, ask: Callable[[Tensor, State], Tensor], observation: Tensor, rows: Tensor | None) -> Tensor:
        """Answer queries in batches of `CHUNK`: single queries are slow, larger batches do not fit into the cache."""
        flat, state = observation.flatten(0, -3), self._remembered(observation, rows)
        if not len(flat):
            return ask(flat, state).unflatten(0, observation.shape[:-2])
        parts = flat.split(CHUNK)
        states = [None] * len(parts) if state is None else state.split(CHUNK)
        return torch.cat(list(map(ask, parts, states))).unflatten(0, observation.shape[:-2])

    @staticmethod
    def _count(counter: Tensor, counted: Tensor, rows: Tensor | None) -> None:
        """Add `counted` [..., B] to the counter of each running episode, or of the episodes in `rows`."""
        counts = counted.long().flatten(0, -2).sum(0) if counted.ndim > 1 else counted.long()
        counter.index_add_(0, torch.arange(len(counter)) if rows is None else rows, counts)

    def _spend(self, observation: Tensor, rows: Tensor | None, access: Access) -> None:
        permit(access, self._access)
        if self.asked is not None:
            self.asked.append((rows, observation.detach()))
        queries = observation.shape[:-3].numel()
        if rows is None:
            self.spent += queries
        else:
            self.spent.index_add_(0, rows, torch.full_like(rows, queries))
        worst = int(self.spent.max()) if self.spent.numel() else 0
        if worst > self.threat.queries:
            raise QueryBudgetError(
                f"the attack asked for {worst} queries in a step, the threat model allows {self.threat.queries}"
            )
