"""The run's side of an attack: its own truth, perturbation set and counters, which no attack is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.core.contracts import Access, QueryBudgetError, permit
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import Features
from cavbench.driving.oracle import DRAWS, Loss, Oracle, Part
from cavbench.driving.policy import State, repeated, rows_of
from cavbench.driving.threat import ObservationThreat, bounds
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.isolation.watch import TamperError

Array = NDArray[Any]


class Enforcer:
    """Enforces the access level, the perturbation set and the query budget of an attack.

    `begin` gives the attack an oracle for one step. `project` brings its answer into the perturbation set, from copies of the
    truth and the bounds that cannot be written to. `counts` are the queries and gradients of the step; `close` compares them
    with the evaluations that the victim itself was seen to make. `asked`, if it is a list, collects the queries. `rehearsed`
    has the copies and the episodes of the last rehearsal.

    Args:
        subject: the victim.
        threat: the threat model.
        access: the access level that the attack declares; calls above it are refused.
        features: features of the observation.
        generator: the attack's random generator.
        dynamics: the world's rules of motion; None if the world does not offer them.

    Raises:
        UserError: if the threat model does not allow the access.
    """

    def __init__(
        self,
        subject: CountedPolicy,
        threat: ObservationThreat,
        access: Access,
        features: Features,
        generator: torch.Generator,
        dynamics: Dynamics | None = None,
    ) -> None:
        if not threat.allows(access):
            raise UserError(f"the attack needs access {access!r}, the threat model allows {threat.access!r} at most")
        self.subject, self.access, self.generator = subject, access, generator
        self.threat, self.features = deepcopy(threat), deepcopy(features)
        # What the attack is given is its own: what it does to it reaches neither the run, nor the world, nor the victim.
        self._shown = deepcopy(threat), deepcopy(features)
        self.dynamics = deepcopy(dynamics)
        self.asked: list[tuple[Tensor | None, Tensor]] | None = None
        self.rehearsed: tuple[int, Tensor | None] | None = None
        self._step = 0
        self.spent = self.gradients = self.zero_gradients = self.nan_gradients = torch.empty(0, dtype=torch.int64)

    def begin(self, observation: Tensor, state: State = None, scale: float = 1.0, parts: Sequence[Part] = ()) -> Oracle:
        """The oracle of a step, with counters at 0; the oracle of the step before answers no more.

        Args:
            observation: the true observation, [B, V, F].
            state: the victim's state for these B episodes.
            scale: multiplies the budget.
            parts: the units of these episodes; by default they are one unit, with the generator of the enforcer.
        """
        radius = self.threat.radius(observation, self.features, scale)
        low, high = bounds(observation, radius)
        self._truth, self._low, self._high, self._radius = map(_fixed, (observation, low, high, radius))
        self._state = state
        self._evaluations, self._step = self.subject.evaluations, self._step + 1
        counters = torch.zeros(4, observation.shape[0], dtype=torch.int64)
        self.spent, self.gradients, self.zero_gradients, self.nan_gradients = counters
        threat, features = self._shown
        return Oracle(
            _Door(self, self._step),
            (observation.clone(), radius, low, high),
            threat=threat,
            features=features,
            parts=parts or (Part(slice(0, len(observation)), self.generator),),
            action_type=self.subject.action_type,
            draws=DRAWS if self.subject.draws and self.threat.queries >= DRAWS else 1,
        )

    def project(self, answer: Tensor) -> tuple[Tensor, Tensor]:
        """The answer [B, V, F] projected onto the perturbation set, and its L-inf distance [B] to the set before.

        The distance of an answer with NaN or infinity is not finite.
        """
        given = answer.detach().cpu().numpy()
        inside = np.clip(given, self._low, self._high)
        inside = np.where(np.isnan(inside), np.clip(self._truth, -1.0, 1.0), inside)
        excess = np.abs(given - inside).reshape(len(given), -1).max(1, initial=0.0)
        return torch.from_numpy(inside).to(answer), torch.from_numpy(excess)

    def close(self) -> None:
        """End the step, and check what the attack did.

        Raises:
            QueryBudgetError: if the attack asked for more than its budget.
            TamperError: if it reached the victim past the oracle, or changed counters or weights.
        """
        self._step += 1
        if int(self.spent.sum()) != self.subject.evaluations - self._evaluations:
            raise TamperError("the attack changed the counts of its queries", "attack")
        if self.subject.watch and self.subject.watch.strays:
            raise TamperError("the attack evaluated the victim's network past the oracle", "attack")

    @property
    def counts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """int64 [B] each, of this step: queries, gradients, gradients that were 0 everywhere, and those with NaN or infinity."""
        return self.spent, self.gradients, self.zero_gradients, self.nan_gradients

    def remembered(self, observation: Tensor, rows: Tensor | None) -> State:
        """The victim's state for each observation of [..., B, V, F], flattened to [N]."""
        if rows is None and self._state is not None and observation.ndim == 3:
            # A policy that writes to its state in a query would drive on with it.
            return self._state.clone()
        state = self._state if rows is None else rows_of(self._state, rows)
        return repeated(state, observation.shape[:-3])

    def imagined(self, copies: int, rows: Tensor | None) -> State:
        """The victim's state for `copies` of each episode (or of `rows`), batch size [copies * B]."""
        return repeated(self._state if rows is None else rows_of(self._state, rows), torch.Size([copies]))

    def spend(self, access: Access, step: int, observation: Tensor, rows: Tensor | None) -> None:
        """Count queries [..., B, V, F] before they are answered.

        Raises:
            UserError: if the attack declares less access, or the observations are of another number of episodes.
            QueryBudgetError: if an episode has too few queries left.
            TamperError: if the step is over.
        """
        permit(access, self.access)
        if step != self._step:
            raise TamperError("the attack used the oracle of another step", "attack")
        asked, there = observation.shape[-3], len(self.spent if rows is None else rows)
        if asked != there:
            which = "episodes that run" if rows is None else "rows"
            raise UserError(
                f"the attack asked about {asked} episodes, there are {there} {which}: give their numbers as rows="
            )
        if self.asked is not None:
            self.asked.append((rows, observation.detach()))
        queries, spent = observation.shape[:-3].numel(), self.spent.numpy()
        # NumPy: a call costs a fraction of torch's, and this runs before every query.
        wanted = spent + (queries if rows is None else queries * np.bincount(rows.numpy(), minlength=len(spent)))
        worst = int(wanted.max(initial=0))
        if worst > self.threat.queries:
            raise QueryBudgetError(
                f"the attack asked for {worst} queries in a step, the threat model allows {self.threat.queries}"
            )
        self.spent = torch.from_numpy(wanted)

    def free(self, rows: Tensor | None) -> Tensor:
        """bool [B, V * F] the entries that the attack may change, of all episodes or of `rows`."""
        free = torch.from_numpy(self._radius > 0).flatten(1)
        return free if rows is None else free[rows]

    def counted(self, gradient: Tensor, rows: Tensor | None, free: Callable[[], Tensor] | None = None) -> Tensor:
        """The gradients [..., B, n], with 0 for each entry that is NaN or infinite, after they were counted.

        An attack averages over the entries of a gradient, so one NaN would spoil them all: a victim with such a gradient would
        look robust.

        Args:
            gradient: as the victim's graph gives it.
            rows: the episodes.
            free: the entries that matter, bool [B, n]; None for all. A NaN in another entry costs the attack nothing.
        """
        places = torch.arange(len(self.spent)) if rows is None else rows
        # One sum is cheaper than a look at every entry.
        if not bool(gradient.sum().isfinite()):
            lost = ~gradient.isfinite()
            gradient = gradient.masked_fill(lost, 0.0)
            self._add(self.nan_gradients, (lost if free is None else lost & free()).any(-1), places)
        zero = (gradient == 0).all(-1)
        self._add(self.gradients, torch.ones_like(zero), places)
        self._add(self.zero_gradients, zero, places)
        return gradient

    @staticmethod
    def _add(counter: Tensor, found: Tensor, places: Tensor) -> None:
        """Add the marks [..., B] to the counter of their episodes."""
        counter.index_add_(0, places, found.long().flatten(0, -2).sum(0) if found.ndim > 1 else found.long())


class _Door:
    """The queries of one step (`cavbench.driving.oracle.Door`)."""

    def __init__(self, enforcer: Enforcer, step: int) -> None:
        self._enforcer, self._step = enforcer, step

    def spent(self) -> Tensor:
        return self._enforcer.spent.clone()

    def dynamics(self) -> Dynamics:
        permit("dynamics", self._enforcer.access)
        if self._enforcer.dynamics is None:
            raise UserError("the attack needs the dynamics of the world, which this world does not offer")
        return self._enforcer.dynamics

    def imagined(self, copies: int, rows: Tensor | None) -> State:
        permit("dynamics", self._enforcer.access)
        state = self._enforcer.imagined(copies, rows)
        return None if state is None else state.clone()

    def rehearse(self, observation: Tensor, state: State, rows: Tensor | None) -> tuple[Tensor, State]:
        enforcer = self._enforcer
        enforcer.spend("dynamics", self._step, observation, rows)
        enforcer.rehearsed = len(observation), rows
        flat, subject = observation.flatten(0, -3), enforcer.subject
        if state is not None and len(state) != len(flat):
            raise UserError(
                f"the attack rehearsed {len(flat)} episodes with the state of {len(state)}: `imagined` takes copies and rows"
            )
        with subject.asked(), torch.no_grad():
            action = subject.policy.choose(subject.answered(flat, state))
            after = subject.advance(flat, action, state)
        return action.unflatten(0, observation.shape[:-2]).clone(), after

    def decide(self, observation: Tensor, rows: Tensor | None) -> Tensor:
        return self._enforcer.subject.policy.choose(self._answered("decisions", observation, rows))

    def scores(self, observation: Tensor, rows: Tensor | None) -> Tensor:
        return self._answered("scores", observation, rows)

    def _answered(self, access: Access, observation: Tensor, rows: Tensor | None) -> Tensor:
        enforcer = self._enforcer
        enforcer.spend(access, self._step, observation, rows)
        state = enforcer.remembered(observation, rows)
        with enforcer.subject.asked():
            scores = enforcer.subject.answered(observation.flatten(0, -3), state)
        return scores.unflatten(0, observation.shape[:-2])

    def gradient(self, observation: Tensor, loss: Loss, rows: Tensor | None) -> tuple[Tensor, Tensor]:
        enforcer = self._enforcer
        enforcer.spend("gradients", self._step, observation, rows)
        state = enforcer.remembered(observation, rows)

        def shaped(scores: Tensor) -> Tensor:
            with enforcer.subject.asked(foreign=True):
                return loss(scores.unflatten(0, observation.shape[:-2]))

        with enforcer.subject.asked():
            value, gradient = enforcer.subject.differentiated(observation.flatten(0, -3), state, shaped)
        gradient = gradient.reshape(observation.shape).flatten(-2)
        gradient = enforcer.counted(gradient, rows, lambda: enforcer.free(rows))
        return value, gradient.reshape(observation.shape)

    def value(self, observation: Tensor, action: Tensor, rows: Tensor | None) -> Tensor:
        enforcer = self._enforcer
        enforcer.spend("gradients", self._step, observation, rows)
        state = enforcer.remembered(observation, rows)
        flat = action.flatten(0, observation.ndim - 3)
        with enforcer.subject.asked():
            value, gradient = enforcer.subject.valued(observation.flatten(0, -3), flat, state)
        value = value.reshape(observation.shape[:-2])
        if gradient is None:
            return value
        gradient = enforcer.counted(gradient.reshape(action.shape), rows)
        return _Tangent.apply(action, value, gradient)


class _Tangent(torch.autograd.Function):
    """A value [...] with a known gradient [..., n] in its first input [..., n], and no graph behind it."""

    @staticmethod
    def forward(ctx: Any, point: Tensor, value: Tensor, gradient: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    def backward(ctx: Any, outer: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return outer.unsqueeze(-1) * gradient, None, None


def _fixed(values: Tensor) -> Array:
    """A copy that cannot be written to: an array on immutable bytes."""
    found = values.detach().cpu().contiguous().numpy()
    return np.frombuffer(found.tobytes(), found.dtype).reshape(found.shape)
