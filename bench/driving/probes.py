"""Probes of a victim, at steps that it cannot foresee: is it random, does it see, and does it answer an attack as it drives?

A probe asks in every way in which an oracle asks. It does not count as a query of the attack, and it has its own random numbers.
The leaderboard's flags use the results.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavbench.driving.draws import fresh
from cavbench.driving.policy import State, repeated, rows_of
from cavbench.driving.shadows import REPEATS, ROUNDING, Shadow, differ, near
from cavbench.driving.victim import CHUNK, CountedPolicy

EVERY = 15
"""Mean number of steps between two probes: a second of driving."""
SAME = 1e-6
"""Two scores count as the same answer if they differ by at most this."""
NEAR = 0.02
"""Width of the noise on the other points of a question, on the normalised scale."""
PATH_WEIGHTS = (4, 4, 4, 1, 4)
PATHS = ("some", "one", "many", "chunks", "gradient")
"""How an oracle asks: some episodes in any order, one, many points each, more than a batch holds, with gradients."""
SHADOWS = 0.25
"""Share of the probed steps at which a shadow begins (`cavbench.driving.shadows`)."""
SHADOWS_IF_REHEARSED = 0.5
"""The same under an attack that may rehearse."""
SHORT, LONG = 4, 64
"""Most steps of a shadow; every second one may be long under an attack that may rehearse."""
MOST_COPIES = 12


@dataclass(frozen=True)
class _Question:
    """A question along one of `PATHS`.

    Args:
        path: the path.
        rows: int64 [R], the episodes in question.
        place: which of the K copies of each episode is the observation that it is driven with; others are near it.
        points: [K * R, V, F].
        state: the victim's state of each point.
        earlier: how often the same is asked before, without a look at the answer: a decoy may count the questions of a step.
    """

    path: str
    rows: Tensor
    place: int
    points: Tensor
    state: State
    earlier: int


class Probe:
    """Counts over a batch of B episodes.

    Args:
        batch: B.
        subject: the victim.
        entropy: seed of the choice of steps, episodes and questions.
        rehearsed: whether the attack may rehearse (access `dynamics`).
    """

    def __init__(self, batch: int, subject: CountedPolicy, entropy: int, rehearsed: bool = False) -> None:
        self.subject, self.entropy, self.rehearsed = subject, entropy, rehearsed
        self.chance = random.Random(entropy)
        # Shadows and random numbers change nothing in the order of the questions.
        self.shadows, self.looks = random.Random(~entropy), random.Random(f"looks {entropy}")
        self.numbers = torch.Generator().manual_seed(self.looks.getrandbits(62))
        self.redrawn, self.same, self.probed = (np.zeros(batch) for _ in range(3))
        self.otherwise, self.compared = np.zeros(batch), np.zeros(batch)
        self.draws, self.drawn = np.zeros(batch), np.zeros(batch)
        self.shadow: Shadow | None = None
        self.random = False

    def due(self) -> bool:
        """Whether to probe the coming step."""
        return self.chance.random() < 1 / EVERY

    def driven(
        self,
        shown: Tensor,
        truth: Tensor,
        running: Tensor,
        state: State,
        asked: Sequence[tuple[Tensor | None, Tensor]] | None,
        rehearsal: tuple[int, Tensor | None] | None = None,
        numbers: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """The scores and actions of a step, as `CountedPolicy.driven`, and probes before or after it.

        Args:
            shown: the observation that the victim receives, [B, V, F].
            truth: the true observation, [B, V, F].
            running: bool [B].
            state: the victim's state.
            asked: the attack's queries of this step, as in `count_draws`; None if no probe is due.
            rehearsal: the copies and the episodes, by index among the running ones, of the attack's last rehearsal.
            numbers: for the draws of the step, int64 [B]; probes have their own.
        """
        due = asked is not None
        if due and self.shadow is None:
            self.shadow = self._begun(running, state, rehearsal)
        before = None
        first = self.shadows.random() < 0.5
        with self._unseen():
            if due and self.chance.random() < 0.5:
                before = self._ask(shown, running, state, len(asked or ()))
            if self.shadow and first:
                self.shadow.ask(shown)
        scores, action = self.subject.driven(shown, state, numbers)
        with self._unseen():
            if due:
                question, answer = before or self._ask(shown, running, state, len(asked or ()))
                if len(question.rows):
                    self._compare(shown, scores, action, question, answer, state)
            if self.shadow:
                if not first:
                    self.shadow.ask(shown)
                self._follow(self.shadow, shown, running, scores, action)
            if asked is not None and self._look(truth, running, state) and asked:
                self.count_draws(asked, running)
        return scores, action

    @contextmanager
    def _unseen(self) -> Iterator[None]:
        """Probe with the random numbers of the run, which are put back.

        An attack may draw between its queries: so does the probe, or not.
        """
        with self.subject.unseen():
            if not self.subject.shares:
                with self.subject.as_asked():
                    for draw in (torch.rand, np.random.random, lambda count: [random.random() for _ in range(count)]):
                        if self.looks.random() < 0.5:
                            draw(self.looks.randint(1, 64))
            yield

    def _begun(self, running: Tensor, state: State, rehearsal: tuple[int, Tensor | None] | None) -> Shadow | None:
        """A shadow that begins at this step; None for none."""
        rows = running.nonzero().squeeze(-1)
        share = SHADOWS_IF_REHEARSED if self.rehearsed else SHADOWS
        if self.shadows.random() >= share or not len(rows):
            return None
        steps = self.shadows.randint(1, SHORT)
        if self.rehearsed and self.shadows.random() < 0.5:
            steps = self.shadows.randint(SHORT, LONG)
        if self.random or state is None:
            # A random victim goes another way at once, and one without a state goes none.
            steps = min(steps, 2)
        if rehearsal and self.shadows.random() < 0.5:
            copies, chosen = rehearsal
            rows = rows if chosen is None else rows[chosen[chosen < len(rows)]]
        else:
            copies, rows = self.shadows.randint(1, MOST_COPIES), _some(rows, self.shadows)
        return Shadow(self.subject, self.shadows, state, rows, copies, steps) if len(rows) else None

    def _follow(self, shadow: Shadow, shown: Tensor, running: Tensor, scores: Tensor, action: Tensor) -> None:
        """Take a shadow one step on."""
        shadow.follow(shown, running, scores, action)
        if shadow.ended:
            self.end()

    def end(self) -> None:
        """Count the episodes of a shadow, which ends here."""
        shadow, self.shadow = self.shadow, None
        if shadow is None or not shadow.begun:
            return
        places = shadow.rows.numpy()
        self.compared[places] += 1
        with self._unseen():
            self.otherwise[places] += shadow.otherwise().numpy()

    def _ask(self, observation: Tensor, running: Tensor, state: State, asked: int) -> tuple[_Question, Tensor]:
        """Ask about some running episodes along one of the oracle's paths, after some as the attack `asked`, or none."""
        rows = running.nonzero().squeeze(-1)
        path = self.chance.choices(PATHS, PATH_WEIGHTS)[0]
        rows = _some(rows, self.chance, 1 if path == "one" else None)
        copies = {"many": self.chance.randint(2, MOST_COPIES), "chunks": CHUNK // max(len(rows), 1) + 2}.get(path, 1)
        place = self.chance.randrange(copies)
        noise = torch.Generator().manual_seed(self.chance.getrandbits(62))
        points = near(observation[rows], copies, place, NEAR, noise)
        earlier = self.looks.randint(0, asked)
        question = _Question(path, rows, place, points, repeated(rows_of(state, rows), torch.Size([copies])), earlier)
        return question, self._answer(question)

    def _answer(self, question: _Question) -> Tensor:
        """[R, A] the answer about the episodes in question."""
        if not len(question.rows):
            return question.points
        found: list[Tensor] = []

        def loss(scores: Tensor) -> Tensor:
            found.append(scores.detach())
            return scores.sum(-1)

        with self.subject.as_asked():
            for _ in range(question.earlier):
                self.subject.answered(question.points, question.state, fresh(len(question.points), self.numbers))
            numbers = fresh(len(question.points), self.numbers)
            if question.path == "gradient":
                self.subject.differentiated(question.points, question.state, loss, numbers)
            else:
                found.append(self.subject.answered(question.points, question.state, numbers))
        return found[0][question.place * len(question.rows) :][: len(question.rows)]

    def _compare(
        self, shown: Tensor, scores: Tensor, action: Tensor, question: _Question, answer: Tensor, state: State
    ) -> None:
        """Count the episodes that were answered otherwise than they were driven."""
        rows = question.rows
        driven, taken = scores[rows], action[rows]
        tolerance = ROUNDING * driven.abs().amax(-1).clamp(min=1e-3)
        other = _apart(answer, driven) > tolerance
        if bool(other.any()):
            # By turns, as in a run: a decoy may look at what was asked last.
            answers, again = [answer], [driven, self._once(shown, state)[rows]]
            for _ in range(REPEATS - 1):
                answers.append(self._answer(question))
                again.append(self._once(shown, state)[rows])
            other &= differ(answers, again, tolerance)
        if self.subject.action_type == "discrete":
            other |= driven.gather(-1, taken.unsqueeze(-1)).squeeze(-1) < driven.amax(-1)
        else:
            other |= (taken != driven).any(-1)
        places = rows.numpy()
        self.compared[places] += 1
        self.otherwise[places] += other.numpy()

    @torch.no_grad()
    def _look(self, observation: Tensor, running: Tensor, state: State) -> bool:
        """Probe the running episodes with others' observations; return whether an answer changed when asked again."""
        rows = running.nonzero().squeeze(-1)
        if len(rows) < 2:
            return False
        others = observation.clone()
        others[rows] = observation[rows].roll(len(rows) // 2, 0)
        first = self.subject.noticed(observation, state, fresh(len(observation), self.numbers))[rows]
        again, other = (self._once(points, state)[rows] for points in (observation, others))
        redrawn = (first != again).flatten(1).any(1)
        self.random = self.random or bool((_apart(first, again) > ROUNDING * first.abs().amax(-1)).any())
        same = ((first - other).abs() <= SAME).flatten(1).all(1)
        places = rows.numpy()
        self.probed[places] += 1
        self.redrawn[places] += redrawn.numpy()
        self.same[places] += same.numpy()
        return bool(redrawn.any())

    def _once(self, observation: Tensor, state: State) -> Tensor:
        return self.subject.driven(observation, state, fresh(len(observation), self.numbers))[0]

    def count_draws(self, asked: Sequence[tuple[Tensor | None, Tensor]], running: Tensor) -> None:
        """Count how often an attack queried each distinct observation in a step.

        Args:
            asked: the attack's queries: the episodes, by index among the running ones (None: all), and the observations
                [..., B, V, F].
            running: bool [B].
        """
        places = running.nonzero().squeeze(-1)
        keys = [_keys(rows, observation) for rows, observation in asked]
        if not keys:
            return
        all_keys = torch.cat(keys)
        asked_of = torch.bincount(all_keys[:, 0].long(), minlength=len(places))
        distinct = torch.bincount(all_keys.unique(dim=0)[:, 0].long(), minlength=len(places))
        queried = places[asked_of > 0].numpy()
        self.draws[queried] += (asked_of / distinct.clamp(min=1))[asked_of > 0].numpy()
        self.drawn[queried] += 1

    def columns(self) -> Mapping[str, NDArray[np.generic]]:
        """The probes of a record (`cavbench.records.schema.PROBES`), [B] each; shares are NaN if not measured."""
        with np.errstate(invalid="ignore"):
            return {
                "redrawn": self.redrawn / self.probed,
                "same_answer": self.same / self.probed,
                "draws": self.draws / self.drawn,
                "inconsistent": self.otherwise / self.compared,
                "entropy": np.full(len(self.probed), self.entropy, np.int64),
            }


def _some(rows: Tensor, chance: random.Random, count: int | None = None) -> Tensor:
    """Some of the rows, in any order: so many, or any number from 1."""
    order = list(range(len(rows)))
    chance.shuffle(order)
    return rows[order[: count or (chance.randint(1, len(order)) if order else 0)]]


def _apart(first: Tensor, second: Tensor) -> Tensor:
    """[R] largest difference between answers [R, A]."""
    return (first - second).abs().amax(-1)


def _keys(rows: Tensor | None, observation: Tensor) -> Tensor:
    """[N, 2] for each query: the episode, and a number that identifies the observation."""
    flat = observation.flatten(-2).double()
    code = flat @ torch.linspace(1, 2, flat.shape[-1], dtype=torch.float64).sin()
    episode = torch.arange(flat.shape[-2]) if rows is None else rows
    return torch.stack((episode.double().expand(code.shape), code), -1).flatten(0, -2)
