"""A network with a memory in one compiled call: the encoder, a gated recurrent unit, and a head that reads both.

Encoder and head are passes of `kernels`; here is the unit between them (Cho et al. 2014, in the form of `torch.nn.GRUCell`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from cavbench.compiled import entry_point, rounded_once
from cavbench.driving.fused import kernels, tiles
from cavbench.driving.fused.kernels import GRAIN, LANES, PLAIN, Floats, Form, Sizes, fill, read, tanh
from cavbench.driving.fused.network import Fused, Room


@rounded_once
def sigmoid(x: np.float32) -> np.float32:
    """1 / (1 + exp(-x)) = (1 + tanh(x / 2)) / 2, to about 2e-7; 0 and 1 far out, as in torch."""
    half = np.float32(0.5)
    found = half + half * tanh(half * x)
    found = np.float32(0) if x < -18 else found
    return np.float32(1) if x > 18 else found


@rounded_once
def _remember(
    points: Floats,
    start: int,
    count: int,
    weights: Floats,
    at: int,
    lanes: int,
    x: Floats,
    sums: Floats,
    gates: Floats,
    joined: Floats,
) -> None:
    """The memory after the observations of a block; fills it into `joined`, behind what is encoded.

    Args:
        points: observations, and the memory before them as the last M values [N, V * F + M].
        at: place of the unit's weights: of the input [3 * M, E], of the memory [3 * M, M], and the bias of each.
        x, sums: room for E + M and 3 * M rows.
        gates: the gates of reset and update, the new memory, and the sum that the reset is a factor of [4 * M, LANES], filled.
        joined: what is encoded and the memory after it [N, E + M].
    """
    size = len(gates) // 4
    encoded = len(x) - size
    seen, before = x[:encoded], x[encoded:]
    read(joined, start, count, 0, lanes, seen)
    read(points, start, count, points.shape[1] - size, lanes, before)
    own, bias = at + 3 * size * encoded, at + 3 * size * (encoded + size)
    fill(gates[: 3 * size], weights, bias, lanes)
    fill(sums, weights, bias + 3 * size, lanes)
    tiles.add(seen, weights, at, encoded, 1, encoded, 3 * size, gates[: 3 * size], lanes)
    tiles.add(before, weights, own, size, 1, size, 3 * size, sums, lanes)
    for j in range(size):
        for n in range(lanes):
            reset, update = sigmoid(gates[j, n] + sums[j, n]), sigmoid(gates[size + j, n] + sums[size + j, n])
            remembered = sums[2 * size + j, n]
            new = tanh(gates[2 * size + j, n] + reset * remembered)
            gates[j, n], gates[size + j, n], gates[2 * size + j, n] = reset, update, new
            gates[3 * size + j, n] = remembered
            # In place of its sum, which is not needed any more.
            sums[j, n] = (before[j, n] - new) * update + new
        for n in range(count):
            joined[start + n, encoded + j] = sums[j, n]


@rounded_once
def _remember_backward(
    points: Floats,
    start: int,
    count: int,
    weights: Floats,
    at: int,
    lanes: int,
    x: Floats,
    sums: Floats,
    gates: Floats,
    by_joined: Floats,
    by_encoded: Floats,
) -> None:
    """The gradient of a block in what is encoded, `by_encoded` [N, E], from that in `joined`; the others as in `_remember`."""
    size = len(gates) // 4
    encoded = len(x) - size
    by_seen, before = x[:encoded], x[encoded:]
    read(by_joined, start, count, 0, lanes, by_seen)
    read(by_joined, start, count, encoded, lanes, sums[:size])
    read(points, start, count, points.shape[1] - size, lanes, before)
    one = np.float32(1)
    for j in range(size):
        for n in range(lanes):
            slope, reset, update, new = sums[j, n], gates[j, n], gates[size + j, n], gates[2 * size + j, n]
            by_new = slope * (one - update) * (one - new * new)
            sums[j, n] = by_new * gates[3 * size + j, n] * reset * (one - reset)
            sums[size + j, n] = slope * (before[j, n] - new) * update * (one - update)
            sums[2 * size + j, n] = by_new
    tiles.add(sums, weights, at, 1, encoded, 3 * size, encoded, by_seen, lanes)
    for n in range(count):
        for k in range(encoded):
            by_encoded[start + n, k] = by_seen[k, n]


@entry_point
def forward(
    points: Floats,
    weights: Floats,
    form: Form,
    widths: Sizes,
    kinds: Sizes,
    out: Floats,
    kept: Floats,
    best: Floats,
    chosen: Floats,
    gates: Floats,
) -> None:
    """The answers and the memory after them; arguments as of `kernels.forward`, but for

    Args:
        points: observations, and the memory before them [N, V * F + M].
        weights: the encoder's, those of the unit (`_remember`), then the head's.
        widths: E, size of what is encoded; then as in `kernels.forward`, of the head: the first one is E + M.
        out: the answers and the memory [N, A + M].
        gates: as of `_remember`, [blocks, 4 * M, LANES].
    """
    count, encoded, inputs, answers = len(points), widths[0], widths[1], widths[-1]
    size, at = inputs - encoded, form.width * 2 * form.features + form.pooled * (form.width + 1)
    seen, joined = np.empty((count, encoded), np.float32), np.empty((count, inputs), np.float32)
    kernels.forward(points, weights, form, widths[:1], kinds[:0], seen, kept, best, chosen)
    joined[:, :encoded] = seen
    x, sums = np.empty((inputs, LANES), np.float32), np.empty((3 * size, LANES), np.float32)
    for block in range((count + LANES - 1) // LANES):
        start = block * LANES
        many = min(LANES, count - start)
        lanes, place = (many + GRAIN - 1) // GRAIN * GRAIN, block if len(gates) > 1 else 0
        _remember(points, start, many, weights, at, lanes, x, sums, gates[place], joined)
    logits = np.empty((count, answers), np.float32)
    head = weights[at + 3 * size * (inputs + 2) :]
    kernels.forward(joined, head, Form(1, 0, 0, 0, PLAIN), widths[1:], kinds, logits, kept, best, chosen)
    out[:, :answers], out[:, answers:] = logits, joined[:, encoded:]


@entry_point
def backward(
    points: Floats,
    weights: Floats,
    form: Form,
    widths: Sizes,
    kinds: Sizes,
    kept: Floats,
    best: Floats,
    chosen: Floats,
    gates: Floats,
    by_out: Floats,
    by_points: Floats,
) -> None:
    """The gradient in the observations, from that in answers and memory; 0 in the memory before. As `kernels.backward`."""
    count, encoded, inputs, answers = len(points), widths[0], widths[1], widths[-1]
    size, at = inputs - encoded, form.width * 2 * form.features + form.pooled * (form.width + 1)
    by_joined, by_encoded = np.empty((count, inputs), np.float32), np.empty((count, encoded), np.float32)
    head, by_logits = weights[at + 3 * size * (inputs + 2) :], by_out[:, :answers].copy()
    none = Form(1, 0, 0, 0, PLAIN)
    kernels.backward(points, head, none, widths[1:], kinds, kept, best, chosen, by_logits, by_joined)
    by_joined[:, encoded:] += by_out[:, answers:]
    x, sums = np.empty((inputs, LANES), np.float32), np.empty((3 * size, LANES), np.float32)
    for block in range((count + LANES - 1) // LANES):
        start = block * LANES
        many = min(LANES, count - start)
        lanes = (many + GRAIN - 1) // GRAIN * GRAIN
        _remember_backward(points, start, many, weights, at, lanes, x, sums, gates[block], by_joined, by_encoded)
    kernels.backward(points, weights, form, widths[:1], kinds[:0], kept, best, chosen, by_encoded, by_points)
    by_points[:, points.shape[1] - size :] = 0


class Recurrent(Fused):
    """A network of an observation and a memory, whose answers are logits and the next memory [..., A + M].

    There is no gradient in the memory before: torch computes where one is asked for.

    Args:
        network: the network, with all that it is made of.
        encoder: as of `Fused`; its output is what the unit reads.
        cell: the unit, with bias.
        layers: the head, which reads the encoder's output and the memory after it; as of `Fused`.
    """

    marked: ClassVar[tuple[str, ...]] = (*Fused.marked, "memory")
    passes = forward, backward

    def __init__(
        self,
        network: nn.Module,
        encoder: tuple[nn.Linear, nn.Linear, nn.Linear],
        cell: nn.GRUCell,
        layers: Sequence[tuple[nn.Linear, type[nn.Module] | None]],
    ) -> None:
        super().__init__(network, layers, encoder=encoder)
        self.memory = cell.hidden_size
        self.modules = (*encoder, cell, *(linear for linear, _ in layers))
        self.widths = np.array([cell.input_size, *self.widths], np.int64)
        self.widths.setflags(write=False)
        self.outputs += self.memory

    @property
    def dimensions(self) -> int:
        """An observation and the memory are one row of numbers."""
        return 1

    def fits(self, observation: Tensor, *more: Tensor) -> bool:
        """Whether it can answer about observations [..., V, F] and a memory [..., M]."""
        if len(more) != 1 or (more[0].requires_grad and torch.is_grad_enabled()):
            return False
        memory = more[0]
        if memory.dtype != torch.float32 or memory.device.type != "cpu":
            return False
        return memory.shape == (*observation.shape[:-2], self.memory) and super().fits(observation)

    def __call__(self, observation: Tensor, *more: Tensor) -> Tensor:
        return super().__call__(torch.cat((observation.flatten(-2), *more), -1))

    def form(self, size: int) -> Form:
        return super().form(size - self.memory)

    def room(self, blocks: int) -> Room:
        return (*super().room(blocks), np.empty((blocks, 4 * self.memory, LANES), np.float32))
