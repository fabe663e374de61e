"""Bounds of a network's scores over boxes of observations: by intervals, and by linear bounds (CROWN)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from cavbench.driving.bounds.fronts import Cars, Flat, Front, affine, backwards
from cavbench.driving.bounds.relaxations import Interval, Relaxation, relu, tanh
from cavbench.driving.policy import Policy
from cavbench.driving.victims.from_file import FilePolicy
from cavbench.driving.victims.networks import QNetwork, QPolicy
from cavbench.errors import UserError

CHUNK = 8
"""Boxes that are bounded at once: their weights on all cars fit into the processor's cache."""
ROUNDING = 1e-5
"""A lead counts from this share of the largest score on. The network answers in float32, the bounds are of its real numbers."""
LINES: dict[type[nn.Module], Callable[[Tensor, Tensor], Relaxation]] = {nn.ReLU: relu, nn.Tanh: tanh}
"""Activations with linear bounds."""


class Leads(NamedTuple):
    """Lower bounds of score i - score j over each box, [N, A, A] each."""

    interval: Tensor
    linear: Tensor


class BoundedNetwork:
    """A network whose scores can be bounded: linear layers with ReLU or tanh between them, behind the encoder of cars or not.

    Args:
        policy: a stateless policy with discrete actions.

    Raises:
        UserError: if the policy is another one.
    """

    def __init__(self, policy: Policy) -> None:
        if policy.action_type != "discrete":
            raise UserError(
                "bounds need discrete actions, those of this victim are continuous: take dqn, ppo, or another such victim"
            )
        network: Any = getattr(policy, "network", None)
        known = type(policy).forward is QPolicy.forward and isinstance(network, QNetwork)
        if not known and not (type(policy) is FilePolicy and isinstance(network, nn.Module) and policy.native is None):
            raise UserError(
                f"the decisions of {type(policy).__name__} cannot be bounded: bounds need a network that decides alone, "
                "so leave out defences that work at run time"
            )
        copied = copy.deepcopy(network).double().requires_grad_(False)
        self.encoder = copied.encoder if known else None
        self.layers = _layers(copied.head if known else copied)
        # Of a duelling network only the advantages count: the value is the same for all actions.
        self.first = 1 if known else 0

    def leads(self, low: Tensor, high: Tensor, *, through: bool = True) -> Leads:
        """Lower bounds of the lead of each action over each other one, for all observations of each box.

        Args:
            low, high: the boxes [N, V, F]; presence must be the same in both.
            through: whether the inner layers are bounded linearly, too, as in CROWN; otherwise by intervals (CROWN-IBP, Zhang
                et al. 2020, arXiv 1906.06316), which is looser and takes a tenth of the time.
        """
        boxes = zip(low.double().split(CHUNK), high.double().split(CHUNK), strict=True)
        parts = [self._leads(*box, through=through) for box in boxes]
        return Leads(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def possible(self, scores: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Which actions the network may choose in each box, bool [N, A], by intervals and by linear bounds.

        An action is not possible if another one has a higher score everywhere in the box.

        Args:
            scores: the scores [N, A] at some point of each box.
            low, high: the boxes [N, V, F].
        """
        slack = ROUNDING * (1 + scores.abs().amax(-1).double())[:, None, None]
        interval, linear = ((lead <= slack).all(1) for lead in self.leads(low, high, through=False))
        open_ = linear.sum(1) > 1
        if bool(open_.any()):
            linear[open_] &= (self.leads(low[open_], high[open_]).linear <= slack[open_]).all(1)
        return interval, linear

    def _leads(self, low: Tensor, high: Tensor, *, through: bool) -> Leads:
        front: Front = Flat(low, high) if self.encoder is None else Cars(self.encoder, low, high)
        *hidden, last = self.layers
        actions = len(last.bias) - self.first
        pairs = torch.eye(actions, dtype=torch.float64)
        pairs = (pairs[:, None] - pairs[None, :]).flatten(0, 1)
        weight, bias = pairs @ last.weight[self.first :], pairs @ last.bias[self.first :]
        box = front.interval()
        lines: list[Relaxation] = []
        for layer in hidden:
            around = affine(layer.weight, layer.bias, box)
            below, above = around
            if through:
                below = torch.maximum(below, self._lower(front, layer.weight, layer.bias, lines))
                above = torch.minimum(above, -self._lower(front, -layer.weight, -layer.bias, lines))
            lines.append(layer.lines(below, above))
            box = layer.applied(around)
        by_interval = affine(weight, bias, box)[0]
        linear = torch.maximum(by_interval, self._lower(front, weight, bias, lines))
        return Leads(by_interval.unflatten(1, (actions, actions)), linear.unflatten(1, (actions, actions)))

    def _lower(self, front: Front, weight: Tensor, bias: Tensor, lines: list[Relaxation]) -> Tensor:
        """A lower bound [N, O] of weight @ (last known layer) + bias, carried back to the box through all layers before."""
        constant = bias
        for layer, around in zip(reversed(self.layers[: len(lines)]), reversed(lines), strict=True):
            weight, offset = backwards(weight, Relaxation(*(line.unsqueeze(1) for line in around)))
            constant = constant + offset + weight @ layer.bias
            weight = weight @ layer.weight
        return constant + front.lower(weight)


class Layer(NamedTuple):
    """A linear layer and the activation after it, if any."""

    weight: Tensor
    bias: Tensor
    activation: nn.Module | None

    def lines(self, low: Tensor, high: Tensor) -> Relaxation:
        return LINES[type(self.activation)](low, high)  # type: ignore[index]

    def applied(self, box: Interval) -> Interval:
        """The activation of an interval; all known ones are monotonic."""
        assert self.activation is not None
        return self.activation(box[0].clone()), self.activation(box[1].clone())


def _layers(network: nn.Module) -> list[Layer]:
    """The layers of a sequence: flattening, then linear layers with an activation between them."""
    modules: list[Any] = [module for module in _flat(network) if not isinstance(module, nn.Flatten | nn.Identity)]
    linear, between = modules[::2], modules[1::2]
    if not all(isinstance(one, nn.Linear) for one in linear) or any(type(one) not in LINES for one in between):
        names = ", ".join(dict.fromkeys(type(module).__name__ for module in modules))
        raise UserError(f"bounds are known for linear layers with ReLU or tanh between them, this network has {names}")
    if len(linear) == len(between):
        raise UserError("bounds need a network that ends with a linear layer")
    return [
        Layer(one.weight, torch.zeros(len(one.weight)).double() if one.bias is None else one.bias, after)
        for one, after in zip(linear, [*between, None], strict=True)
    ]


def _flat(network: nn.Module) -> Iterator[nn.Module]:
    if isinstance(network, nn.Sequential):
        for module in network:
            yield from _flat(module)
    else:
        yield network
