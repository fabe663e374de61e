"""Shadows: copies of running episodes that go the way of a rehearsal, in which the victim must answer as it drives.

A rehearsal (`cavbench.driving.access.Oracle.rehearse`) clones the victim's state, and advances many copies for many steps. A
victim that told this from driving could behave better, or worse, in a rehearsal than on the road. So a shadow clones the state
at a step that nobody can foresee, shows one of its copies what the victim is shown while it drives, shows others something near,
and compares the answers to that one copy with the scores that the victim drives by.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import torch
from torch import Tensor

from cavbench.driving.draws import fresh
from cavbench.driving.policy import State, repeated, rows_of
from cavbench.driving.victim import CountedPolicy

ROUNDING = 1e-3
"""Scores may differ by this share of their largest value between batches of different sizes."""
SPREAD = 4.0
"""An answer of a random victim is another one if it is this many times farther away than repeated answers are from each other."""
REPEATS = 4
"""How often an answer that differs is asked again: a victim that is random now and then must not look like a decoy."""
NEAR = 0.1
"""Width of the noise on what other copies are shown, on the normalised scale: about as far as a lie."""


@dataclass(frozen=True)
class _Moment:
    """A step of a shadow: what was driven, [B, ...], and what its copies were shown, [K * R, V, F]."""

    shown: Tensor
    running: Tensor
    scores: Tensor
    action: Tensor
    points: Tensor


class Shadow:
    """Copies of some episodes beside the driving; some go on step by step, others all their steps at once, at the end.

    Args:
        subject: the victim.
        chance: makes the choices that nobody can foresee.
        state: the victim's state of all B episodes at the first step.
        rows: int64 [R], the episodes.
        copies: K.
        steps: its length.
    """

    def __init__(
        self,
        subject: CountedPolicy,
        chance: random.Random,
        state: State,
        rows: Tensor,
        copies: int,
        steps: int,
    ) -> None:
        self.subject, self.rows, self.copies, self.steps = subject, rows, copies, steps
        place = chance.randrange(copies)
        self._own = slice(place * len(rows), (place + 1) * len(rows))
        self._place, self._at_once = place, chance.random() < 0.5
        self._noise = torch.Generator().manual_seed(chance.getrandbits(62))
        self._start = None if state is None else state.clone()
        self._state = self._cloned()
        self._moments: list[_Moment] = []
        self._asked: list[tuple[Tensor, Tensor | None]] = []

    @property
    def ended(self) -> bool:
        """Whether its last step was driven."""
        return len(self._moments) >= self.steps

    @property
    def begun(self) -> bool:
        """Whether a step of it was driven."""
        return bool(self._moments)

    def ask(self, shown: Tensor) -> None:
        """Show the copies the coming step, in which the victim is shown [B, V, F]; before or after it drives."""
        points = near(shown[self.rows], self.copies, self._place, NEAR, self._noise)
        scores = None if self._at_once else self._answered(points, self._state)
        self._asked.append((points, scores))

    def follow(self, shown: Tensor, running: Tensor, scores: Tensor, action: Tensor) -> None:
        """Take the step that was driven: what the victim was shown, its scores and its actions, and bool [B] who was running."""
        points, answered = self._asked[-1]
        moment = _Moment(shown.clone(), running, scores.clone(), action.clone(), points)
        self._moments.append(moment)
        if answered is not None:
            self._state = self._advanced(moment, answered, self._state)

    def otherwise(self) -> Tensor:
        """bool [R], the episodes that were answered otherwise than they were driven in some step."""
        known = [scores for _, scores in self._asked if scores is not None]
        answers = torch.stack([scores[self._own] for scores in known] if known else self._simulated(len(self._moments)))
        driven = torch.stack([moment.scores[self.rows] for moment in self._moments])
        running = torch.stack([moment.running[self.rows] for moment in self._moments])
        tolerance = ROUNDING * driven.abs().amax(-1).clamp(min=1e-3)
        apart = (_apart(answers, driven) > tolerance) & running
        if not bool(apart.any()):
            return apart.any(0)
        # What differs first is asked again: a random victim goes other ways from there on.
        step = int(apart.any(1).nonzero()[0])
        others, again = [answers[step]], [driven[step], self._driven_again(step + 1)]
        for _ in range(REPEATS - 1):
            others.append(self._simulated(step + 1)[step])
            again.append(self._driven_again(step + 1))
        return apart[step] & differ(others, again, tolerance[step])

    def _simulated(self, steps: int) -> list[Tensor]:
        """[R, A] for each of the first steps: the answers to the copies that are shown what was driven, as in a rehearsal."""
        state, found = self._cloned(), []
        for moment in self._moments[:steps]:
            scores = self._answered(moment.points, state)
            found.append(scores[self._own])
            state = self._advanced(moment, scores, state)
        return found

    def _driven_again(self, steps: int) -> Tensor:
        """[R, A] the scores of the last of the first steps, driven again in the batch of all episodes."""
        state = None if self._start is None else self._start.clone()
        for moment in self._moments[: steps - 1]:
            self.subject.driven(moment.shown, state, self._numbers(moment.shown))
            state = self.subject.advance(moment.shown, moment.action, state)
        last = self._moments[steps - 1].shown
        return self.subject.driven(last, state, self._numbers(last))[0][self.rows]

    def _answered(self, points: Tensor, state: State) -> Tensor:
        with self.subject.as_asked():
            return self.subject.answered(points, state, self._numbers(points))

    def _numbers(self, points: Tensor) -> Tensor:
        return fresh(len(points), self._noise)

    def _advanced(self, moment: _Moment, scores: Tensor, state: State) -> State:
        """The copies' state after a step: each took what was answered, those that are shown what was driven what was driven."""
        with self.subject.as_asked():
            action = self.subject.choose(scores).clone()
            action[self._own] = moment.action[self.rows]
            return self.subject.advance(moment.points, action, state)

    def _cloned(self) -> State:
        state = repeated(rows_of(self._start, self.rows), torch.Size([self.copies]))
        return None if state is None else state.clone()


def near(points: Tensor, copies: int, place: int, width: float, generator: torch.Generator) -> Tensor:
    """[K * R, V, F] copies of the observations [R, V, F] with noise on all measured values, but for the copy `place`."""
    noise = torch.rand((copies, *points.shape), generator=generator)
    found = points + width * (noise.to(points) - 0.5) * (points[..., :1] > 0)
    found[..., 0] = points[..., 0]
    found[place] = points
    return found.flatten(0, 1)


def differ(answers: Sequence[Tensor], again: Sequence[Tensor], tolerance: Tensor) -> Tensor:
    """bool [R], whether all answers [R, A] are farther from each driven one [R, A] than these are from each other."""
    spread = torch.stack([_apart(*two) for two in combinations(again, 2)]).amax(0)
    nearest = [torch.stack([_apart(one, each) for each in again]).amin(0) for one in answers]
    return (torch.stack(nearest) > tolerance + SPREAD * spread).all(0)


def _apart(first: Tensor, second: Tensor) -> Tensor:
    """[...] largest difference between answers [..., A]."""
    return (first - second).abs().amax(-1)
