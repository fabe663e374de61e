"""What an attack answers that does more than change values: cars hidden or invented, a late or frozen sensor, other commands."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cavbench.driving.features import Features


@dataclass(frozen=True, eq=False, kw_only=True)
class Forgery:
    """The answer of an attack for the B running episodes. What is None is left as it is.

    The run composes what the victim is shown: the frame that is `age` decisions old, with the values of `observation` as far as
    the perturbation set around that frame allows, without the `hidden` cars and with the `invented` ones among the others,
    nearest first. What a threat model does not allow is refused, or clipped where it is a continuous quantity.

    Args:
        observation: values [B, V, F] around the frame of `age`.
        age: int64 [B], age of the frame that is shown, in decisions.
        hidden: bool [B, V], rows of that frame whose car is hidden. Row 0 is the ego, which cannot be.
        invented: [B, K, F] rows of invented cars, relative to the ego as the others; those with presence 0 are not there. Car k
            of a frame and car k of the next one are the same car.
        action: the attacker's action, int64 [B] or float [B, 2], for the NR-MDP and the PR-MDP; -1 or NaN for none.
        shift: [B, 2], added to the controls of a continuous action.
        delay: int64 [B], decisions by which the victim's command is executed late.
        messages: [B, V, F], false messages in the rows of senders (`Features.messages`), relative to the ego of this frame. NaN
            leaves a value as it is, and the other rows are never changed.
        content: int64 [B, V], decisions that the content of these messages is old; `messages` are bounded around it.
        dropped: bool [B, V], messages that are held back.
    """

    observation: Tensor | None = None
    age: Tensor | None = None
    hidden: Tensor | None = None
    invented: Tensor | None = None
    action: Tensor | None = None
    shift: Tensor | None = None
    delay: Tensor | None = None
    messages: Tensor | None = None
    content: Tensor | None = None
    dropped: Tensor | None = None


def composed(
    observation: Tensor, features: Features, hidden: Tensor | None = None, invented: Tensor | None = None
) -> Tensor:
    """The observation [..., V, F] without the `hidden` cars [..., V], and with the `invented` ones [..., K, F] among the others.

    The cars are nearest first along the road, as the world lists them, and real ones keep their order. With more cars than
    rows the farthest ones are left out, as the world does.
    """
    ego, cars = observation[..., :1, :], observation[..., 1:, :]
    distance = _distance(cars, features).cummax(-1).values
    gone = cars[..., 0] <= 0
    if hidden is not None:
        gone = gone | hidden[..., 1:]
    distance = distance.masked_fill(gone, torch.inf)
    cars = cars.masked_fill(gone[..., None], 0.0)
    if invented is not None and invented.shape[-2]:
        away = invented[..., 0] <= 0
        distance = torch.cat((distance, _distance(invented, features).masked_fill(away, torch.inf)), -1)
        cars = torch.cat((cars, invented.masked_fill(away[..., None], 0.0)), -2)
    order = distance.argsort(dim=-1, stable=True)[..., : observation.shape[-2] - 1]
    return torch.cat((ego, cars.gather(-2, order[..., None].expand(*order.shape, cars.shape[-1]))), -2)


def _distance(cars: Tensor, features: Features) -> Tensor:
    """[..., V - 1] distance along the road of relative rows, in m."""
    return features.physical(cars)[..., features.names.index("x")].abs()
