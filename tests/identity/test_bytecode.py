"""An object of Python has another fingerprint if anything that it computes with is another: no old score is taken for it."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import cavbench
from cavbench.envs.highway.world import HighwayWorld
from cavbench.identity.bytecode import content_of
from cavbench.identity.content import content

NUMBER: Any = 1.0


class Reads(nn.Module):
    """Reads a global value."""

    def forward(self, shown: Tensor) -> Tensor:
        return NUMBER * shown[:, 0]


class Holds(nn.Module):
    def __init__(self, held: Any) -> None:
        super().__init__()
        self.held = held

    def forward(self, shown: Tensor) -> Tensor:
        return self.held * shown[:, 0]


class Thing:
    def __init__(self, number: float) -> None:
        self.number = number


class Slotted:
    __slots__ = ("number",)

    def __init__(self, number: float) -> None:
        self.number = number


def made(number: float) -> nn.Module:
    class Closed(nn.Module):
        def forward(self, shown: Tensor) -> Tensor:
            return number * shown[:, 0]

    return Closed()


def linear(number: float) -> nn.Module:
    layer = nn.Linear(5, 5)
    with torch.no_grad():
        for weight in layer.parameters():
            weight.fill_(number)
    return layer


HELD: dict[str, Callable[[float], Any]] = {
    "number": float,
    "list": lambda number: [number],
    "array": lambda number: np.full(3, number),
    "long tensor": lambda number: torch.cat((torch.zeros(5000), torch.tensor([number]), torch.zeros(5000))),
    "dictionary": lambda number: {"a": {"b": number}},
    "set": lambda number: {number, 7.0},
    "object": Thing,
    "slots": Slotted,
    "network in a list": lambda number: [linear(number)],
    "function": lambda number: (lambda value: value) if number > 1 else (lambda value: -value),
    "closure": lambda number: lambda: number,
    "generator": lambda number: torch.Generator().manual_seed(int(number)),
}


@pytest.mark.parametrize("kind", HELD)
def test_what_an_object_holds_is_in_its_fingerprint(kind: str) -> None:
    first, again, other = (content_of(Holds(HELD[kind](number))) for number in (1.0, 1.0, 2.0))
    assert first == again
    assert first != other


@pytest.mark.parametrize("kind", HELD)
def test_what_code_reads_is_in_its_fingerprint(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for number in (1.0, 1.0, 2.0):
        monkeypatch.setattr(sys.modules[__name__], "NUMBER", HELD[kind](number))
        found.append(content_of(Reads()))
    assert found[0] == found[1] != found[2]


def test_what_a_function_encloses_is_in_its_fingerprint() -> None:
    assert content_of(made(1.0)) == content_of(made(1.0)) != content_of(made(2.0))


def test_a_value_that_holds_itself_has_a_hash() -> None:
    ring: list[Any] = [1]
    ring.append(ring)
    assert content(ring) == content(ring)


@pytest.mark.parametrize("call", ["from helper import scaled\n", "import helper\nscaled = None\n"])
def test_code_in_another_file_of_the_user_is_in_the_fingerprint(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    used = "scaled" if call.startswith("from") else "helper.scaled"
    found = []
    for number in (1, 1, 2):
        (tmp_path / "helper.py").write_text(f"def scaled(value):\n    return {number} * value\n")
        (tmp_path / "mine.py").write_text(
            f"from torch import nn\n{call}\nclass Mine(nn.Module):\n    def forward(self, x):\n        return {used}(x)\n"
        )
        for name in ("helper", "mine"):
            sys.modules.pop(name, None)
            (tmp_path / "__pycache__").exists() and [one.unlink() for one in (tmp_path / "__pycache__").iterdir()]
        importlib.invalidate_caches()
        found.append(content_of(importlib.import_module("mine").Mine()))
    assert found[0] == found[1] != found[2]


def test_another_network_under_the_same_name_is_driven_again(tmp_path: Path) -> None:
    options: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 1, "baselines": False}

    def score(number: float) -> float:
        found = cavbench.score(
            Held(number), "none", world=HighwayWorld(max_steps=15), out=tmp_path, name="mine", **options
        )
        return float(found.records["mean_speed"].mean())

    assert score(1.0) == score(1.0) != score(-1.0)


class Held(nn.Module):
    """Prefers FASTER or SLOWER, by a number in a list."""

    def __init__(self, number: float) -> None:
        super().__init__()
        self.numbers = [number]

    def forward(self, shown: Tensor) -> Tensor:
        return self.numbers[0] * torch.tensor([0.0, 0.0, 0.0, 1.0, -1.0]) + 0 * shown[:, 0]
