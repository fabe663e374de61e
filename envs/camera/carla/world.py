"""The CARLA world: where its server is, and how to reach it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from bench.errors import UserError
from bench.plugins.registry import unknown
from bench.scenarios.grid import WEATHERS, Cell
from envs.camera.carla.texture import WHOLE, Region
from envs.camera.street.layout import LOCATIONS

if TYPE_CHECKING:
    import carla

    from envs.camera.carla.scenes import CarlaScenes


@dataclass(frozen=True, kw_only=True)
class CarlaWorld:
    """Approaches to a stop sign of the map that a CARLA 0.9.16 server shows.

    Args:
        host, port: of the server; it uses the next port too.
        timeout_s: how long an answer may take, in seconds.
        sign: part of the name of the stop sign among the map's objects; the first by name is taken.
        face_region: where the sign's texture shows its face (`texture.Region`).
        sun_azimuth_zero_deg: yaw, as Unreal counts it, at which the sun stands when CARLA's sun azimuth is 0.
        time_step_s: simulated time of a tick in seconds.
        settle_ticks: before each picture, for the automatic exposure and the temporal anti-aliasing.

    Raises:
        ValueError: if a field is out of its range.
    """

    host: str = "127.0.0.1"
    port: int = 2000
    timeout_s: float = 20.0
    sign: str = "BP_Stop"
    face_region: Region = WHOLE
    sun_azimuth_zero_deg: float = 0.0
    time_step_s: float = 0.05
    settle_ticks: int = 20

    def __post_init__(self) -> None:
        if not self.host:
            raise ValueError("host must not be empty")
        if not 1 <= self.port <= 65534:
            raise ValueError(f"port must be between 1 and 65534, got {self.port}")
        if not 0 < self.timeout_s < math.inf:
            raise ValueError(f"timeout_s must be a positive number of seconds, got {self.timeout_s}")
        if not self.sign:
            raise ValueError("sign must not be empty")
        u1, v1, u2, v2 = self.face_region
        if not all(0 <= edge <= 1 for edge in self.face_region) or min(abs(u2 - u1), abs(v2 - v1)) < 0.01:
            raise ValueError(f"face_region must be u1, v1, u2, v2 in [0, 1] with an area, got {self.face_region}")
        if not math.isfinite(self.sun_azimuth_zero_deg):
            raise ValueError(f"sun_azimuth_zero_deg must be finite, got {self.sun_azimuth_zero_deg}")
        if not 0 < self.time_step_s <= 0.1:
            raise ValueError(f"time_step_s must be in (0, 0.1], as CARLA's physics needs, got {self.time_step_s}")
        if self.settle_ticks < 0:
            raise ValueError(f"settle_ticks must be at least 0, got {self.settle_ticks}")

    def connect(self) -> carla.Client:
        """A client that has spoken with the server.

        Raises:
            UserError: if the package is missing, no server answers, or its version is not the package's.
        """
        try:
            import carla
        except ImportError as error:
            raise UserError(f"the CARLA world needs its client ({error}): pip install cavbench[carla]") from error
        with self.answering():
            client = carla.Client(self.host, self.port)
            client.set_timeout(self.timeout_s)
            ours, theirs = client.get_client_version(), client.get_server_version()
        if ours != theirs:
            raise UserError(
                f"the CARLA server at {self.host}:{self.port} is {theirs}, the client {ours}: start a {ours} server"
            )
        return client

    @contextmanager
    def answering(self) -> Iterator[None]:
        """Turns what the client says when the server does not answer or refuses into one line.

        Raises:
            UserError: instead of the client's `RuntimeError`.
        """
        try:
            yield
        except RuntimeError as error:
            said = " ".join(str(error).split())
            raise UserError(f"the CARLA server at {self.host}:{self.port} failed: {said}") from error

    def scenes(self, cell: Cell, location: str) -> CarlaScenes:
        """The ten frames of an approach, and its ground truth, for which the server is asked at once.

        Args:
            cell: lanes, density and weather.
            location: a name in `LOCATIONS`, which gives the sun's direction and the traffic.

        Raises:
            UserError: as `connect` does, for an unknown location, by night, or where the map has no such sign.
        """
        if location not in LOCATIONS:
            raise UserError(unknown(f"location {location!r}", location, LOCATIONS))
        if WEATHERS[cell.weather].sun_elevation_deg < 0:
            raise UserError(f"the CARLA world has no headlights for {cell.weather!r}: take a weather with the sun up")
        client = self.connect()
        from envs.camera.carla.scenes import CarlaScenes

        return CarlaScenes(self, client, cell, LOCATIONS[location])
