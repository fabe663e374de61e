"""A softmax over a few actions in compiled calls: its logarithms and entropy, and actions drawn from it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn

from cavbench.compiled import entry_point, inner
from cavbench.driving.fused.kernels import Floats
from cavbench.driving.fused.trainable import Trainable


@inner
def log_softmax(scores: Floats, allowed: NDArray[np.bool_], logs: Floats) -> np.float32:
    """Fills `logs` [A] with the logarithms of the probabilities, -inf where not allowed; returns the entropy.

    At least one action must be allowed.
    """
    highest, total, entropy = np.float32(-np.inf), np.float32(0), np.float32(0)
    for a in range(len(scores)):
        if allowed[a]:
            highest = max(highest, scores[a])
    for a in range(len(scores)):
        if allowed[a]:
            total += np.exp(scores[a] - highest)
    whole = highest + np.log(total)
    for a in range(len(scores)):
        logs[a] = scores[a] - whole if allowed[a] else np.float32(-np.inf)
        if allowed[a]:
            entropy -= np.exp(logs[a]) * logs[a]
    return entropy


@entry_point
def _draw(
    scores: Floats, allowed: NDArray[np.bool_], uniform: Floats, action: NDArray[np.int64], log_prob: Floats
) -> None:
    logs = np.empty(scores.shape[1], np.float32)
    for n in range(len(scores)):
        log_softmax(scores[n], allowed[n], logs)
        left, found = uniform[n], -1
        for a in range(len(logs)):
            # Rounding may leave a little after the last action that is allowed; it is drawn then.
            if allowed[n, a] and left >= 0:
                found = a
                left -= np.exp(logs[a])
        action[n], log_prob[n] = found, logs[found]


def drawn(scores: Tensor, allowed: Tensor | None) -> tuple[Tensor, Tensor]:
    """Actions [N] from the softmax of scores [N, A] over those that are `allowed` [N, A], and their log-probabilities [N].

    The random numbers are torch's, one for each action drawn.
    """
    count = len(scores)
    action, log_prob = torch.empty(count, dtype=torch.int64), torch.empty(count)
    _draw(
        scores.numpy(),
        every(scores, allowed).numpy(),
        torch.rand(count).numpy(),
        action.numpy(),
        log_prob.numpy(),
    )
    return action, log_prob


def every(scores: Tensor, allowed: Tensor | None) -> Tensor:
    """`allowed` [N, A]; None stands for all actions."""
    return torch.ones_like(scores, dtype=torch.bool) if allowed is None else allowed.contiguous()


class Drawing(nn.Module):
    """Writes an `action` that is drawn from the softmax of a network's answers into a tensordict [N].

    Args:
        network: of logits.
        mask: key of the allowed actions; None for all.
        log_prob: key of the actions' log-probabilities; None if they are not wanted.
    """

    def __init__(self, network: Trainable, mask: str | None, *, log_prob: str | None = None) -> None:
        super().__init__()
        self.network, self.mask, self.log_prob = network, mask, log_prob

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        scores = self.network.answers(tensordict["observation"])
        action, log_prob = drawn(scores, None if self.mask is None else tensordict[self.mask])
        if self.log_prob is not None:
            tensordict.set(self.log_prob, log_prob)
        return tensordict.set("action", action)
