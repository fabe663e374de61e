"""An attack's access to the driving policy: the oracle that it is given, and the run's side, which enforces and counts.

`Enforcer` has the truth, the perturbation set and the budget, and makes one oracle for each step. `Oracle` has one method for
each kind of query: it pays first (`_paid`), then asks the victim in the victim's turn (`CountedPolicy.asked`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Literal, NoReturn

import numpy as np
import torch
from torch import Tensor
from torch.nn import Parameter

from cavbench.core import sets
from cavbench.core.contracts import Access, QueryBudgetError, permit
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import ActionType, Features
from cavbench.driving.forgery import Forgery
from cavbench.driving.forging import Forging
from cavbench.driving.gradients import Gradients, Tangent
from cavbench.driving.parts import Part, parts_of
from cavbench.driving.policy import State, rows_of
from cavbench.driving.threat import ObservationThreat, PerturbationSet, bounds, within
from cavbench.driving.traffic import ORDERED, Orders, View
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.isolation.watch import TamperError

STEPS = 450
"""Decisions of a full episode, where there is no episode."""
DRAWS = 8
"""How often a random victim is asked about each point."""


@dataclass(eq=False, repr=False, kw_only=True, slots=True)
class Oracle:
    """The only access to the victim, for one step of the running episodes.

    It refuses access above the declared level, and queries above the budget. A batch of queries has shape [..., B, V, F], where
    B counts the running episodes, or those of a selection (`select`). One evaluation of one episode's observation is one query;
    a gradient and a value of the critic are one query each. The victim answers with its state of this step; queries do not
    change the state.

    A random victim is asked `DRAWS` times about each point, and the mean of its answers counts (of discrete decisions the most
    frequent one): the expectation over transformation of Athalye et al. 2018. Each draw is a query.

    Everything here is the attack's own copy. The run keeps its own truth, perturbation set and counters: nothing that is changed
    on this object changes what the attack may do or what is recorded. After its step the oracle answers no more.
    """

    _enforcer: Enforcer
    _step: int
    _rows: Tensor | None
    _bounds: tuple[Tensor, Tensor]
    observation: Tensor
    """The true observation, [B, V, F]."""
    radius: Tensor
    """The largest deviation of each entry, [B, V, F], on the normalised scale."""
    threat: ObservationThreat
    """The threat model."""
    features: Features
    """The features of the observation."""
    parts: Sequence[Part]
    """The units of the episodes, each with a random generator of its own; one unit, unless the attack is `joint`."""
    generator: torch.Generator
    """The attack's random generator."""
    action_type: ActionType
    """Whether the victim decides discretely or continuously."""
    draws: int
    """How often the victim is asked about each point: 1 unless it is random."""
    _view: View | None = None

    def __reduce__(self) -> NoReturn:
        # `copy.copy`, `copy.deepcopy` and `pickle` ask here. A deep copy would ask a copy of the victim, uncounted.
        raise TypeError("an oracle cannot be copied; oracle.select(rows) makes one of some episodes")

    def select(self, rows: Tensor) -> Oracle:
        """An oracle of some of these episodes: B is then R, in what it has and in what it is asked. Only they pay queries.

        Args:
            rows: int64 [R], numbers among the B episodes; in ascending order if the attack is `joint`.
        """
        count = len(self.observation)
        if rows.dtype != torch.int64 or rows.ndim != 1 or bool(((rows < 0) | (rows >= count)).any()):
            raise UserError(f"the attack selected episodes by other than numbers from 0 to {count - 1}, int64 [R]")
        low, high = self._bounds
        return replace(
            self,
            _rows=rows.clone() if self._rows is None else self._rows[rows],
            _bounds=(low[rows], high[rows]),
            observation=self.observation[rows],
            radius=self.radius[rows],
            parts=parts_of(self.parts, rows),
            _view=None if self._view is None else self._view.of(rows),
        )

    @property
    def traffic(self) -> View:
        """The cars of the B episodes, for an attack that drives some of them.

        Raises:
            UserError: if the attack does not declare that it `drives`.
        """
        if self._view is None:
            raise UserError("the attack asks for the traffic: it must declare drives = True")
        return self._view

    def order(self, orders: Orders) -> None:
        """What the driven cars of the B episodes are to do in the next decision. The world keeps the bounds (`threat.traffic`).

        Raises:
            UserError: if the attack does not declare that it `drives`, or the orders have another shape.
            TamperError: if the step is over.
        """
        self._enforcer.order(self._step, orders.stacked(), self.traffic.x.shape, self._rows)

    @property
    def spent(self) -> Tensor:
        """[B] number of queries of each episode in this step so far."""
        return self._enforcer.spent.clone() if self._rows is None else self._enforcer.spent[self._rows]

    @property
    def remaining(self) -> Tensor:
        """[B] number of points that each episode may still ask about in this step: its queries, divided by `draws`."""
        return (self.threat.queries - self.spent) // self.draws

    def project(self, perturbed: Tensor) -> Tensor:
        """Project `perturbed` [..., B, V, F] onto the perturbation set. Costs no query."""
        return within(perturbed, self.observation, *self._bounds)

    def decide(self, observation: Tensor) -> Tensor:
        """The victim's actions, int64 [..., B] or float [..., B, 2]; needs access `decisions`."""
        scores = self._answered("decisions", observation)
        with self._enforcer.subject.asked():
            actions = self._enforcer.subject.choose(scores)
        if self.draws == 1:
            return actions
        return actions.mean(0) if actions.is_floating_point() else actions.mode(0).values

    def scores(self, observation: Tensor) -> Tensor:
        """The victim's Q-values [..., B, A] or its continuous action [..., B, 2]; needs access `scores`."""
        return self._mean(self._answered("scores", observation))

    def gradient(self, observation: Tensor, loss: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """The loss [..., B] of the victim's scores and its gradient [..., B, V, F] in the observation; needs `gradients`.

        The gradient of a non-differentiable victim is 0.
        """
        points, subject = self._repeated(observation), self._enforcer.subject
        state = self._paid("gradients", points)

        def of_scores(scores: Tensor) -> Tensor:
            with subject.asked(foreign=True):
                return loss(self._mean(scores.unflatten(0, points.shape[:-2])))

        with subject.asked():
            value, gradient = subject.differentiated(points.flatten(0, -3), state, of_scores, self._numbers(points))
        gradient = gradient.reshape(points.shape).flatten(-2)
        gradient = self._enforcer.gradients.cleaned(gradient, self._rows, observed=True).reshape(points.shape)
        return value, gradient if self.draws == 1 else gradient.sum(0)

    def value(self, observation: Tensor, action: Tensor) -> Tensor:
        """The victim's own critic Q(observation, action) [..., B], differentiable in a continuous action; needs `gradients`.

        Raises:
            NotImplementedError: if the victim has no critic.
        """
        points, actions, subject = self._repeated(observation), self._repeated(action), self._enforcer.subject
        state = self._paid("gradients", points)
        with subject.asked():
            asked = points.flatten(0, -3), actions.flatten(0, points.ndim - 3)
            value, gradient = subject.valued(*asked, state, self._numbers(points))
        value = value.reshape(points.shape[:-2])
        if gradient is not None:
            gradient = self._enforcer.gradients.cleaned(gradient.reshape(actions.shape), self._rows)
            value = Tangent.apply(actions, value, gradient)
        return self._mean(value)

    @property
    def period(self) -> float:
        """Seconds between decisions."""
        return self._enforcer.forged.period

    def past(self, age: int) -> Tensor:
        """The true observation [B, V, F] of some decisions ago; the oldest that may still be shown, if that is younger."""
        kept = self._enforcer.forged.past(age)[self._enforcer.rows]
        return kept if self._rows is None else kept[self._rows]

    def left(self, of: Literal["presence", "held", "messages"]) -> Tensor:
        """int64 [B] frames in which cars may still be hidden or invented, the sensor held, or messages held back."""
        rows = self._enforcer.rows
        return self._enforcer.forged.left(of, rows if self._rows is None else rows[self._rows])

    @property
    def dynamics(self) -> Dynamics:
        """The world's rules of motion; needs access `dynamics`, and a world that offers them."""
        permit("dynamics", self._enforcer.access)
        if self._enforcer.dynamics is None:
            raise UserError("the attack needs the dynamics of the world, which this world does not offer")
        return self._enforcer.dynamics

    def imagined(self, copies: int) -> State:
        """The victim's state of this step for K `copies` of each episode, [K * B], to `rehearse` with; needs access `dynamics`.

        It belongs to the victim. None if the victim has no state.
        """
        permit("dynamics", self._enforcer.access)
        return self._enforcer.remembered(self._rows, copies)

    def rehearse(self, observation: Tensor, state: State) -> tuple[Tensor, State]:
        """What the victim does in simulated episodes, and its state after that; needs access `dynamics`.

        Args:
            observation: what it is shown there, [K, B, V, F]. Each is a query of its episode.
            state: from `imagined`, or from the last call, for the same copies and episodes.

        Raises:
            UserError: if there are more or fewer observations than episodes, or the state is of others.
        """
        self._enforcer.spend("dynamics", self._step, observation, self._rows)
        self._enforcer.rehearsed = len(observation), self._rows
        flat, subject = observation.flatten(0, -3), self._enforcer.subject
        if state is not None and len(state) != len(flat):
            raise UserError(f"the attack rehearsed {len(flat)} episodes with the state of {len(state)}")
        with subject.asked(), torch.no_grad():
            action = subject.choose(subject.answered(flat, state, self._numbers(observation)))
            after = subject.advance(flat, action, state)
        return action.unflatten(0, observation.shape[:-2]).clone(), after

    def _answered(self, access: Access, observation: Tensor) -> Tensor:
        """The scores [..., B, A]; those of every draw, [D, ..., B, A], if the victim is random."""
        points = self._repeated(observation)
        state = self._paid(access, points)
        with self._enforcer.subject.asked():
            scores = self._enforcer.subject.answered(points.flatten(0, -3), state, self._numbers(points))
        return scores.unflatten(0, points.shape[:-2])

    def _paid(self, access: Access, points: Tensor) -> State:
        """Count the queries [..., B, V, F]; the victim's state for each of them, flattened to [N]."""
        self._enforcer.spend(access, self._step, points, self._rows)
        return self._enforcer.remembered(self._rows, points.shape[:-3].numel())

    def _numbers(self, points: Tensor) -> Tensor | None:
        """Numbers for the draws of a random victim at points [..., B, V, F], flattened to [N]."""
        rows = self._enforcer.rows
        return self._enforcer.subject.numbers(
            rows if self._rows is None else rows[self._rows], points.shape[:-3].numel()
        )

    def _repeated(self, points: Tensor) -> Tensor:
        """`draws` copies of the points, [D, ...]; the points themselves if one is enough."""
        return points if self.draws == 1 else points.expand(self.draws, *points.shape)

    def _mean(self, answers: Tensor) -> Tensor:
        """The mean over the draws of answers [D, ...]."""
        return answers if self.draws == 1 else answers.mean(0)


class Enforcer:
    """Enforces the access level, the perturbation set and the query budget of an attack, with what no attack is given.

    `begin` gives the attack an oracle for one step. `project` brings its answer into the perturbation set. `counts` are the
    queries and gradients of the step; `close` compares them with the evaluations that the victim itself was seen to make.
    `asked`, if it is a list, collects the queries. `rehearsed` has the copies and the episodes of the last rehearsal.

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
        self.forging: Forging | None = None
        self._forges = bool(sets.present(threat))
        self.asked: list[tuple[Tensor | None, Tensor]] | None = None
        self.rehearsed: tuple[int, Tensor | None] | None = None
        self.orders: Tensor | None = None
        self._step = 0

    def begin(
        self,
        observation: Tensor,
        state: State = None,
        scale: float = 1.0,
        parts: Sequence[Part] = (),
        rows: Tensor | None = None,
        view: View | None = None,
    ) -> Oracle:
        """The oracle of a step, with counters at 0; the oracle of the step before answers no more.

        Args:
            observation: the true observation, [B, V, F].
            state: the victim's state for these B episodes.
            scale: multiplies the budget.
            parts: the units of these episodes; by default they are one unit, with the generator of the enforcer.
            rows: int64 [B], their places among the episodes that `forging` goes on with; by default each step is the first one.
            view: the traffic of these episodes, for an attack that drives some of it.
        """
        if rows is None:
            self.forging = Forging(self.threat, self.features, 1 / 15, STEPS, [(len(observation), 0)])
            self.forging.see(observation)
        self.rows = torch.arange(len(observation)) if rows is None else rows
        radius = self.threat.radius(observation, self.features, scale)
        low, high = bounds(observation, radius)
        self._set = PerturbationSet(observation, radius, low, high)
        self._state = state
        self._evaluations, self._step = self.subject.evaluations, self._step + 1
        self.spent = torch.zeros(len(observation), dtype=torch.int64)
        self.gradients = Gradients(self._set.radius)
        self.orders = None if view is None else torch.zeros(*view.x.shape, ORDERED, dtype=torch.float64)
        threat, features = self._shown
        parts = parts or (Part(slice(0, len(observation)), self.generator),)
        return Oracle(
            _enforcer=self,
            _step=self._step,
            _rows=None,
            _bounds=(low, high),
            observation=observation.clone(),
            radius=radius,
            threat=threat,
            features=features,
            parts=parts,
            generator=parts[0].generator,
            action_type=self.subject.action_type,
            draws=DRAWS if self.subject.draws and self.threat.queries >= DRAWS else 1,
            _view=None if view is None else View(*(values.clone() for values in view)),
        )

    def order(self, step: int, orders: Tensor, shape: torch.Size, rows: Tensor | None) -> None:
        """Take orders [R, N, 3] for the next decision, of all episodes or of `rows`; see `Oracle.order`."""
        if step != self._step:
            raise TamperError("the attack used the oracle of another step", "attack")
        if type(orders) is not Tensor or orders.shape != (*shape, ORDERED):
            raise UserError(f"the attack gave orders of shape {list(orders.shape)[:-1]}, its oracle has {list(shape)}")
        assert self.orders is not None
        self.orders[slice(None) if rows is None else rows] = orders.detach()

    def spend(self, access: Access, step: int, observation: Tensor, rows: Tensor | None) -> None:
        """Count queries [..., B, V, F], of all episodes or of `rows`, before they are answered.

        Raises:
            UserError: if the attack declares less access, or the observations are of another number of episodes.
            QueryBudgetError: if an episode has too few queries left.
            TamperError: if the step is over.
        """
        permit(access, self.access)
        # Another type could run code of the attack in the victim's turn, when nobody counts what it evaluates.
        if type(observation) not in (Tensor, Parameter):
            raise UserError(f"the attack asked about a {type(observation).__name__}, not about a torch.Tensor")
        if step != self._step:
            raise TamperError("the attack used the oracle of another step", "attack")
        asked, there = observation.shape[-3], len(self.spent if rows is None else rows)
        if asked != there:
            raise UserError(f"the attack asked about {asked} episodes, its oracle has {there}: ask oracle.select(rows)")
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

    def remembered(self, rows: Tensor | None, copies: int) -> State:
        """The victim's state of this step, of all episodes or of `rows`, K `copies` one after the other, [K * R].

        It belongs to the query: a policy may write to it.
        """
        if self._state is None:
            return None
        if copies == 1:
            return self._state.clone() if rows is None else rows_of(self._state, rows)
        places = torch.arange(len(self._state)) if rows is None else rows
        return rows_of(self._state, places.repeat(copies))

    def project(self, answer: Tensor | Forgery, name: str = "the attack") -> tuple[Tensor, Tensor]:
        """The answer in the sets of the threat model, and how far it was from them (`PerturbationSet.project`, `Forging.show`).

        Raises:
            UserError: if a forgery is more than the threat model allows.
        """
        if not isinstance(answer, Forgery):
            if not self._forges:
                return self._set.project(answer)
            # It shows the newest frame, without forged cars and messages: what is shown after it must follow from that.
            answer = Forgery(observation=answer)
        return self.forged.show(answer, self.rows, name)

    @property
    def forged(self) -> Forging:
        """What enforces the other sets of the threat model."""
        assert self.forging is not None
        return self.forging

    def close(self) -> None:
        """End the step, and check what the attack did.

        Raises:
            TamperError: if it reached the victim past the oracle, or changed counters or weights.
        """
        self._step += 1
        spent = self.spent.numpy()
        if (
            int(spent.sum()) != self.subject.evaluations - self._evaluations
            or spent.max(initial=0) > self.threat.queries
        ):
            raise TamperError("the attack changed the counts of its queries", "attack")
        if self.subject.watch and self.subject.watch.strays:
            raise TamperError("the attack evaluated the victim's network past the oracle", "attack")

    @property
    def counts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """int64 [B] each, of this step: queries, gradients, gradients that were 0 everywhere, and those with NaN or infinity."""
        computed, zero, lost = self.gradients.counts
        return self.spent, computed, zero, lost
