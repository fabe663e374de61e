"""A detector that is an object of Python: a `Detector`, or a network of torch that takes images and returns boxes and scores."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from cavbench.core.contracts import Facts
from cavbench.detection import Detector
from cavbench.detection.victims.file_network import FileDetector
from cavbench.detection.victims.first_look import look
from cavbench.detection.victims.reading import Foreign
from cavbench.errors import UserError, reason
from cavbench.identity.bytecode import code_of
from cavbench.identity.content import content
from cavbench.identity.fingerprint import digest, state_digest

PARTS = (("boxes", "scores", "labels"), ("pred_boxes", "logits"), ("pred_boxes", "pred_logits"), ("boxes", "scores"))
"""The keys of outputs that are mappings, boxes first: torchvision's; DETR's and its descendants' in two libraries."""


@dataclass(frozen=True, kw_only=True)
class DetectorObject(Foreign):
    """A detector that was given as an object. Its records cannot be replayed: no package ships it.

    Args:
        source: class of the object.
    """

    fixed: ClassVar[bool] = False
    network_given: ClassVar[Detector]
    """Set by `detector`."""

    source: str

    def said(self, name: str, value: object) -> str:
        return f"{name}={value!r}"

    def alternatives(self) -> Mapping[str, Foreign]:
        """Other readings of the same network; none of a `Detector`, which says itself how it is read."""
        own = self.network_given
        if not isinstance(own, FileDetector) or self.source == _class_of(own):
            return {}
        others = super().alternatives()
        for victim in others.values():
            given = replace(own.given, scaling=victim.scaling, order=victim.channels)
            names = victim.class_names() or own.names
            other = FileDetector(own.network, own.path, names, given, victim.output, own.weights_sha256)
            object.__setattr__(victim, "network_given", other)
        return others

    def load(self, seed: int, facts: Facts) -> Detector:
        """A copy of the detector, so that no run can change the user's object."""
        return copy.deepcopy(self.network_given)

    def zoo_name(self) -> str:
        """It has no trained or defended versions.

        Raises:
            UserError: always.
        """
        raise UserError("a detector that is an object cannot be trained: leave out the training or the defence")

    @property
    def code(self) -> str:
        """Hash of the code of its network, and of all that it holds."""
        return digest([code_of(*self.network_given.modules()), content(vars(self.network_given))])


def detector(network: nn.Module, **reading: Any) -> DetectorObject:
    """A victim made of a network: `cavbench.score(cavbench.detector(network, boxes="centre"), "eot", world="camera")`.

    Args:
        network: a `cavbench.detection.Detector`; or a module that takes images [N, 3, H, W] and returns boxes and scores: tensors
            in one of the layouts of docs/victims/detector.md, a mapping with `boxes`, `scores` and `labels` or with `logits` and
            `pred_boxes`, or a list of such mappings, one for each image. It is copied, and put in eval mode.
        reading: how it is read (`cavbench.detection.victims.reading.Foreign`): names, boxes, normalised, activation, scaling,
            channels.

    Raises:
        UserError: in one line, if a parameter is not allowed, or its predictions are not those of a detector.
    """
    name = type(network).__name__
    if not isinstance(network, nn.Module):
        raise UserError(f"a detector is a torch.nn.Module, got {name}")
    try:
        victim = DetectorObject(source=_class_of(network), **reading)
    except (TypeError, ValueError) as error:
        raise UserError(f"how to read {name}: {error}") from None
    try:
        own = copy.deepcopy(network).cpu().requires_grad_(False).eval()
    # A module of the user may raise anything when it is copied.
    except Exception as error:
        raise UserError(f"{name} cannot be copied: {reason(error)}") from error
    if isinstance(own, Detector):
        if reading:
            raise UserError(f"{name} is a cavbench.detection.Detector, which says itself how it is read")
        found, gradient = own, True
    else:
        if any(one.is_floating_point() and one.dtype != torch.float32 for one in own.parameters()):
            own = own.float()
        given = victim.input_of(name, (None, None, None, None), torch.float32)
        found = FileDetector(_Listed(own), name, victim.class_names() or (), given, victim.output, state_digest(own))
        gradient = _tried(victim, found) is not None
    found.weights_sha256 = found.weights_sha256 or state_digest(own)
    object.__setattr__(victim, "network_given", found)
    if not gradient:
        object.__setattr__(victim, "answers", "scores")
    return victim


def _class_of(network: object) -> str:
    return f"{type(network).__module__}.{type(network).__qualname__}"


def _tried(victim: DetectorObject, found: FileDetector) -> Tensor | None:
    """The gradient of its scores in the pixels, as `look`.

    Raises:
        UserError: if it is read otherwise than it is meant.
    """
    try:
        return look(victim, found)
    except UserError as error:
        cause = error.__cause__
        why = f" ({reason(cause)})" if isinstance(cause, Exception) and not isinstance(cause, UserError) else ""
        ways = "cavbench.detector(network, boxes=…, normalised=…, activation=…, names=…) says how it is read"
        raise UserError(f"{error}{why}; {ways}") from cause


class _Listed(nn.Module):
    """A network whose outputs are a list of tensors.

    Args:
        network: the network.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, pictures: Tensor) -> list[Tensor]:
        return _tensors(self.network(pictures))


def _tensors(answer: Any) -> list[Tensor]:
    """The tensors of an answer that are boxes, scores and labels.

    Raises:
        TypeError: if there are none.
    """
    if isinstance(answer, Tensor):
        return [answer]
    if isinstance(answer, Mapping):
        keys = next((keys for keys in PARTS if set(keys) <= set(answer)), tuple(answer))
        return [answer[key] for key in keys if isinstance(answer[key], Tensor)]
    if isinstance(answer, list | tuple):
        if answer and all(isinstance(one, Mapping) for one in answer):
            return _padded([_tensors(one) for one in answer])
        # Some networks return what they computed on the way, too, in a list beside the predictions.
        return [one for one in answer if isinstance(one, Tensor)]
    raise TypeError(f"it returns a {type(answer).__name__}")


def _padded(images: Sequence[Sequence[Tensor]]) -> list[Tensor]:
    """The predictions on each image, of any number, in one tensor for each part: the rest of it is 0.

    Raises:
        TypeError: if images have other parts, or parts of an image other numbers.
    """
    if any(len(parts) != len(images[0]) or len({len(one) for one in parts}) != 1 for parts in images):
        raise TypeError("it returns mappings with other parts for other images")
    most = max(1, *(len(parts[0]) for parts in images))
    padded = [
        [nn.functional.pad(one, (0, 0) * (one.ndim - 1) + (0, most - len(one))) for one in parts] for parts in images
    ]
    return [torch.stack(parts) for parts in zip(*padded, strict=True)]
