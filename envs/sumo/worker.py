"""The process of one SUMO simulation: libsumo has one in a process, and a second start closes the first one.

    python -m cavbench.envs.sumo.worker LAYOUT NETWORK TYPES ROWS CARS

It reads commands from its standard input and answers on its standard output, in numbers of numpy (`Command`).
"""

from __future__ import annotations

import os
import sys
from array import array
from enum import Enum
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from cavbench.envs.sumo.cars import CAR, PERIOD_MS, Model
from cavbench.envs.sumo.layouts import LAYOUTS, Layout


class Command(Enum):
    """What the simulation is asked to do: a byte, a count of records (int64), and the records."""

    CREATE = b"c"
    """`CAR` records: put cars on their roads, at once."""
    REMOVE = b"r"
    """int64 rows: take all their cars off the road."""
    STEP = b"s"
    """float64 [rows, 4]: where the egos will be, or NaN for those that SUMO drives or that are not there; then one step."""
    TELL = b"t"
    """No records: answer where all cars are."""


COLUMNS = 4
"""x and y of the front bumper in m, speed in m/s, and angle in degrees clockwise from north, as SUMO has them."""
ABSENT = (float("nan"),) * COLUMNS
CLEAR = 4.0
"""m before a junction without a car at the start: one that is put there stops at once, because it has not asked for its way."""


def arguments(network: str, cars: str) -> list[str]:
    """SUMO's command line."""
    options = {
        "--net-file": network,
        "--additional-files": cars,
        "--step-length": f"{PERIOD_MS / 1000:g}",
        "--step-method.ballistic": "true",
        "--lateral-resolution": "0.8",
        "--time-to-teleport": "-1",
        # Collisions are our own: SUMO's are small gaps, and it does not look beside a car that is moved from outside.
        "--collision.action": "none",
        "--default.speeddev": "0",
        "--xml-validation": "never",
        "--no-step-log": "true",
        "--no-warnings": "true",
    }
    return ["sumo", *(word for option in options.items() for word in option)]


class Simulation:
    """libsumo with one road a row, and what is known of its cars.

    Args:
        sumo: the module libsumo, started.
        layout: of the roads.
        rows: roads.
        cars: the most cars of one, with the ego.
    """

    def __init__(self, sumo: Any, layout: Layout, rows: int, cars: int) -> None:
        self.sumo, self.vehicle, self.layout = sumo, sumo.vehicle, layout
        self.routes = [layout.routes(row) for row in range(rows)]
        self.names: list[list[str | None]] = [[None] * cars for _ in range(rows)]
        self.places: dict[str, tuple[int, int]] = {}
        self.serial = 0
        self.lengths: dict[str, tuple[float, float]] = {}
        for row in range(rows):
            for number, edges in enumerate(self.routes[row]):
                sumo.route.add(_route(row, number), edges)

    def create(self, cars: NDArray[np.void]) -> None:
        """Put cars on their roads."""
        for car in cars:
            row, number, route = int(car["row"]), int(car["number"]), int(car["route"])
            self.serial += 1
            name = f"{row}.{number}.{self.serial}"
            self.vehicle.add(name, _route(row, route), typeID=Model(car["model"]).name)
            # A car that is only added departs later, where SUMO has room for it.
            self.vehicle.moveTo(name, *self._place(row, route, int(car["lane"]), float(car["front"])))
            # Without an acceleration it goes on with that which takes it from 0 to this speed.
            self.vehicle.setPreviousSpeed(name, float(car["speed"]), 0.0)
            if car["model"] == Model.EGO:
                self.vehicle.setLaneChangeMode(name, 0)
            else:
                self.vehicle.setMaxSpeed(name, float(car["desired"]))
            self.names[row][number] = name
            self.places[name] = row, number

    def _place(self, row: int, route: int, lane: int, front: float) -> tuple[str, float]:
        """SUMO's lane, and m along it. A place on a junction is moved to the nearest one off it."""
        lanes = self.sumo.edge.getLaneNumber(self.routes[row][route][0])
        stretches = self.layout.stretches(row, route, lane, lanes)
        if front < 0:
            return stretches[0], self._extent(stretches[0])[1] + front
        nearest = float("inf")
        for stretch in stretches:
            begin, length = self._extent(stretch)
            along = min(max(front - begin, 0.0), length - CLEAR)
            if abs(begin + along - front) < nearest:
                nearest, found = abs(begin + along - front), (stretch, along)
        return found

    def _extent(self, lane: str) -> tuple[float, float]:
        """x where a lane begins, and its length, in m."""
        if lane not in self.lengths:
            self.lengths[lane] = self.sumo.lane.getShape(lane)[0][0], self.sumo.lane.getLength(lane)
        return self.lengths[lane]

    def remove(self, rows: NDArray[np.int64]) -> None:
        """Take all cars of some rows off the road."""
        for row in rows.tolist():
            for number, name in enumerate(self.names[row]):
                if name is not None:
                    self.vehicle.remove(name)
                    del self.places[name]
                    self.names[row][number] = None

    def step(self, egos: NDArray[np.float64]) -> None:
        """Move the egos, and all others for one step; they see the egos where they were."""
        for row in np.flatnonzero(np.isfinite(egos[:, 0])).tolist():
            x, y, _, angle = egos[row].tolist()
            self.vehicle.moveToXY(self.names[row][0], "", -1, x, y, angle, 1)
        self.sumo.simulationStep()
        for name in self.sumo.simulation.getArrivedIDList():
            if name in self.places:
                row, number = self.places.pop(name)
                self.names[row][number] = None

    def state(self) -> bytes:
        """float64 [rows, cars, 4]: `COLUMNS` of all cars, NaN for those that are not there."""
        values = array("d")
        position, speed, angle = self.vehicle.getPosition, self.vehicle.getSpeed, self.vehicle.getAngle
        for names in self.names:
            for name in names:
                values.extend(ABSENT if name is None else (*position(name), speed(name), angle(name)))
        return values.tobytes()


def _route(row: int, number: int) -> str:
    """The name of a route."""
    return f"{row}.{number}"


def read(stream: BinaryIO, kind: Any) -> NDArray[Any]:
    """The records of a command."""
    count = int(np.frombuffer(stream.read(8), np.int64)[0])
    kind = np.dtype(kind)
    return np.frombuffer(stream.read(count * kind.itemsize), kind)


def serve(simulation: Simulation, commands: BinaryIO, answers: BinaryIO) -> None:
    """Carry out commands until there are no more."""
    while word := commands.read(1):
        match Command(word):
            case Command.CREATE:
                simulation.create(read(commands, CAR))
            case Command.REMOVE:
                simulation.remove(read(commands, np.int64))
            case Command.STEP:
                simulation.step(read(commands, (np.float64, COLUMNS)))
            case Command.TELL:
                read(commands, np.int64)
                answers.write(simulation.state())


def main() -> None:
    """Start SUMO, and serve."""
    answers = os.fdopen(os.dup(1), "wb", 0)
    # SUMO writes to its standard output, too.
    os.dup2(2, 1)
    import libsumo

    layout, network, cars, *sizes = sys.argv[1:]
    try:
        libsumo.start(arguments(network, cars))
        serve(Simulation(libsumo, LAYOUTS[layout], *map(int, sizes)), sys.stdin.buffer, answers)
    except libsumo.TraCIException as error:
        print(f"Error: {error}", file=sys.stderr, flush=True)  # noqa: T201
        # An end of Python may wait for SUMO, which has none after an error.
        os._exit(1)
    libsumo.close()


if __name__ == "__main__":
    main()
