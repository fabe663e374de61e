"""The first part of a network, between a box of observations and the layers that follow: as it is, or an encoder of cars."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from cavbench.driving.bounds.relaxations import Interval, Relaxation, largest, relu
from cavbench.driving.victims.networks import Encoder


class Front(Protocol):
    """The outputs z of the first part, for all observations of N boxes."""

    def interval(self) -> Interval:
        """Bounds of z, [N, Z] each, by intervals alone."""
        ...

    def lower(self, weight: Tensor) -> Tensor:
        """A lower bound [N, O] of weight @ z by linear bounds, for a weight [N, O, Z] or [O, Z]."""
        ...


class Flat:
    """Observations as they are, flattened.

    Args:
        low, high: the boxes, [N, V, F].
    """

    def __init__(self, low: Tensor, high: Tensor) -> None:
        self.low, self.high = low.flatten(1), high.flatten(1)

    def interval(self) -> Interval:
        return self.low, self.high

    def lower(self, weight: Tensor) -> Tensor:
        return least(weight, self.low, self.high)


class Cars:
    """The encoder of cars as a set (`cavbench.driving.victims.networks.Encoder`), for boxes with a fixed presence.

    z is the ego's row, and for each unit the largest response of a car, at least 0.

    Args:
        encoder: the encoder, in float64.
        low, high: the boxes [N, V, F], with the same presence in both.
    """

    def __init__(self, encoder: Encoder, low: Tensor, high: Tensor) -> None:
        self.encoder, self.presence = encoder, low[:, 1:, :1]
        self.ego, self.cars = (low[:, 0, 1:], high[:, 0, 1:]), (low[:, 1:], high[:, 1:])
        self.hidden, by_interval = of_cars(encoder, self.ego, self.cars)
        self.lines = relu(*self.hidden)
        self.by_interval = self._present(by_interval)
        self.largest = largest(*self._present(self._responses(by_interval)))

    def interval(self) -> Interval:
        return pooled(self.ego, self.by_interval)

    def lower(self, weight: Tensor) -> Tensor:
        weight = weight.expand(len(self.presence), *weight.shape[-2:])
        on_ego, on_response = weight[..., : self.ego[0].shape[-1]], weight[..., self.ego[0].shape[-1] :]
        up, down = on_response.clamp(min=0), on_response.clamp(max=0)
        found = self.largest
        constant = (down * found.offset.unsqueeze(1)).sum(-1)
        on_cars = up.unsqueeze(2) * found.lower.unsqueeze(1) + down.unsqueeze(2) * found.upper.unsqueeze(1)
        return constant + self._of_cars(on_cars * self.presence.unsqueeze(1), on_ego)

    def _of_cars(self, weight: Tensor, on_ego: Tensor) -> Tensor:
        """A lower bound [N, O] of what depends on the cars' responses by `weight` [N, O, C, K], and on the ego [N, O, F - 1]."""
        encoder, lines = self.encoder, self.lines
        constant = (weight @ encoder.pair.bias).sum(-1)
        on_hidden, offset = backwards(weight @ encoder.pair.weight, Relaxation(*(line.unsqueeze(1) for line in lines)))
        constant = constant + offset.sum(-1) + (on_hidden @ encoder.car.bias).sum(-1)
        on_rows = (on_hidden @ encoder.car.weight).flatten(-2)
        on_ego = on_ego + on_hidden.sum(-2) @ encoder.ego.weight
        rows = self.cars[0].flatten(1), self.cars[1].flatten(1)
        return constant + least(on_rows, *rows) + least(on_ego, *self.ego)

    def _responses(self, by_interval: Interval) -> Interval:
        """Bounds of each car's response before its presence, [N, C, K] each: the better ones of linear bounds and intervals."""
        encoder = self.encoder
        bounds = []
        for sign in (1.0, -1.0):
            on_hidden, offset = backwards(
                (sign * encoder.pair.weight).expand(*self.hidden[0].shape[:2], -1, -1),
                Relaxation(*(line.unsqueeze(2) for line in self.lines)),
            )
            constant = sign * encoder.pair.bias + offset + on_hidden @ encoder.car.bias
            on_car = least(on_hidden @ encoder.car.weight, *self.cars)
            ego = self.ego[0].unsqueeze(1), self.ego[1].unsqueeze(1)
            bounds.append(constant + on_car + least(on_hidden @ encoder.ego.weight, *ego))
        return torch.maximum(bounds[0], by_interval[0]), torch.minimum(-bounds[1], by_interval[1])

    def _present(self, bounds: Interval) -> Interval:
        return bounds[0] * self.presence, bounds[1] * self.presence


def of_cars(encoder: Encoder, ego: Interval, cars: Interval) -> tuple[Interval, Interval]:
    """Bounds by intervals of the sums before the first ReLU, and of the responses of all cars, [N, C, K] each.

    Args:
        encoder: the encoder.
        ego: bounds of the ego's row without its presence, [N, F - 1] each.
        cars: bounds of the other rows, [N, C, F] each.
    """
    own = affine(encoder.ego.weight, None, ego)
    hidden = affine(encoder.car.weight, encoder.car.bias, cars)
    hidden = hidden[0] + own[0].unsqueeze(1), hidden[1] + own[1].unsqueeze(1)
    return hidden, affine(encoder.pair.weight, encoder.pair.bias, (hidden[0].relu(), hidden[1].relu()))


def pooled(ego: Interval, responses: Interval) -> Interval:
    """Bounds of the encoder's output, from those of the ego's row and of the responses of the cars that are there."""
    low, high = (bound.amax(1).relu() for bound in responses)
    return torch.cat((ego[0], low), -1), torch.cat((ego[1], high), -1)


def affine(weight: Tensor, bias: Tensor | None, box: Interval) -> Interval:
    """Bounds of weight @ x + bias over a box [..., I] each, exact."""
    middle, radius = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
    centre, reach = middle @ weight.T, radius @ weight.abs().T
    if bias is not None:
        centre = centre + bias
    return centre - reach, centre + reach


def least(weight: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The lowest value [..., O] of weight @ x over a box [..., I] each, for a weight [..., O, I]."""
    middle, radius = (low + high) / 2, (high - low) / 2
    return (weight @ middle.unsqueeze(-1) - weight.abs() @ radius.unsqueeze(-1)).squeeze(-1)


def backwards(weight: Tensor, lines: Relaxation) -> tuple[Tensor, Tensor]:
    """A lower bound of weight @ f(x) as a weight [..., O, I] on x and an offset [..., O], from lines around f."""
    up, down = weight.clamp(min=0), weight.clamp(max=0)
    offset = (up * lines.lower_offset + down * lines.upper_offset).sum(-1)
    return up * lines.lower_slope + down * lines.upper_slope, offset
