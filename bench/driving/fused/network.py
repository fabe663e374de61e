"""A small network in one compiled call, forward and backward; torch computes whatever it is not made for."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from cavbench.driving.fused import kernels

ACTIVATIONS: dict[type[nn.Module] | None, int] = {
    None: kernels.LINEAR,
    nn.ReLU: kernels.RELU,
    nn.Tanh: kernels.TANH,
}


Room = tuple[kernels.Floats, ...]

MANY = 4096
"""Of more points than this a pass keeps nothing for the gradient. Only defences ask so many, and take the least of several
answers: those that count are computed again. So they are where fewer than half of the answers count."""


class Fused:
    """A chain of linear layers, behind an encoder of the cars or alone, that is evaluated without torch.

    Its answers are those of torch to about 1e-6, and the same to the last bit in every batch. It reads the weights anew in
    every call. It answers only where nothing else can be wanted of the network than its output and the gradient in its input
    (`fits`): torch trains, exports, runs hooks, and computes whatever was changed in the network since it was built.

    Args:
        network: the network, with all that it is made of.
        layers: linear layers with bias, each with what follows it: `ReLU`, `Tanh` or nothing.
        encoder: its layers `car`, `ego` and `pair`; None for a network that reads all values of an observation.
        dueling: whether the outputs are a state value and advantages.
        scale: factors of the outputs [A]; None for 1.
    """

    marked: ClassVar[tuple[str, ...]] = (
        "modules",
        "scale",
        "widths",
        "kinds",
        "last",
        "outputs",
        "features",
        "size",
        "built",
        "passes",
    )
    """What the watch compares (`cavbench.isolation.watch.marks`)."""
    passes: ClassVar[tuple[Callable[..., None], Callable[..., None]]] = kernels.forward, kernels.backward
    """What computes the answers and their gradient."""

    def __init__(
        self,
        network: nn.Module,
        layers: Sequence[tuple[nn.Linear, type[nn.Module] | None]],
        *,
        encoder: tuple[nn.Linear, nn.Linear, nn.Linear] | None = None,
        dueling: bool = False,
        scale: Tensor | None = None,
    ) -> None:
        self.built = tuple(
            (one, type(one), tuple(one._modules.values()), tuple(one._buffers.values()), _shapes(one))
            for one in network.modules()
        )
        linears, kinds = zip(*layers, strict=True)
        self.modules: tuple[nn.Module, ...] = (*(encoder or ()), *linears)
        self.scale = scale
        self.widths = np.array([linears[0].in_features, *(one.out_features for one in linears)], np.int64)
        self.kinds = np.array([ACTIVATIONS[kind] for kind in kinds], np.int64)
        for sizes in (self.widths, self.kinds):
            sizes.setflags(write=False)
        self.outputs = int(self.widths[-1]) - dueling
        car, _, pair = encoder or (None, None, None)
        self.features = car.in_features if car else 0
        self.size, self.kept = self.features or int(self.widths[0]), int(self.widths.sum())
        self.width, self.pooled = (car.out_features, pair.out_features) if car and pair else (0, 0)
        self.last = kernels.DUELING if dueling else kernels.PLAIN if scale is None else kernels.SCALED

    @property
    def dimensions(self) -> int:
        """Dimensions of an observation: [V, F], or [n] without an encoder."""
        return 2 if self.width else 1

    def fits(self, observation: Tensor, *more: Tensor) -> bool:
        """Whether it can answer about observations [..., V, F], or [..., n] without an encoder; it has no other inputs."""
        if more:
            return False
        if observation.dtype != torch.float32 or observation.device.type != "cpu" or torch.compiler.is_compiling():
            return False
        shape = observation.shape
        if shape[-1] != self.size or (self.width and shape[-2] < 2) or torch._C._are_functorch_transforms_active():
            return False
        for module, kind, children, buffers, _ in self.built:
            own = module.__dict__
            # Hooks count who evaluates the network past the oracle, or are of a defence.
            if (
                own["_forward_pre_hooks"]
                or own["_forward_hooks"]
                or own["_backward_hooks"]
                or own["_backward_pre_hooks"]
            ):
                return False
            if type(module) is not kind or "forward" in own or tuple(own["_modules"].values()) != children:
                return False
            if own["_buffers"] and not all(map(operator.is_, own["_buffers"].values(), buffers)):
                return False
        weights = self._weights()
        if any(weight.requires_grad for weight in weights):
            return False
        # Views see whatever is written to a weight, but not that it was replaced by another tensor.
        places = [weight.data_ptr() for weight in weights]
        if places != [view.data_ptr() for view in _VIEWS.get(self, ())]:
            if any(weight.dtype != torch.float32 or weight.device.type != "cpu" for weight in weights):
                return False
            if any(_shapes(module) != shapes for module, *_, shapes in self.built):
                return False
            # 0 times infinity is NaN in torch, and left out here.
            if not all(bool(weight.isfinite().all()) for weight in weights):
                return False
            _VIEWS[self] = [weight.detach().reshape(-1) for weight in weights]
        return True

    def __call__(self, observation: Tensor, *more: Tensor) -> Tensor:
        """The answers [..., A] about inputs that it `fits`, differentiable once in the observations."""
        if observation.requires_grad and torch.is_grad_enabled():
            answer: Tensor = _Pass.apply(observation, self)
            return answer
        return self.forward(observation, keeps=False)[0]

    def keeps(self, observation: Tensor) -> bool:
        """Whether a pass whose gradient may be asked for keeps what that needs."""
        return observation.shape[: -self.dimensions].numel() <= MANY

    def forward(self, observation: Tensor, *, keeps: bool) -> tuple[Tensor, Any]:
        """The answers [..., A], and what the gradient needs besides them (`kernels.forward`)."""
        leading = observation.shape[: -self.dimensions]
        count = leading.numel()
        points = observation.detach().reshape(count, observation.shape[len(leading) :].numel()).contiguous().numpy()
        weights = torch.cat(_VIEWS[self]).numpy()
        blocks = -(-count // kernels.LANES) if keeps else 1
        out = np.empty((count, self.outputs), np.float32)
        given, room = (points, weights, self.form(points.shape[1]), self.widths, self.kinds), self.room(blocks)
        self.passes[0](*given, out, *room)
        return torch.from_numpy(out).view(*leading, self.outputs), (*given, *room)

    def room(self, blocks: int) -> Room:
        """Room for what `kernels.forward` keeps of so many blocks; a single one is used for all."""
        best, chosen = np.empty((2, blocks, self.pooled, kernels.LANES), np.float32)
        return np.empty((blocks, self.kept, kernels.LANES), np.float32), best, chosen

    def backward(self, kept: Any, by_answer: Tensor) -> kernels.Floats:
        """The gradient in the points [N, n], from that in the answers [..., A] and what `forward` gave besides them."""
        points = kept[0]
        by_out = by_answer.detach().reshape(len(points), self.outputs).contiguous().numpy()
        asked = np.flatnonzero(by_out.any(1))
        # A second pass forward costs as much as one backward.
        if len(points) <= len(kept[-1]) * kernels.LANES and 2 * len(asked) > len(points):
            by_points = np.empty_like(points)
            self.passes[1](*kept, by_out, by_points)
            return by_points
        found = np.zeros_like(points)
        if len(asked):
            some = torch.from_numpy(points[asked])
            again = self.forward(some.view(-1, *self._shape(points.shape[1])), keeps=True)[1]
            by_points = np.empty_like(again[0])
            self.passes[1](*again, by_out[asked], by_points)
            found[asked] = by_points
        return found

    def _shape(self, size: int) -> tuple[int, ...]:
        """The shape of an observation of `size` values."""
        return (size // self.features, self.features) if self.dimensions == 2 else (size,)

    def gathered(self) -> Tensor:
        """All weights in one vector, in the order of `kernels.forward`; the parameters become views of it."""
        flat = torch.cat([weight.detach().reshape(-1) for weight in self._weights()])
        for weight, part in self._parts(flat):
            weight.data = part
        return flat

    def assign(self, flat: Tensor) -> None:
        """Copy weights in one vector, as from `gathered`, into the parameters."""
        for weight, part in self._parts(flat):
            weight.data.copy_(part)

    def _parts(self, flat: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        weights = self._weights()
        for weight, part in zip(weights, flat.split([weight.numel() for weight in weights]), strict=True):
            yield weight, part.view_as(weight)

    def form(self, size: int) -> kernels.Form:
        """The network for points of `size` values."""
        rows = size // self.features if self.features else 1
        return kernels.Form(rows, self.features, self.width, self.pooled, self.last)

    def _weights(self) -> list[Tensor]:
        """All weights in the order of `kernels.forward`."""
        own = (weight for module in self.modules for weight in module._parameters.values())
        found: list[Tensor] = [weight for weight in own if weight is not None]
        return found if self.scale is None else [*found, self.scale]


_VIEWS: WeakKeyDictionary[Fused, list[Tensor]] = WeakKeyDictionary()
"""The weights as flat vectors. They are kept apart, so that where they lie in memory is no part of what a network is."""


def _shapes(module: nn.Module) -> list[torch.Size | None]:
    """The shapes of a module's own weights; None for one that it lacks."""
    return [None if weight is None else weight.shape for weight in module._parameters.values()]


def chain(network: object) -> Fused | None:
    """A sequence of layers as a fused network of flat observations [..., n]; None if there is another module among them."""
    found: list[tuple[nn.Linear, type[nn.Module] | None]] = []
    size = None
    for layer in _flat(network):
        kind = type(layer)
        if kind is nn.Flatten and not found and (layer.start_dim, layer.end_dim) == (1, -1):
            continue
        if kind is nn.Linear and layer.bias is not None and size in (None, layer.in_features):
            found.append((layer, None))
            size = layer.out_features
        elif kind in ACTIVATIONS and found and found[-1][1] is None:
            found[-1] = found[-1][0], kind
        else:
            return None
    return Fused(network, found) if found and isinstance(network, nn.Module) else None


def _flat(network: object) -> Iterator[Any]:
    """The modules of a sequence and of the sequences in it, in order; a subclass may do something else."""
    if type(network) is nn.Sequential:
        for one in network:
            yield from _flat(one)
    else:
        yield network


class _Pass(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, observation: Tensor, network: Fused) -> Tensor:
        ctx.shape, ctx.network = observation.shape, network
        answer, ctx.kept = network.forward(observation, keeps=network.keeps(observation))
        return answer

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_answer: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.network.backward(ctx.kept, by_answer)).view(ctx.shape), None
