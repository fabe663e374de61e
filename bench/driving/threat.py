"""What an attacker of a driver may know and change, and the oracle that enforces it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

from bench.driving.contracts import Features, Policy
from bench.errors import UserError
from bench.plugins.contracts import Access, QueryBudgetError, ThreatModel, permit

Norm = Literal["relative", "linf"]

CHUNK = 1024
"""Queries answered at once: larger batches leave the processor's cache and take twice as long each."""

FLOORS = {"x": 0.5, "y": 0.2, "vx": 0.3, "vy": 0.2}
"""Smallest deviation of the `relative` set at a budget of 0.1, in m and m/s: a sensor's own resolution."""


@dataclass(frozen=True, kw_only=True)
class ObservationThreat(ThreatModel):
    """The threat model of the driving track.

    Args:
        norm: `relative`: each measured value of a present row may be off by `budget` times its actual value, or by the
            feature's floor (scaled with the budget) where that is larger (thesis 4.3.1). `linf`: by `budget` on the [-1, 1]
            scale (thesis 4.4.3, read as a range; a stress test).
        budget: size of the set, in [0, 2].
        queries: most policy evaluations an episode may spend in one step.

    `presence` cannot be forged and absent rows cannot be filled. What leaves [-1, 1], the range of every sensor, is clipped.
    """

    norm: Norm = "relative"
    budget: float = 0.1
    queries: int = 1000

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.norm not in get_args(Norm):
            raise ValueError(f"threat.norm must be one of {', '.join(get_args(Norm))}, got {self.norm!r}")
        if not 0 <= self.budget <= 2:
            raise ValueError(f"threat.budget must be between 0 and 2, got {self.budget}")

    def radius(self, observation: Tensor, features: Features, scale: float = 1.0) -> Tensor:
        """[..., V, F] the largest deviation of each entry, on the normalised scale; 0 for presence and absent rows.

        Args:
            observation: the true observation [..., V, F].
            features: names and ranges of the measured features.
            scale: multiplies the budget (adversarial training ramps it).
        """
        measured = observation[..., 1:]
        budget = self.budget * scale
        if self.norm == "linf":
            bound = torch.full_like(measured, budget)
        else:
            half_range = features.half_range().to(measured)
            centre = (torch.tensor(features.low) + torch.tensor(features.high)).to(measured) / 2
            floor = torch.tensor([FLOORS.get(name, 0.0) for name in features.names]).to(measured) * (budget / 0.1)
            physical = measured * half_range + centre
            bound = torch.maximum(budget * physical.abs(), floor) / half_range
        bound = bound * (observation[..., :1] > 0)
        return torch.cat((torch.zeros_like(observation[..., :1]), bound), -1)


def project(perturbed: Tensor, observation: Tensor, radius: Tensor) -> Tensor:
    """The nearest point of the perturbation set: within `radius` of `observation` and within the sensors' [-1, 1].

    NaN counts as no perturbation.
    """
    return _between(perturbed, observation, *_bounds(observation, radius))


def _bounds(observation: Tensor, radius: Tensor) -> tuple[Tensor, Tensor]:
    """The lowest and the highest value of every entry of the perturbation set."""
    return (observation - radius).clamp(-1.0, 1.0), (observation + radius).clamp(-1.0, 1.0)


def _between(perturbed: Tensor, observation: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """`perturbed` brought between the bounds, what is NaN back to the observation; one look for NaN is cheaper than a where."""
    within = torch.clamp(perturbed, low, high)
    if bool(within.sum().isfinite()):
        return within
    return torch.where(within.isnan(), observation.clamp(-1.0, 1.0), within)


class Oracle:
    """The only door to the victim. It refuses what the access level forbids, counts every query, and stops at the budget.

    A batch of queries has shape [..., B, V, F], B the running episodes (or those of `rows`); one evaluation of one episode's
    observation is one query, a gradient is one query too. `gradients` counts those of a step, `zero_gradients` those that were 0
    everywhere; `asked`, where it is a list, keeps what was asked.

    Args:
        policy: the victim.
        threat: the threat model.
        access: what the attack declared it needs; more than that is refused.
        features: of the observation.
        generator: the run's random generator, for attacks that draw.
    """

    def __init__(
        self, policy: Policy, threat: ObservationThreat, access: Access, features: Features, generator: torch.Generator
    ) -> None:
        if not threat.allows(access):
            raise UserError(f"the attack needs access {access!r}, the threat model allows {threat.access!r} at most")
        self._policy = policy
        self._access: Access = access
        self.threat = threat
        self.features = features
        self.generator = generator
        self.action_type = policy.action_type
        self.observation = torch.empty(0)
        self.radius = torch.empty(0)
        self._set = self._subset = (torch.empty(0), torch.empty(0), torch.empty(0))
        self._rows: Tensor | None = None
        self.spent = self.gradients = self.zero_gradients = torch.empty(0, dtype=torch.int64)
        self.asked: list[tuple[Tensor | None, Tensor]] | None = None

    def begin_step(self, observation: Tensor, scale: float = 1.0) -> None:
        """Open a step on the true observations [B, V, F]: the perturbation set follows them, the query counters start at 0."""
        self.observation = observation
        self.radius = self.threat.radius(observation, self.features, scale)
        self._set = self._subset = (observation, *_bounds(observation, self.radius))
        self._rows = None
        self.spent, self.gradients, self.zero_gradients = torch.zeros(3, observation.shape[0], dtype=torch.int64)

    @property
    def remaining(self) -> Tensor:
        """[B] queries each episode has left in this step."""
        return self.threat.queries - self.spent

    def project(self, perturbed: Tensor, rows: Tensor | None = None) -> Tensor:
        """`perturbed` [..., B, V, F], or of the episodes `rows`, brought into the perturbation set. Costs no query."""
        if rows is None:
            return _between(perturbed, *self._set)
        if rows is not self._rows:
            truth, low, high = self._set
            self._rows, self._subset = rows, (truth[rows], low[rows], high[rows])
        return _between(perturbed, *self._subset)

    def decide(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's actions; needs access `decisions`."""
        self._spend(observation, rows, "decisions")
        return self._in_chunks(self._policy.decide, observation)

    def scores(self, observation: Tensor, rows: Tensor | None = None) -> Tensor:
        """The victim's Q-values [..., B, A] or its continuous action [..., B, 2]; needs access `scores`."""
        self._spend(observation, rows, "scores")
        return self._in_chunks(self._policy.scores, observation)

    def gradient(
        self, observation: Tensor, loss: Callable[[Tensor], Tensor], rows: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The loss [..., B] of the victim's scores and its gradient [..., B, V, F] in the observation; needs `gradients`.

        A victim that lets none through has a gradient of 0.
        """
        self._spend(observation, rows, "gradients")
        leaf = observation.detach().requires_grad_(True)
        with torch.enable_grad():
            value = loss(self._policy.scores(leaf))
            found = torch.autograd.grad(value.sum(), leaf, allow_unused=True) if value.requires_grad else (None,)
        gradient = torch.zeros_like(observation) if found[0] is None else found[0]
        zero = (gradient == 0).flatten(-2).all(-1)
        self._count(self.gradients, torch.ones_like(zero), rows)
        self._count(self.zero_gradients, zero, rows)
        return value.detach(), gradient

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """The victim's own critic Q(observation, action) [..., B], differentiable in the action; needs access `gradients`.

        White-box knowledge of the weights, evaluated by the attacker, so it costs no query.
        """
        permit("gradients", self._access)
        return self._policy.value(observation, action)

    @torch.no_grad()
    def _in_chunks(self, ask: Callable[[Tensor], Tensor], observation: Tensor) -> Tensor:
        """One query after the other would be slow, and all at once leaves the processor's cache: a thousand at a time."""
        flat = observation.flatten(0, -3)
        answer = torch.cat([ask(part) for part in flat.split(CHUNK)]) if len(flat) else ask(flat)
        return answer.unflatten(0, observation.shape[:-2])

    @staticmethod
    def _count(counter: Tensor, counted: Tensor, rows: Tensor | None) -> None:
        """Add what was counted [..., B] of the running episodes, or of those of `rows`."""
        each = counted.long().flatten(0, -2).sum(0) if counted.ndim > 1 else counted.long()
        counter.index_add_(0, torch.arange(len(counter)) if rows is None else rows, each)

    def _spend(self, observation: Tensor, rows: Tensor | None, access: Access) -> None:
        permit(access, self._access)
        if self.asked is not None:
            self.asked.append((rows, observation.detach()))
        each = observation.shape[:-3].numel()
        if rows is None:
            self.spent += each
        else:
            self.spent.index_add_(0, rows, torch.full_like(rows, each))
        worst = int(self.spent.max()) if self.spent.numel() else 0
        if worst > self.threat.queries:
            raise QueryBudgetError(
                f"the attack asked for {worst} queries in a step, the threat model allows {self.threat.queries}"
            )
