"""A plug-in whose attacks and defences bend the rules unseen, each in one way: none of it may change a score without a word."""

from __future__ import annotations

import os
import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from toy_plugin import ToyWorld  # type: ignore[import-not-found]

import cavbench.driving.probes
from cavbench.core.contracts import Access
from cavbench.core.ranges import Natural
from cavbench.driving import (
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    Oracle,
    Policy,
    PolicyWrapper,
    State,
)

Deed = Literal[
    "none",
    "features",
    "threat",
    "observation",
    "parts",
    "self",
    "itself once",
    "own class",
    "world class",
    "constant",
    "global",
    "list",
    "tensor",
    "environment",
    "cache",
    "attribute",
    "default",
    "npz",
    "torch file",
    "temporary",
    "package",
    "caught",
    "shared",
    "reads",
    "harmless files",
]
MEMORY: dict[str, int] = {}
SEEN: list[int] = []
COUNT = torch.zeros(1)
FAR = 1.6


@cache
def cached() -> list[int]:
    return []


def attributed(kept: list[int] = []) -> list[int]:  # noqa: B006
    return kept


def scaled(features: Any) -> None:
    for name in ("low", "high"):
        object.__setattr__(features, name, tuple(FAR * value for value in getattr(features, name)))


@dataclass(frozen=True, kw_only=True)
class Bends(DrivingAttack):
    """Moves every value by half of the radius; by all of it, once its memory says that it was here before.

    Args:
        deed: what it does beside that.
        draw: number of the draw.
    """

    access: ClassVar[Access] = "oblivious"
    visits: ClassVar[dict[str, int]] = {}
    deed: Deed = "none"
    draw: Natural = 0

    def initial(self, observation: Tensor, oracle: Oracle) -> Any:
        return TensorDict({"known": torch.full((len(observation),), self.remembered())}, batch_size=[len(observation)])

    @cached_property
    def once(self) -> list[int]:
        return []

    def remembered(self) -> bool:
        """Whether a memory of its own says that it drove before; it does from now on."""
        match self.deed:
            case "self":
                found = getattr(self, "_memo", False)
                object.__setattr__(self, "_memo", True)
            case "itself once":
                found = bool(self.once)
                self.once.append(1)
            case "own class":
                found = bool(self.visits)
                self.visits["here"] = 1
            case "global":
                found = "here" in MEMORY
                MEMORY["here"] = 1
            case "list":
                found = bool(SEEN)
                SEEN.append(1)
            case "tensor":
                found = bool(COUNT)
                COUNT.fill_(1)
            case "environment":
                found = "BENDS" in os.environ
                os.environ["BENDS"] = "1"
            case "cache":
                found = bool(cached())
                cached().append(1)
            case "attribute":
                found = hasattr(attributed, "here")
                attributed.here = True  # type: ignore[attr-defined]
            case "default":
                found = bool(attributed())
                attributed().append(1)
            case "npz" | "torch file" | "temporary" | "package" | "caught" | "shared" | "reads" | "harmless files":
                found = self.filed()
            case _:
                found = False
        return found

    def filed(self) -> bool:
        """Whether a file says so."""
        home = Path(__file__).parent
        match self.deed:
            case "npz":
                np.savez("memo.npz", here=1)
            case "torch file":
                torch.save({"here": 1}, "memo.pt")
            case "temporary":
                Path("/tmp/bends-memo").write_text("here")
            case "package":
                (home / "memo.txt").write_text("here")
            case "caught":
                with suppress(BaseException):
                    os.mkdir("memo")
            case "shared":
                SharedMemory("bends-memo", create=True, size=1).close()
            case "reads":
                return "here" in Path("kept.txt").read_text()
            case "harmless files":
                with tempfile.NamedTemporaryFile("w") as file:
                    file.write("here")
                with open(os.devnull, "w") as file:
                    file.write("here")
                warnings.warn(Path(__file__).read_text()[:20], stacklevel=1)
        return False

    def step(self, observation: Tensor, oracle: Oracle, state: Any) -> tuple[Tensor, Any]:
        features, answer = (
            oracle.features,
            observation + torch.where(state["known"], 1.0, 0.5)[:, None, None] * oracle.radius,
        )
        match self.deed:
            case "features":
                if max(features.high) < 15:
                    scaled(features)
            case "threat":
                object.__setattr__(oracle.threat, "budget", 2.0)
                object.__setattr__(oracle.threat, "norm", "linf")
            case "observation":
                observation[..., 1:] = 0.0
                oracle.observation.zero_()
                oracle.radius.fill_(1.0)
            case "parts":
                oracle.parts[0].generator.manual_seed(1)
            case "world class":
                if max(ToyWorld.features.high) < 15:
                    scaled(ToyWorld.features)
            case "constant":
                cavbench.driving.probes.EVERY = 10**9
        return answer, state


@dataclass(frozen=True, kw_only=True)
class Shrinks(DrivingDefense):
    """Changes what it is given to load, and nothing else.

    Args:
        deed: what it changes.
    """

    deed: Literal["none", "floors", "ranges", "axes", "victim", "kinematics"] = "none"

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        policy = victim.load(seed, facts)
        match self.deed:
            case "floors":
                object.__setattr__(facts.features, "floors", (0.0, 0.0))
            case "ranges":
                scaled(facts.features)
            case "axes":
                object.__setattr__(facts.axes, "axes", ())
                facts.axes._by_name.clear()
            case "kinematics":
                object.__setattr__(facts, "max_steps", 1)
            case "victim":
                object.__setattr__(victim, "actions", "continuous")
        return policy


class Scribbling(PolicyWrapper):
    """Writes what it is asked to a file, from the first question on."""

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        Path("memo").write_text(str(observation.sum()))
        return self.policy.scores(observation, state)


@dataclass(frozen=True, kw_only=True)
class Scribbles(DrivingDefense):
    """Keeps a file."""

    def load(self, victim: DrivingVictim, seed: int, facts: DrivingFacts) -> Policy:
        return Scribbling(victim.load(seed, facts)).eval()
