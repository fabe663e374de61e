"""A plug-in whose attacks and victims misbehave, each in one way, while a unit is driven."""

from __future__ import annotations

import ctypes
import gc
import os
import random
import resource
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor
from toy_plugin import ToyPolicy, ToyVictim

import cavbench.driving.meter
from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, DrivingFacts, Oracle, Policy, State

Deed = Literal[
    "none",
    "system exit",
    "interrupt",
    "generator exit",
    "os exit",
    "segfault",
    "hang",
    "leak",
    "memory error",
    "nan",
    "shape",
    "weights",
    "reseed",
    "greedy",
    "print",
    "patch torch",
    "patch bench",
    "limit",
    "unprintable",
    "print much",
    "fork",
    "fork and stay",
    "leak in a session",
    "leak in memory files",
    "leak in temporary files",
    "leave a thread",
]


@dataclass(frozen=True, kw_only=True)
class Rogue(DrivingAttack):
    """Nudges by a tenth of the radius, after its deed.

    Args:
        deed: what it does wrong.
    """

    access: ClassVar[Access] = "scores"
    deed: Deed = "none"

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        match self.deed:
            case "system exit":
                sys.exit(0)
            case "interrupt":
                raise KeyboardInterrupt
            case "generator exit":
                raise GeneratorExit
            case "os exit":
                os._exit(0)
            case "segfault":
                ctypes.string_at(0)
            case "hang":
                while True:
                    time.sleep(0.01)
            case "leak":
                kept = []
                while True:
                    kept.append(bytearray(os.urandom(1 << 20) * 64))
            case "memory error":
                raise MemoryError
            case "nan":
                return observation * float("nan")
            case "shape":
                return observation[..., :1]
            case "weights":
                for one in gc.get_objects():
                    if isinstance(one, ToyPolicy):
                        one.weights.zero_()
            case "reseed":
                for seed in (torch.manual_seed, np.random.seed, random.seed):
                    seed(1)
            case "greedy":
                for _ in range(5):
                    oracle.scores(observation)
            case "print":
                print("hello from rogue")  # noqa: T201
                os.write(1, b"and from below\n")
                print("complaint", file=sys.stderr)  # noqa: T201
            case "patch torch":
                torch.Tensor.tanh = lambda tensor: tensor  # type: ignore[method-assign,assignment]
            case "patch bench":
                cavbench.driving.meter.Meter.columns = lambda meter: {}  # type: ignore[method-assign,assignment]
            case "limit":
                resource.setrlimit(resource.RLIMIT_NOFILE, (3, 3))
            case "unprintable":
                raise UnprintableError
            case "print much":
                for _ in range(100):
                    os.write(1, b"x" * 20_000)
            case "fork":
                forked()
            case "fork and stay":
                if (copy := forked()) == 0:
                    time.sleep(600)
                print(f"copy {copy}")  # noqa: T201
            case "leak in a session":
                orphan()
                time.sleep(60)
            case "leak in memory files":
                for _ in range(40):
                    os.write(memory_file(), bytes(1 << 26))
                time.sleep(60)
            case "leak in temporary files":
                with tempfile.TemporaryFile() as unnamed, tempfile.NamedTemporaryFile() as named:
                    for file in (unnamed, named):
                        os.posix_fallocate(file.fileno(), 0, 1 << 30)
                    time.sleep(60)
            case "leave a thread":
                leave_a_thread()
        return observation + 0.1 * oracle.radius


@cache
def forked() -> int:
    """Copy this process, once."""
    return os.fork()


@cache
def memory_file() -> int:
    return os.memfd_create("rogue")


ORPHAN = """
import os, time
kept = []
print("orphan", os.getpid(), flush=True)
while len(kept) < 40:
    kept.append(os.urandom(1 << 20) * 64)
    time.sleep(0.02)
time.sleep(60)
"""


@cache
def orphan() -> None:
    """Start a process whose parent ends, in a session of its own, that fills the memory."""
    between = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', sys.argv[1]], start_new_session=True)"
    subprocess.run([sys.executable, "-c", between, ORPHAN], start_new_session=True, check=True)


@cache
def leave_a_thread() -> None:
    """A thread that fills memory when the unit is over."""

    def fill() -> None:
        time.sleep(2)
        kept = []
        while True:
            kept.append(bytearray(os.urandom(1 << 20) * 64))

    threading.Thread(target=fill, daemon=True).start()


class UnprintableError(Exception):
    """Ends the process when it is written."""

    def __str__(self) -> str:
        sys.exit(0)


class BadPolicy(ToyPolicy):
    """Answers NaN, or too few scores."""

    def __init__(self, answer: str, seed: int) -> None:
        super().__init__("discrete", seed)
        self.answer = answer

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        scores = super().scores(observation, state)
        return scores * float("nan") if self.answer == "nan" else scores[..., :2]


@dataclass(frozen=True, kw_only=True)
class BadVictim(ToyVictim):
    """A victim that cannot answer.

    Args:
        answer: what is wrong with it.
    """

    answer: Literal["nan", "shape"] = "nan"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return BadPolicy(self.answer, seed).eval()
