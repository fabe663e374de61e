"""A fused network in training: its weights in one vector; answers, gradient and Adam's step are compiled calls."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cavbench.driving.fused import kernels, learning
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.network import Fused


class Trainable:
    """The weights of a network, which the network goes on to use.

    What it computes is what torch computes with `autograd`, `clip_grad_norm_` and `torch.optim.Adam`, to rounding. Sums have
    one order, so a training has the same bits again.

    Args:
        fused: the network; its parameters become views of `weights`.
        eps: as of `torch.optim.Adam`.
    """

    def __init__(self, fused: Fused, *, eps: float = 1e-8) -> None:
        self.fused, self.eps, self.steps = fused, eps, 0
        self.weights: Floats = fused.gathered().numpy()
        self.by_weights = np.zeros_like(self.weights)
        self.first, self.second = np.zeros((2, len(self.weights)), np.float32)
        self._kept: Floats = np.empty((0, fused.kept, kernels.LANES), np.float32)

    def forward(self, observation: Tensor, *, weights: Floats | None = None) -> Tensor:
        """The answers [N, A] about observations [N, V, F], by default with its own weights; `backward` is about this call."""
        points = observation.reshape(len(observation), -1).contiguous().numpy()
        blocks = -(-len(points) // kernels.LANES)
        if len(self._kept) < blocks:
            self._kept = np.empty((blocks, self.fused.kept, kernels.LANES), np.float32)
            self._best, self._chosen = np.empty((2, blocks, self.fused.pooled, kernels.LANES), np.float32)
        out = np.empty((len(points), self.fused.outputs), np.float32)
        network = self.fused.form(points.shape[1]), self.fused.widths, self.fused.kinds
        self._pass = points, self.weights if weights is None else weights, *network, *self._room(blocks)
        kernels.forward(*self._pass[:5], out, *self._pass[5:])
        return torch.from_numpy(out)

    def backward(self, by_answers: Tensor) -> None:
        """Sets the gradient in the weights, from that in the answers [N, A] of the last `forward`."""
        learning.gradient(*self._pass, by_answers.contiguous().numpy(), self.by_weights)

    def step(self, rate: float, *, longest: float, average: Floats, tau: float) -> None:
        """Take a step of Adam, and move the running average of the weights.

        Args:
            rate: learning rate.
            longest: a longer gradient is shortened to this norm.
            average: a vector like `weights`, changed in place.
            tau: share of the way to the new weights that the average moves.
        """
        self.steps += 1
        moments = self.first, self.second, self.steps
        learning.adam(self.weights, self.by_weights, *moments, rate, self.eps, longest, average, tau)

    def _room(self, blocks: int) -> tuple[Floats, Floats, Floats]:
        return self._kept[:blocks], self._best[:blocks], self._chosen[:blocks]
