"""ZO-SignSGD: the black-box attack of the thesis (Algorithm 4), batched over episodes and directions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, ClassVar, Literal, get_args

import torch
from torch import Tensor

from attacks.objectives import Loss, distortion
from bench.contracts import Access, Attack

if TYPE_CHECKING:
    from bench.threat import Oracle

ZOObjective = Literal["expected", "margin", "target", "thesis"]


@dataclass(frozen=True, kw_only=True)
class ZOSignSGD(Attack):
    """ZO-SignSGD (Liu, Chen, Chen and Hong 2019, "signSGD via Zeroth-Order Oracle"; Algorithm 4, Eq. 4.7 to 4.10 of the thesis).

    Black box, access `scores`. Each of T iterations asks for the loss at x and at q random points x + mu u around it, in one
    batch, estimates the gradient from the differences and steps by its sign, projected onto the perturbation set. The best
    point ever asked is shown, at no extra query. All episodes share the random directions of a step, so what happens to one
    does not depend on which others are in the batch.

    Distance: L-inf in shares of the threat model's radius, feature by feature.

    Args:
        steps: iterations T, at least 1.
        directions: random directions q, at least 1.
        smoothing: mu, root mean square length of a probe as a share of the radius, in (0, 2].
        step_size: delta as a share of the radius, in (0, 2].
        objective: what is minimised (default `expected`): `expected` the clean Q expected under the attacked policy;
            `margin` the lead of the clean action (minus the distance from it); `target` the lead over the target action (the
            distance to it); `thesis` Eq. 4.10: |Q(target) - Q(greedy)| (the distance to the target) plus the distortion. For
            a continuous victim, whose critic a black-box attacker cannot read, `expected` is `target`.
        temperature: of `expected`, as a share of the spread of the clean Q-values, above 0.
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        tolerance: a continuous action within this distance of the target has reached it, at least 0 (default 0.1).
        distortion_weight: weight of Eq. 4.9 beside Eq. 4.7, that is 1 / a; read by `thesis` only, at least 0 (default 1).
        early_stop: an episode whose goal is met asks no more queries in this step (default true).
        enough: the goal of `expected`: the greedy action gives up this share of what the clean Q-values leave to lose, in
            (0, 1] (default 1: it is the worst action).
        random_start: begin at a random point of the set, for one query more (default false).

    Shapes: observation [B, V, F] in, the same out. Queries a step: at most T (q + 1), never more than the threat model allows.

    Example:
        >>> from attacks.zo import ZOSignSGD
        >>> thesis = ZOSignSGD(objective="thesis", steps=100, directions=20)
    """

    access: ClassVar[Access] = "scores"

    steps: int = 5
    directions: int = 20
    smoothing: float = 1.0
    step_size: float = 1.0
    objective: ZOObjective = "expected"
    temperature: float = 0.5
    target_action: int = 3
    target_acceleration: float = 1.0
    target_steering: float = 0.5
    tolerance: float = 0.1
    distortion_weight: float = 1.0
    early_stop: bool = True
    enough: float = 1.0
    random_start: bool = False

    def __post_init__(self) -> None:
        for name in ("steps", "directions"):
            if getattr(self, name) < 1:
                raise ValueError(f"zo.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("smoothing", "step_size"):
            if not 0 < getattr(self, name) <= 2:
                raise ValueError(f"zo.{name} must be in (0, 2], got {getattr(self, name)}")
        if self.objective not in get_args(ZOObjective):
            raise ValueError(f"zo.objective must be one of {', '.join(get_args(ZOObjective))}, got {self.objective!r}")
        if not self.temperature > 0:
            raise ValueError(f"zo.temperature must be above 0, got {self.temperature}")
        if self.target_action < 0:
            raise ValueError(f"zo.target_action must be at least 0, got {self.target_action}")
        for name in ("target_acceleration", "target_steering"):
            if not -1 <= getattr(self, name) <= 1:
                raise ValueError(f"zo.{name} must be in [-1, 1], got {getattr(self, name)}")
        for name in ("tolerance", "distortion_weight"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"zo.{name} must be at least 0, got {getattr(self, name)}")
        if not 0 < self.enough <= 1:
            raise ValueError(f"zo.enough must be in (0, 1], got {self.enough}")

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        generator = _generator(oracle)
        shape = observation.shape[1:]
        rows = torch.arange(observation.shape[0])
        best, lowest = observation.clone(), torch.full((len(rows),), torch.inf)
        x, loss = observation, None
        if self.random_start and int(oracle.remaining.min()) > 0:
            loss = self._loss(oracle.scores(observation), oracle)
            x = oracle.project(observation + oracle.radius * (2 * torch.rand(shape, generator=generator) - 1))
        for _ in range(self.steps):
            count = min(self.directions, int(oracle.remaining[rows].min()) - 1) if len(rows) else 0
            if count < 1:
                break
            directions = _directions(count, shape, generator).unsqueeze(1)
            probes = oracle.project(x + self.smoothing * oracle.radius[rows] * directions, rows)
            points = torch.cat((x.unsqueeze(0), probes))
            scores = oracle.scores(points, rows)
            loss = self._loss(scores[0], oracle) if loss is None else loss
            value, key = self._value(loss, scores, points, oracle.observation[rows])
            found, at = key.min(0)
            improved = found < lowest[rows]
            lowest[rows] = torch.where(improved, found, lowest[rows])
            best[rows[improved]] = points[at, torch.arange(len(rows))][improved]
            estimate = torch.einsum("qb,qvf->bvf", value[1:] - value[1:].mean(0), directions.squeeze(1))
            x = oracle.project(x - self.step_size * oracle.radius[rows] * estimate.sign(), rows)
            if self.early_stop:
                running = ~loss.met(scores).any(0)
                rows, x, loss = rows[running], x[running], loss.of(running)
        return best

    def _loss(self, clean: Tensor, oracle: Oracle) -> Loss:
        """The objective on this step's clean scores."""
        continuous = oracle.action_type == "continuous"
        aimed = self.objective == "thesis" or (continuous and self.objective == "expected")
        return Loss(
            objective="target" if aimed else self.objective,  # type: ignore[arg-type]
            action_type=oracle.action_type,
            clean=clean,
            temperature=self.temperature,
            target=(self.target_acceleration, self.target_steering) if continuous else self.target_action,
            tolerance=self.tolerance,
            enough=self.enough,
        )

    def _value(self, loss: Loss, scores: Tensor, points: Tensor, observation: Tensor) -> tuple[Tensor, Tensor]:
        """The loss of every point asked, and what the best is chosen by, both [q + 1, B]; Eq. 4.10 for `thesis`."""
        if self.objective != "thesis":
            return loss(scores), loss.key(scores)
        value = loss(scores).clamp(min=0) + self.distortion_weight * distortion(points, observation)
        return value, value


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
