"""A fused network in training: its weights in one vector; answers, gradient and Adam's step are compiled calls."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cavbench.driving.fused import kernels, learning
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.network import Fused, Room

NO_AVERAGE: Floats = np.empty(0, np.float32)


class Trainable:
    """The weights of a network, which the network goes on to use.

    What it computes is what torch computes with `autograd`, `clip_grad_norm_` and `torch.optim.Adam`, to rounding. Sums have
    one order, so a training has the same bits again.

    Args:
        fused: the network; its parameters become views of `weights`.
        eps: as of `torch.optim.Adam`.
    """

    def __init__(self, fused: Fused, *, eps: float = 1e-8) -> None:
        self.fused, self.eps = fused, eps
        self.weights: Floats = fused.gathered().numpy()
        self.by_weights = np.zeros_like(self.weights)
        self.restart()
        self._room = self.fused.room(1)

    def restart(self) -> None:
        """Forget the moments of Adam."""
        self.steps = 0
        self.first, self.second = np.zeros((2, len(self.weights)), np.float32)

    def answers(self, observation: Tensor, *, weights: Floats | None = None) -> Tensor:
        """The answers [N, A] about observations [N, V, F], by default with its own weights."""
        return self._answers(observation, weights, self.fused.room(1))[0]

    def forward(self, observation: Tensor, *, weights: Floats | None = None) -> Tensor:
        """As `answers`; `backward` is about this call."""
        blocks = -(-len(observation) // kernels.LANES)
        if len(self._room[0]) < blocks:
            self._room = self.fused.room(blocks)
        out, self._pass = self._answers(observation, weights, self._room)
        return out

    def _answers(self, observation: Tensor, weights: Floats | None, room: Room) -> tuple[Tensor, tuple[Any, ...]]:
        """The answers, and what the gradient needs besides them."""
        points = observation.reshape(len(observation), -1).contiguous().numpy()
        network = self.fused.form(points.shape[1]), self.fused.widths, self.fused.kinds
        given = points, self.weights if weights is None else weights, *network
        out = np.empty((len(points), self.fused.outputs), np.float32)
        kernels.forward(*given, out, *room)
        return torch.from_numpy(out), (*given, *room)

    def backward(self, by_answers: Tensor) -> None:
        """Sets the gradient in the weights, from that in the answers [N, A] of the last `forward`."""
        learning.gradient(*self._pass, by_answers.contiguous().numpy(), self.by_weights)

    def step(self, rate: float, *, longest: float, average: Floats = NO_AVERAGE, tau: float = 0.0) -> None:
        """Take a step of Adam, and move a running average of the weights, if there is one.

        Args:
            rate: learning rate.
            longest: a longer gradient is shortened to this norm.
            average: a vector like `weights`, changed in place.
            tau: share of the way to the new weights that the average moves.
        """
        self.steps += 1
        moments = self.first, self.second, self.steps
        learning.adam(self.weights, self.by_weights, *moments, rate, self.eps, longest, average, tau)
