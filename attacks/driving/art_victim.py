"""The victim as an estimator of the Adversarial Robustness Toolbox: a classifier of points in a box, behind the oracle."""

from __future__ import annotations

import logging
import random
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from art.estimators.classification.classifier import ClassGradientsMixin, ClassifierMixin
from art.estimators.estimator import BaseEstimator, LossGradientsMixin, NeuralNetworkMixin
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from cavbench.attacks.driving.objectives import margin

if TYPE_CHECKING:
    from cavbench.driving import Oracle

logging.getLogger("art").setLevel(logging.ERROR)
"""ART logs a warning for every unsuccessful attack, here for every step and episode."""

Array = NDArray[np.float32]
Value = Callable[[Tensor, Tensor], Tensor]
"""(scores [N, C], classes [N]) -> values [N], differentiable in the scores."""


class OverError(Exception):
    """No episode may make another query."""


class Search:
    """The queries of one step for some episodes, and the best point of each episode.

    A point z of the box [-1, 1]^n stands for the observation truth + radius * z. Answers are cached. An episode is over (makes no
    more queries) once its goal is met or its next queries would exceed the budget.

    Args:
        oracle: access to the victim in the n episodes.
        clean: the victim's scores on the true observations [n, C], or its decisions [n] for a decision-based attack.
        target: the target action; None for any action other than the clean one.
    """

    def __init__(self, oracle: Oracle, clean: Tensor, target: int | None) -> None:
        self._oracle, self._targeted = oracle, target is not None
        self._truth, self._radius = oracle.observation, oracle.radius
        decision = clean if clean.ndim == 1 else clean.argmax(-1)
        wanted = decision if target is None else torch.full_like(decision, target)
        # A decision is class 1 if it is the wanted action, else class 0. Class 2 is never used: some of ART's attacks need at
        # least three classes.
        self._action = wanted if clean.ndim == 1 else None
        self.labels = wanted if self._action is None else torch.ones_like(wanted)
        scores = clean if self._action is None else _classified(clean == wanted)
        self.classes, self.best = scores.shape[-1], self._truth.clone()
        self._lead = self._leads(scores, self.labels).tolist()
        self._running = [lead >= 0 for lead in self._lead]
        self._known: dict[object, Array] = {}
        self._keep(self._keys(range(len(clean)), self.origin(), [""] * len(clean)), scores)

    @property
    def over(self) -> bool:
        """Whether every episode is over."""
        return not any(self._running)

    def origin(self) -> Array:
        """The true observations as images [n, 1, V + 1, F]: one row per car, one column per measured value.

        The last row and column are blank, because the squares of ART's SquareAttack never reach them.
        """
        count, rows, features = self._truth.shape
        return np.zeros((count, 1, rows + 1, features), np.float32)

    def scores(self, points: Array) -> Array:
        """The victim's scores [N, C] at points [N, 1, V + 1, F]; for an episode that is over, scores of a successful attack."""
        places = self._places(len(points))

        def ask(fresh: list[int]) -> Tensor:
            at = torch.tensor([places[n] for n in fresh])
            oracle = self._oracle.select(at)
            shown = _shown(points[fresh], oracle)
            if self._action is None:
                scores = oracle.scores(shown)
            else:
                scores = _classified(oracle.decide(shown) == self._action[at])
            self._judge(shown, scores, at)
            return scores

        answers = self._look_up(places, self._keys(places, points, [""] * len(points)), ask)
        done = functional.one_hot(self.labels, self.classes).float().numpy() * (1 if self._targeted else -1)
        return np.stack([done[at] if one is None else one for at, one in zip(places, answers, strict=True)])

    def gradients(self, points: Array, value: Value, labels: Tensor) -> Array:
        """The gradients of value(scores, labels [N]) at points [N, 1, V + 1, F], same shape; 0 for an episode that is over."""
        places = self._places(len(points))

        def ask(fresh: list[int]) -> Tensor:
            at = torch.tensor([places[n] for n in fresh])
            oracle, answered = self._oracle.select(at), []
            shown = _shown(points[fresh], oracle)

            def taken(scores: Tensor) -> Tensor:
                answered.append(scores.detach())
                return value(scores, labels[fresh])

            _, gradient = oracle.gradient(shown, taken)
            self._keep(self._keys(at.tolist(), points[fresh], [""] * len(fresh)), answered[0])
            self._judge(shown, answered[0], at)
            return functional.pad((gradient * oracle.radius)[..., 1:], (0, 1, 0, 1)).unsqueeze(1)

        asked = [f"{value.__name__} {label}" for label in labels.tolist()]
        answers = self._look_up(places, self._keys(places, points, asked), ask)
        return np.stack([np.zeros_like(points[0]) if one is None else one for one in answers])

    def _look_up(
        self, places: Sequence[int], keys: Sequence[object], ask: Callable[[list[int]], Tensor]
    ) -> list[Array | None]:
        """The answers for the keys, with new queries for unknown ones; None for an episode that is over.

        Raises:
            OverError: if all episodes are over.
        """
        if unknown := [n for n, key in enumerate(keys) if self._running[places[n]] and key not in self._known]:
            left = self._oracle.remaining.tolist()
            for place, wanted in Counter(places[n] for n in unknown).items():
                self._running[place] = wanted <= left[place]
            if fresh := [n for n in unknown if self._running[places[n]]]:
                self._keep([keys[n] for n in fresh], ask(fresh))
        if self.over:
            raise OverError
        return [self._known[key] if self._running[at] else None for at, key in zip(places, keys, strict=True)]

    def _places(self, count: int) -> Sequence[int]:
        """The episode of each of `count` points: all of a single episode, one of every episode, or one of every running one."""
        everyone = range(len(self._truth))
        if len(everyone) == 1:
            return [0] * count
        return everyone if count == len(everyone) else [at for at in everyone if self._running[at]]

    def _keys(self, places: Sequence[int], points: Array, asked: Sequence[str]) -> list[object]:
        """The cache keys: episode, kind of query and point."""
        return [(at, what, point.tobytes()) for at, what, point in zip(places, asked, points, strict=True)]

    def _keep(self, keys: Sequence[object], answers: Tensor) -> None:
        self._known.update(zip(keys, answers.float().numpy(), strict=True))

    def _leads(self, scores: Tensor, labels: Tensor) -> Tensor:
        """Distance to the goal [N] in scores [N, C]; the goal is met below 0."""
        return -margin(scores, labels) if self._targeted else margin(scores, labels)

    def _judge(self, shown: Tensor, scores: Tensor, at: Tensor) -> None:
        """Keep the best queried points."""
        for n, (place, lead) in enumerate(zip(at.tolist(), self._leads(scores, self.labels[at]).tolist(), strict=True)):
            if lead < self._lead[place]:
                self._lead[place], self.best[place] = lead, shown[n]
                self._running[place] = lead >= 0


class Classifier(ClassGradientsMixin, ClassifierMixin, LossGradientsMixin, NeuralNetworkMixin, BaseEstimator):
    """An ART estimator that gets its answers from a search.

    Its loss is the lead of the best other action over the label's action. Cross-entropy would depend on the scale of the
    Q-values, which are not logits.

    Args:
        shape: shape of a point.
        classes: C, number of classes.
    """

    def __init__(self, shape: Sequence[int] = (1, 5, 5), classes: int = 2) -> None:
        super().__init__(model=None, clip_values=(-1.0, 1.0), channels_first=True, preprocessing=None)
        self.nb_classes, self._shape = classes, tuple(shape)
        self.search: Search | None = None
        """If None (ART tests an estimator first), every score is 0 and costs no query."""

    @property
    def input_shape(self) -> tuple[int, ...]:
        return self._shape

    def predict(self, x: Array, batch_size: int = 128, **kwargs: Any) -> Array:
        if self.search is None:
            return np.zeros((len(x), self.nb_classes), np.float32)
        return self.search.scores(_points(x))

    def compute_loss(self, x: Array, y: Array, **kwargs: Any) -> Array:
        return _loss(torch.from_numpy(self.predict(x)), _labels(y)).numpy()

    def loss_gradient(self, x: Array, y: Array, **kwargs: Any) -> Array:
        assert self.search is not None
        return self.search.gradients(_points(x), _loss, _labels(y))

    def class_gradient(self, x: Array, label: Any = None, **kwargs: Any) -> Array:
        assert self.search is not None
        labels = range(self.nb_classes) if label is None else [label]
        classes = [torch.as_tensor(one).long().expand(len(x)) for one in labels]
        return np.stack([self.search.gradients(_points(x), _score, one) for one in classes], 1)

    def fit(self, x: Array, y: Array, batch_size: int = 128, nb_epochs: int = 20, **kwargs: Any) -> None:
        raise NotImplementedError("an attack does not train its victim")

    def get_activations(self, x: Array, layer: int | str, batch_size: int, framework: bool = False) -> Array:
        raise NotImplementedError("an attack has access to decisions, scores and gradients only")


def _shown(points: Array, oracle: Oracle) -> Tensor:
    """The observations [N, V, F] of points [N, 1, V + 1, F], one for each episode of the oracle."""
    z = functional.pad(torch.from_numpy(points[:, 0, :-1, :-1]).to(oracle.observation), (1, 0))
    return oracle.project(oracle.observation + oracle.radius * z)


def _points(x: Array) -> Array:
    return np.asarray(x, np.float32)


def _labels(y: Array) -> Tensor:
    return torch.from_numpy(np.argmax(y, 1))


def _classified(same: Tensor) -> Tensor:
    return functional.one_hot(same.long(), 3).float()


def _loss(scores: Tensor, labels: Tensor) -> Tensor:
    return -margin(scores, labels)


def _score(scores: Tensor, labels: Tensor) -> Tensor:
    return scores.gather(-1, labels.unsqueeze(-1)).squeeze(-1)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed NumPy's and Python's global random generators, which ART uses, and restore them afterwards.

    Some of ART's attacks create a generator without a seed; it also gets `seed`.
    """
    numpys, pythons, unseeded = np.random.get_state(), random.getstate(), np.random.RandomState  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    random.seed(seed)
    np.random.RandomState = lambda own=None: unseeded(seed if own is None else own)  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        np.random.RandomState = unseeded  # type: ignore[misc]
        np.random.set_state(numpys)  # noqa: NPY002
        random.setstate(pythons)
