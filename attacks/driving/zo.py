"""ZO-SignSGD: the black-box attack of the thesis (Algorithm 4), batched over episodes and directions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from cavbench.attacks.driving.objectives import ContinuousLoss, DiscreteLoss, Loss, distortion, without_brake
from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, Natural, NotNegative, Positive
from cavbench.driving import DrivingAttack, Part, parts_of

if TYPE_CHECKING:
    from cavbench.driving import DrivingWorld, Oracle

ZOObjective = Literal["collision", "expected", "margin", "target", "thesis"]


@dataclass(frozen=True, kw_only=True)
class ZOSignSGD(DrivingAttack):
    """ZO-SignSGD (Liu, Chen, Chen and Hong 2019, "signSGD via Zeroth-Order Oracle"; thesis Algorithm 4, Eq. 4.7 to 4.10).

    Black box, access `scores`. Each of T iterations queries the loss at x and at q random points x + mu u in one batch,
    estimates the gradient from the differences, takes a step along its sign, and projects onto the perturbation set. It returns
    the best queried point, which needs no extra query. All episodes share the random directions of a step, so the result for
    one does not depend on the rest of the batch.

    Distance: L-inf in shares of the threat model's radius, for each feature.

    Args:
        steps: iterations T, at least 1 (default 4).
        directions: random directions q, at least 1 (default 10).
        smoothing: mu, length of a probe as a share of the radius, in (0, 2] (default 1).
        step_size: delta as a share of the radius, in (0, 2] (default 1).
        objective: the loss to minimise (default `collision`); in brackets, for a continuous victim. `expected`: expected clean
            Q-value under the attacked policy. `collision`: the same, but braking counts as the best action. `margin`: lead of
            the clean action over the best other one (negative distance from the clean action). `target`: lead of the best other
            action over the target (distance to the target). `thesis`: Eq. 4.10, |Q(target) - Q(greedy)| (distance to the
            target) plus the distortion. For a continuous victim `collision` and `expected` are the same as `target`, because a
            black-box attack cannot read its critic.
        temperature: temperature of the expectation, as a share of the spread of the clean Q-values, above 0 (default 0.5).
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        braking_action: index of the braking action for `collision`, at least 0 (default 4, SLOWER).
        tolerance: a continuous action within this distance of the target has reached it, at least 0 (default 0.1).
        distortion_weight: weight of Eq. 4.9 relative to Eq. 4.7, 1 / a; only for `thesis`, at least 0 (default 1).
        early_stop: stop querying for an episode in this step once its goal is met (default true).
        enough: goal of `expected` and `collision`: the greedy action loses this share of the range from best to worst action,
            in (0, 1] (default 1: it is the worst action).
        random_start: start at a random point of the set, with one more query (default false).
        draw: number of the random draw: another number is the same attack with other random directions.

    Shapes: observation [B, V, F] in, the same out. Queries per step: at most T (q + 1), one more with a random start; never
    more than the threat model allows.

    Example:
        >>> from cavbench.attacks.driving.zo import ZOSignSGD
        >>> thesis = ZOSignSGD(objective="thesis", steps=100, directions=20)
    """

    access: ClassVar[Access] = "scores"
    joint: ClassVar[bool] = True

    steps: Count = 4
    directions: Count = 10
    smoothing: Annotated[float, Interval(gt=0, le=2)] = 1.0
    step_size: Annotated[float, Interval(gt=0, le=2)] = 1.0
    objective: ZOObjective = "collision"
    temperature: Positive = 0.5
    target_action: Natural = 3
    target_acceleration: Annotated[float, Interval(ge=-1, le=1)] = 1.0
    target_steering: Annotated[float, Interval(ge=-1, le=1)] = 0.5
    braking_action: Natural = 4
    tolerance: NotNegative = 0.1
    distortion_weight: NotNegative = 1.0
    early_stop: bool = True
    enough: Annotated[float, Interval(gt=0, le=1)] = 1.0
    random_start: bool = False
    draw: Natural = 0

    def lacks(self, world: DrivingWorld) -> str:
        return without_brake(self.objective, self.braking_action, world) or super().lacks(world)

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if not len(observation) or (left := int(oracle.remaining.min())) < 1:
            return observation
        parts = [Part(part.rows, _generator(part.generator)) for part in oracle.parts]
        shape = observation.shape[1:]
        clean, left = oracle.scores(observation), left - 1
        loss = self._loss(clean, oracle)
        _, lowest, met = self._judge(loss, clean, observation, observation)
        x = observation
        if self.random_start:
            share = torch.cat([torch.rand(shape, generator=part.generator).expand_as(x[part.rows]) for part in parts])
            x = oracle.project(x + oracle.radius * (2 * share - 1))
        run = _Run(torch.arange(len(observation)), oracle, x, observation, lowest, loss, parts)
        answer = observation.clone()
        if self.early_stop:
            run = run.without(met, answer)
        known: Tensor | None = None if self.random_start else clean[run.rows]
        for _ in range(self.steps):
            # The scores on the true observation are known and need no second query.
            base = 1 if known is None else 0
            count = min(self.directions, left - base) if len(run.rows) else 0
            if count < 1:
                break
            directions = _directions(count, shape, [part.generator for part in run.parts]).to(observation)
            left -= base + count
            points = run.oracle.project(run.around(directions, self.smoothing))
            scores = run.oracle.scores(points[1 - base :])
            scores, known = scores if known is None else torch.cat((known.unsqueeze(0), scores)), None
            value, key, met = self._judge(run.loss, scores, points, run.oracle.observation)
            run.keep_best(points, key)
            sign = _gradient(value, directions, run.parts).sign_()
            step = self.step_size * run.oracle.radius
            run.x = run.oracle.project(torch.addcmul(run.x, step, sign, value=-1))
            if self.early_stop:
                run = run.without(met.any(0), answer)
        answer[run.rows] = run.best
        return answer

    def _loss(self, clean: Tensor, oracle: Oracle) -> Loss:
        """The objective on this step's clean scores."""
        if oracle.action_type == "continuous":
            target = None if self.objective == "margin" else (self.target_acceleration, self.target_steering)
            return ContinuousLoss(clean=clean, target=target, tolerance=self.tolerance)
        return DiscreteLoss(
            objective="target" if self.objective == "thesis" else self.objective,
            clean=clean,
            temperature=self.temperature,
            target_action=self.target_action,
            braking_action=self.braking_action,
            enough=self.enough,
        )

    def _judge(self, loss: Loss, scores: Tensor, points: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The loss of every queried point, the key to choose the best, and whether the goal is met, [..., B] each."""
        value, key, met = loss.judge(scores)
        if self.objective != "thesis":
            return value, key, met
        # Eq. 4.10. Points that reach the target come first, ordered by distortion.
        size = distortion(points, truth)
        value = value.clamp(min=0) + self.distortion_weight * size
        return value, torch.where(met, -1 / (1 + size), value), met


@dataclass
class _Run:
    """The R episodes that still make queries in this step.

    Args:
        rows: int64 [R] their places in the batch.
        oracle: access to the victim in these episodes.
        x, best: [R, V, F] current point, and best point so far.
        lowest: [R] key of the best point.
        loss: the objective.
        parts: the units of these episodes, with the generator of each unit for this step.
    """

    rows: Tensor
    oracle: Oracle
    x: Tensor
    best: Tensor
    lowest: Tensor
    loss: Loss
    parts: Sequence[Part]

    def around(self, directions: Tensor, smoothing: float) -> Tensor:
        """[q + 1, R, V, F] the current points, and the points along the directions [P, q, V, F] of the parts."""
        reach, points = smoothing * self.oracle.radius, self.x.new_empty(directions.shape[1] + 1, *self.x.shape)
        points[0] = self.x
        for part, own in zip(self.parts, directions, strict=True):
            torch.addcmul(self.x[part.rows], reach[part.rows], own.unsqueeze(1), out=points[1:, part.rows])
        return points

    def keep_best(self, points: Tensor, key: Tensor) -> None:
        """Compare queried points [q + 1, R, V, F] by their keys [q + 1, R]."""
        smallest, at = key.min(0)
        improved = smallest < self.lowest
        self.lowest = torch.where(improved, smallest, self.lowest)
        self.best = torch.where(improved[:, None, None], points[at, torch.arange(len(at))], self.best)

    def without(self, met: Tensor, answer: Tensor) -> _Run:
        """The run without the episodes whose goal is met, bool [R]; their best points are written to `answer` [B, V, F]."""
        if not bool(met.any()):
            return self
        answer[self.rows] = self.best
        on = (~met).nonzero().squeeze(-1)
        loss, parts = self.loss.of(on), parts_of(self.parts, on)
        return _Run(self.rows[on], self.oracle.select(on), self.x[on], self.best[on], self.lowest[on], loss, parts)


def _gradient(value: Tensor, directions: Tensor, parts: Sequence[Part]) -> Tensor:
    """Gradient estimate [R, V, F] up to a positive factor, from the losses [q + 1, R] at x and along the directions of the parts.

    It uses differences to the mean loss instead of the loss at x, which have the same expectation and less variance.

    Args:
        value: the losses.
        directions: [P, q, V, F].
        parts: P units of episodes.
    """
    slopes = []
    for part, along in zip(parts, directions.flatten(2), strict=True):
        # The last bit of a mean may depend on the layout in memory: it is that of a unit that is driven alone.
        own = value[:, part.rows].contiguous()
        slopes.append((own[1:] - own.mean(0)).T @ along)
    return torch.cat(slopes).view(-1, *directions.shape[2:])


def _generator(of_run: torch.Generator) -> torch.Generator:
    """A generator for this step, seeded by one draw from the run's, whatever the number of iterations."""
    seed = torch.randint(2**62, (1,), generator=of_run)
    return torch.Generator().manual_seed(int(seed))


@cache
def _hadamard(order: int) -> Tensor:
    """[order, order] Sylvester's Hadamard matrix: signs with orthogonal rows; `order` is a power of two."""
    matrix = torch.ones(1, 1)
    while len(matrix) < order:
        matrix = torch.cat((torch.cat((matrix, matrix), 1), torch.cat((matrix, -matrix), 1)))
    return matrix


def _directions(count: int, shape: torch.Size, generators: Sequence[torch.Generator]) -> Tensor:
    """[P, q, V, F] nearly orthogonal random signs for each generator: random rows and columns of a Hadamard matrix.

    Orthogonal directions estimate a gradient with less variance than independent ones (Choromanski et al. 2018, "Structured
    Evolution with Compact Architectures"). The entry of `presence` is 0, because it cannot be changed.
    """
    vehicles, features = shape[0], shape[1] - 1
    size = vehicles * features
    order = 1 << (max(count, size) - 1).bit_length()
    drawn = [
        (
            torch.randperm(order, generator=generator)[:count],
            torch.randperm(order, generator=generator)[:size],
            torch.randint(0, 2, (size,), generator=generator),
        )
        for generator in generators
    ]
    rows, columns, flips = map(torch.stack, zip(*drawn, strict=True))
    signs = _hadamard(order)[rows.unsqueeze(2), columns.unsqueeze(1)] * (flips * 2.0 - 1.0).unsqueeze(1)
    directions = torch.zeros(len(drawn), count, *shape)
    directions[..., 1:] = signs.view(len(drawn), count, vehicles, features)
    return directions
