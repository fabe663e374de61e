"""ZO-SignSGD: the black-box attack of the thesis (Algorithm 4), batched over episodes and directions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import torch
from annotated_types import Interval
from torch import Tensor

from attacks.objectives import ContinuousLoss, DiscreteLoss, Loss, distortion
from bench.driving import DrivingAttack
from bench.plugins.contracts import Access
from bench.plugins.ranges import Count, Natural, NotNegative, Positive

if TYPE_CHECKING:
    from bench.driving import Oracle

ZOObjective = Literal["collision", "expected", "margin", "target", "thesis"]


@dataclass(frozen=True, kw_only=True)
class ZOSignSGD(DrivingAttack):
    """ZO-SignSGD (Liu, Chen, Chen and Hong 2019, "signSGD via Zeroth-Order Oracle"; thesis Algorithm 4, Eq. 4.7 to 4.10).

    Black box, access `scores`. Each of T iterations asks for the loss at x and at q random points x + mu u around it, in
    one batch, estimates the gradient from the differences and steps by its sign, projected onto the perturbation set. The
    best point ever asked is shown, at no extra query. All episodes share the random directions of a step, so what happens
    to one does not depend on the rest of the batch.

    Distance: L-inf in shares of the threat model's radius, feature by feature.

    Args:
        steps: iterations T, at least 1 (default 4).
        directions: random directions q, at least 1 (default 10).
        smoothing: mu, length of a probe as a share of the radius, in (0, 2] (default 1).
        step_size: delta as a share of the radius, in (0, 2] (default 1).
        objective: what is minimised (default `collision`). `expected`: the clean Q expected under the attacked policy.
            `collision`: the same, but braking counts as the best action. `margin`: the lead of the clean action (minus the
            distance from it). `target`: the lead over the target action (the distance to it). `thesis`: Eq. 4.10,
            |Q(target) - Q(greedy)| (the distance to the target) plus the distortion. For a continuous victim, whose critic
            a black-box attacker cannot read, `collision` and `expected` are `target`.
        temperature: of the expectation, as a share of the spread of the clean Q-values, above 0 (default 0.5).
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        braking_action: what `collision` spares, at least 0 (default 4, SLOWER).
        tolerance: a continuous action within this distance of the target has reached it, at least 0 (default 0.1).
        distortion_weight: weight of Eq. 4.9 beside Eq. 4.7, that is 1 / a; read by `thesis`, at least 0 (default 1).
        early_stop: an episode whose goal is met asks no more queries in this step (default true).
        enough: the goal of an expectation: the greedy action gives up this share of what there is to lose, in (0, 1]
            (default 1: it is the worst action).
        random_start: begin at a random point of the set, for one query more (default false).

    Shapes: observation [B, V, F] in, the same out. Queries a step: at most T (q + 1), and one more with a random start; never
    more than the threat model allows.

    Example:
        >>> from attacks.zo import ZOSignSGD
        >>> thesis = ZOSignSGD(objective="thesis", steps=100, directions=20)
    """

    access: ClassVar[Access] = "scores"

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

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if not len(observation) or int(oracle.remaining.min()) < 1:
            return observation
        generator = _generator(oracle)
        shape = observation.shape[1:]
        clean = oracle.scores(observation)
        loss = self._loss(clean, oracle)
        best, lowest = observation.clone(), self._value(loss, clean, observation, observation)[1]
        rows, x = torch.arange(len(observation)), observation
        if self.random_start:
            x = oracle.project(x + oracle.radius * (2 * torch.rand(shape, generator=generator) - 1))
        if self.early_stop:
            rows, x, loss = _running(~loss.met(clean), rows, x, loss)
        known: Tensor | None = None if self.random_start else clean[rows]
        for _ in range(self.steps):
            # The victim's scores on the true observation are known: it is not asked a second time.
            base = 1 if known is None else 0
            count = min(self.directions, int(oracle.remaining[rows].min()) - base) if len(rows) else 0
            if count < 1:
                break
            directions = _directions(count, shape, generator).to(observation)
            probes = oracle.project(x + self.smoothing * oracle.radius[rows] * directions.unsqueeze(1), rows)
            points = torch.cat((x.unsqueeze(0), probes))
            scores = oracle.scores(points[1 - base :], rows)
            scores, known = scores if known is None else torch.cat((known.unsqueeze(0), scores)), None
            value, key = self._value(loss, scores, points, observation[rows])
            found, at = key.min(0)
            improved = found < lowest[rows]
            lowest[rows] = torch.where(improved, found, lowest[rows])
            best[rows[improved]] = points[at, torch.arange(len(rows))][improved]
            estimate = _gradient(value, directions)
            x = oracle.project(x - self.step_size * oracle.radius[rows] * estimate.sign(), rows)
            if self.early_stop:
                rows, x, loss = _running(~loss.met(scores).any(0), rows, x, loss)
        return best

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

    def _value(self, loss: Loss, scores: Tensor, points: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of every point asked, and what the best is chosen by, both [..., B]; Eq. 4.10 for `thesis`."""
        if self.objective != "thesis":
            value = loss(scores)
            return value, loss.key(scores, value)
        size = distortion(points, observation)
        value = loss(scores).clamp(min=0) + self.distortion_weight * size
        # What hits the target comes before all that does not, the least distorted first.
        return value, torch.where(loss.met(scores), -1 / (1 + size), value)


def _running(keep: Tensor, rows: Tensor, x: Tensor, loss: Loss) -> tuple[Tensor, Tensor, Loss]:
    """Only the episodes whose goal is not met yet; the others ask nothing more."""
    return (rows, x, loss) if bool(keep.all()) else (rows[keep], x[keep], loss.of(keep))


def _gradient(value: Tensor, directions: Tensor) -> Tensor:
    """[B, V, F] up to a positive factor, from the losses [q + 1, B] at x and at the probes along `directions` [q, V, F].

    The differences are taken to the mean of the losses instead of the one at x: the same expectation, less variance.
    """
    return torch.einsum("qb,qvf->bvf", value[1:] - value.mean(0), directions)


def _generator(oracle: Oracle) -> torch.Generator:
    """This step's own generator: one draw from the run's, however many iterations the step will take."""
    seed = torch.randint(2**62, (1,), generator=oracle.generator)
    return torch.Generator().manual_seed(int(seed))


@cache
def _hadamard(order: int) -> Tensor:
    """[order, order] Sylvester's matrix of signs with orthogonal rows; `order` is a power of two."""
    matrix = torch.ones(1, 1)
    while len(matrix) < order:
        matrix = torch.cat((torch.cat((matrix, matrix), 1), torch.cat((matrix, -matrix), 1)))
    return matrix


def _directions(count: int, shape: torch.Size, generator: torch.Generator) -> Tensor:
    """[q, V, F] random signs, nearly orthogonal to each other: rows and columns drawn from a Hadamard matrix.

    Orthogonal directions estimate a gradient with less variance than independent ones (Choromanski et al. 2018, "Structured
    Evolution with Compact Architectures"). `presence` gets 0: no budget moves it.
    """
    vehicles, features = shape[0], shape[1] - 1
    order = 1 << (max(count, vehicles * features) - 1).bit_length()
    rows = torch.randperm(order, generator=generator)[:count]
    columns = torch.randperm(order, generator=generator)[: vehicles * features]
    flips = torch.randint(0, 2, (vehicles * features,), generator=generator) * 2.0 - 1.0
    signs = (_hadamard(order)[rows][:, columns] * flips).reshape(count, vehicles, features)
    return torch.cat((torch.zeros(count, vehicles, 1), signs), -1)
