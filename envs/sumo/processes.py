"""The processes of SUMO's simulations, from the side of the environment."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.sumo import network
from cavbench.envs.sumo.cars import CAR
from cavbench.envs.sumo.roads import Road
from cavbench.envs.sumo.worker import COLUMNS, Command
from cavbench.errors import UserError

PATIENCE_S = 5.0
"""A process that was told to end has this long."""


class Process:
    """One simulation in a process of its own.

    Args:
        layout: of `LAYOUTS`.
        roads: the road of each row [R].
        cars: the most cars of a row, with the ego.

    Raises:
        UserError: if SUMO is not installed, or netconvert fails.
    """

    def __init__(self, layout: str, roads: Sequence[Road], cars: int) -> None:
        network.check_installed()
        self.shape = len(roads), cars, COLUMNS
        self.network = network.network_file(layout, roads)
        files = [layout, str(self.network), str(network.types_file())]
        self.complaints = tempfile.TemporaryFile()  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, "-m", "cavbench.envs.sumo.worker", *files, *map(str, self.shape[:2])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.complaints,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        self.close = weakref.finalize(self, _end, self.process, self.complaints)

    def tell(self, command: Command, records: NDArray[Any]) -> None:
        """Give a command."""
        try:
            assert self.process.stdin is not None
            self.process.stdin.write(command.value + np.int64(len(records)).tobytes() + records.tobytes())
            self.process.stdin.flush()
        except (BrokenPipeError, ValueError):
            raise UserError(self._why()) from None

    def ask(self) -> None:
        """Ask where all cars are; `answer` waits for it."""
        self.tell(Command.TELL, np.empty(0, np.int64))

    def answer(self) -> NDArray[np.float64]:
        """[R, cars, 4] as `COLUMNS`; NaN for cars that are not there."""
        assert self.process.stdout is not None
        size = 8 * int(np.prod(self.shape))
        told = self.process.stdout.read(size)
        if len(told) < size:
            raise UserError(self._why())
        return np.frombuffer(told).reshape(self.shape)

    def _why(self) -> str:
        """What SUMO said before it ended."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(PATIENCE_S)
        self.complaints.seek(0)
        said = network.complaint(self.complaints.read().decode(errors="replace"))
        return f"SUMO has ended: {said}; if its network is damaged, delete {self.network}"


def _end(process: subprocess.Popen[bytes], complaints: Any) -> None:
    """End a simulation: it ends when there are no more commands."""
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            # What was not sent cannot be: the process has ended.
            with suppress(OSError):
                stream.close()
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    complaints.close()


class Processes:
    """Several simulations that hold a batch together, each a part of its rows.

    Args:
        layout: of `LAYOUTS`.
        roads: the road of each episode [B].
        cars: the most cars of an episode, with the ego.
        count: number of processes; at most one an episode is made.
    """

    def __init__(self, layout: str, roads: Sequence[Road], cars: int, count: int) -> None:
        self.parts = [part for part in np.array_split(np.arange(len(roads)), count) if len(part)]
        self.processes = [Process(layout, [roads[row] for row in part], cars) for part in self.parts]

    def close(self) -> None:
        """End them."""
        for process in self.processes:
            process.close()

    def create(self, cars: NDArray[np.void]) -> None:
        """Put cars (`CAR`) on their roads."""
        for process, part in zip(self.processes, self.parts, strict=True):
            own = cars[(cars["row"] >= part[0]) & (cars["row"] <= part[-1])].astype(CAR)
            own["row"] -= part[0]
            process.tell(Command.CREATE, own)

    def remove(self, rows: NDArray[np.int64]) -> None:
        """Take all cars of some rows off the road."""
        for process, part in zip(self.processes, self.parts, strict=True):
            own = rows[(rows >= part[0]) & (rows <= part[-1])]
            if len(own):
                process.tell(Command.REMOVE, own - part[0])

    def step(self, egos: NDArray[np.float64]) -> NDArray[np.float64]:
        """One step of all; see `Command.STEP`.

        Args:
            egos: [B, 4].

        Returns:
            [B, cars, 4] as `COLUMNS`; NaN for cars that are not there.
        """
        for process, part in zip(self.processes, self.parts, strict=True):
            process.tell(Command.STEP, egos[part])
            process.ask()
        return self._answers()

    def state(self) -> NDArray[np.float64]:
        """[B, cars, 4] where the cars are."""
        for process in self.processes:
            process.ask()
        return self._answers()

    def _answers(self) -> NDArray[np.float64]:
        return np.concatenate([process.answer() for process in self.processes])
