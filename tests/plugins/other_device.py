"""A device in software: its tensors compute on the processor, and refuse to be mixed with tensors that are not on it.

Numbers are therefore those of the processor, to the last bit, and whatever would fail on a GPU for want of a copy fails here.
Run as a program with the name of a case (`CASES`): torch takes a new device only before its first backward pass.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_iter, tree_map_only
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from cavbench.core.pair import Pair, choose
from cavbench.core.track import Job
from cavbench.detection.crafting import prepare
from cavbench.detection.drive import drive as score_patch
from cavbench.detection.patch import Patch
from cavbench.detection.threat import PatchThreat
from cavbench.driving.drive import drive
from cavbench.driving.fused.network import Fused
from cavbench.driving.threat import ObservationThreat
from cavbench.envs.highway.axes import AXES

NAME = "elsewhere"
BOTH = {"_to_copy", "copy_", "index", "index_put_", "_index_put_impl_"}
"""Operations that torch allows on tensors of two devices: copies, and indices from the processor."""


class There(Tensor):
    """A tensor on the device; `here` holds its values."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        made = Tensor._make_wrapper_subclass(
            cls, here.size(), strides=here.stride(), dtype=here.dtype, device=torch.device(NAME, 0)
        )
        made.here = here
        return made

    def __init__(self, here: Tensor) -> None:
        pass

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        given = [one for one in tree_iter((args, kwargs)) if isinstance(one, Tensor)]
        mixed = [one for one in given if not isinstance(one, There) and one.ndim]
        if mixed and name not in BOTH:
            raise RuntimeError(f"{func} mixes tensors of {NAME} and of the processor")
        device = kwargs.pop("device", None)
        found = func(*tree_map_only(There, _here, args), **tree_map_only(There, _here, kwargs))
        if name == "copy_":
            return args[0]
        if device is not None and device.type == "cpu":
            return found
        return return_and_correct_aliasing(func, args, kwargs, tree_map_only(Tensor, There, found))


def _here(tensor: There) -> Tensor:
    return tensor.here


class _Module(_DummyBackendModule):  # type: ignore[misc]
    def synchronize(self, device: object = None) -> None:
        """Every operation is finished when it returns."""


def install() -> None:
    """Make the device known to torch."""
    _setup_privateuseone_for_python_backend(NAME, _Module())
    library = torch.library.Library("aten", "IMPL")

    def empty(size: Any, dtype: Any = None, **others: Any) -> Tensor:
        return There(torch.empty(size, dtype=dtype))

    def strided(size: Any, stride: Any, dtype: Any = None, **others: Any) -> Tensor:
        return There(torch.empty_strided(size, stride, dtype=dtype))

    def copied(source: Tensor, target: There, non_blocking: bool = False) -> Tensor:
        target.here.copy_(source.here if isinstance(source, There) else source)
        return target

    for name, function in (("empty.memory_format", empty), ("empty_strided", strided), ("_copy_from", copied)):
        library.impl(name, function, "PrivateUse1")
    _kept.append(library)


_kept: list[object] = []


def driver(victim: str, defense: str, attack: str) -> None:
    """Drive a pair on the device and on the processor."""
    pair = Pair(
        attack=choose("attack", attack, **({"steps": 2} if attack == "pgd" else {})),
        defense=choose("defense", defense),
        victim=choose("victim", victim),
        world=choose("world", "highway", max_steps=3),
        threat=ObservationThreat(access="gradients", norm="linf", budget=0.1),
    )
    cell = AXES.cell(lanes=3, density=2.0, weather="rain")
    job = Job(pair=pair, training_seed=0, attack_seed=7, cell=cell, seeds=range(1_000_000, 1_000_004), entropy=5)
    # On the processor a small network is compiled, and adds in another order than torch.
    Fused.fits = lambda *_: False  # type: ignore[method-assign]
    here, there = (drive(replace(job, device=device), ()).columns for device in ("cpu", NAME))
    for name in here.keys() - {"attack_ms"}:
        np.testing.assert_array_equal(here[name], there[name], name)
    assert attack == "none" or here["linf_max"].max() > 0


def detector(victim: str, defense: str) -> None:
    """Craft a patch and score it, on the device and on the processor."""
    pair = Pair(
        attack=choose("attack", "eot", steps=2, batch=2, window=96, texels=16),
        defense=choose("defense", defense),
        victim=choose("victim", victim),
        world=choose("world", "camera"),
        threat=PatchThreat(),
    )
    cell = pair.world.component.axes.cell(lanes=3, density=1.0, weather="fog")
    job = Job(pair=pair, training_seed=0, attack_seed=7, cell=cell, seeds=range(1_000_000, 1_000_001), entropy=5)
    found = []
    for device in ("cpu", NAME):
        own = replace(job, device=device)
        patch = prepare(own, "a test", lambda share, text: None)
        found.append(score_patch(own, patch, ()).columns)
        assert Patch.read(patch).gradients == 4
    # A backward pass may add in another order.
    here, there = (one["frame_confidence"] for one in found)
    np.testing.assert_allclose(here, there, atol=0.01)
    assert here.max() > 0.2


CASES: dict[str, Callable[[], None]] = {
    "drivers": lambda: [driver(*case) for case in DRIVERS],  # type: ignore[func-returns-value]
    "detectors": lambda: [detector(*case) for case in DETECTORS],  # type: ignore[func-returns-value]
}
DRIVERS = (
    ("dqn", "advtrain", "zo"),
    ("dqn", "tracker+shield", "pgd"),
    ("ddpg", "shield", "pgd"),
    ("planner", "tracker", "noise"),
    ("dqn", "frame_stack", "pgd"),
    ("random", "none", "none"),
)
DETECTORS = (("rcnn", "jpeg"),)


if __name__ == "__main__":
    install()
    for name in sys.argv[1:]:
        CASES[name]()
        sys.stdout.write(f"{name}: the same on {NAME}\n")
