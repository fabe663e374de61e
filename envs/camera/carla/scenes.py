"""An approach to a stop sign of a CARLA map as frames that a patch can be scored on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import carla
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bench.detection.contracts import Scenes
from bench.errors import UserError
from bench.scenarios.grid import WEATHERS, Cell
from envs.camera.camera import Array, Camera
from envs.camera.carla import capture
from envs.camera.carla.geometry import stand
from envs.camera.carla.texture import laid_out, stuck_on
from envs.camera.carla.weather import parameters
from envs.camera.carla.world import CarlaWorld
from envs.camera.poses import approach
from envs.camera.street.layout import Location, sign_x, traffic
from envs.camera.street.light import lighting

_Take = Callable[[int], tuple[NDArray[np.float32], Array]]


class CarlaScenes(Scenes):
    """The ten frames of an approach, farthest first, and what is true of them.

    The server is in synchronous mode, in the cell's weather and with our actors in it only while frames are taken: when this
    is made, and in each `render`. Its settings and weather are restored each time, and the sign gets the plain face, which is
    also what "as it is" means here: the map's own texture cannot be read back.

    Args:
        world: the server and how its sign is textured.
        client: of that server.
        cell: lanes, density and weather.
        location: whose sun and traffic are taken.

    Raises:
        UserError: if the map has no such sign, or the server fails.
    """

    def __init__(self, world: CarlaWorld, client: carla.Client, cell: Cell, location: Location) -> None:
        self._world, self._client, self._cell, self._location = world, client, cell, location
        weather = WEATHERS[cell.weather]
        poses = approach(location.name, cell.lanes, cell.density, lighting(weather))
        with world.answering():
            self._server = client.get_world()
            self._map = self._server.get_map()
            self._sign, vertices = self._find()
            lane = self._map.get_waypoint(_location(vertices.mean(0))).transform
            self._place, self._face = stand(
                vertices, road_yaw_deg=lane.rotation.yaw, road_z=lane.location.z, sign_x=sign_x(cell.lanes)
            )
            cameras = [self._on_the_road(pose.camera) for pose in poses]
        self._cameras = cameras
        sun = self._place.yaw_deg + location.sun_azimuth_deg - world.sun_azimuth_zero_deg
        self._weather = parameters(weather, sun)
        self._traffic = traffic(location, cell.lanes, cell.density)
        self.size = (cameras[0].height, cameras[0].width)
        self.boxes = torch.tensor(np.stack([self._face.box(camera) for camera in cameras]), dtype=torch.float32)
        self.distance = torch.tensor([pose.distance for pose in poses])
        with self._taking() as (_, take):
            shares = [self._face.visible(camera, take(n)[1]) for n, camera in enumerate(cameras)]
        self.visible = torch.tensor(shares)

    def render(self, frames: Tensor, patches: Tensor | None, share: float) -> Tensor:
        """Pictures [N, 3, H, W] sRGB in [0, 1], one tick each; without gradients, so patches may not ask for any.

        Args:
            frames: int64 [N], which frames.
            patches: [N, 3, P, P], or [1, 3, P, P] for the same in all; None for the plain face.
            share: side of the patch in shares of the sign's, in (0, 1].

        Raises:
            UserError: if the patches require gradients, or the server fails.
        """
        if patches is not None and patches.requires_grad:
            raise UserError(
                "CARLA gives no gradients: craft the patch in the embedded camera world, then score it here"
            )
        wanted = [None] if patches is None else list(patches)
        faces = [laid_out(stuck_on(patch, share), self._world.face_region) for patch in wanted]
        pictures = []
        with self._taking() as (paint, take):
            for n, frame in enumerate(frames.tolist()):
                paint(faces[n if len(faces) > 1 else 0])
                pictures.append(torch.from_numpy(take(frame)[0]))
        return torch.stack(pictures)

    def _find(self) -> tuple[str, Array]:
        """The sign's name and the vertices [8, 3] of its bounding box in Unreal's world.

        An object of the map is registered under its actor's name with "_SM_" and a number, the name that textures go by being
        the actor's (CARLA 0.9.16, Carla/Util/ObjectRegister.cpp and Carla/Game/CarlaGameModeBase.cpp).
        """
        names = sorted(name for name in self._server.get_names_of_all_objects() if self._world.sign in name)
        signs = self._server.get_environment_objects(carla.CityObjectLabel.TrafficSigns)
        for name in names:
            for thing in signs:
                if thing.name.startswith(f"{name}_SM_"):
                    vertices = thing.bounding_box.get_world_vertices(carla.Transform())
                    return name, np.array([(v.x, v.y, v.z) for v in vertices])
        town = self._map.name
        raise UserError(
            f"{town} has no traffic sign called {self._world.sign!r}: load a map with stop signs, or set sign="
        )

    def _on_the_road(self, camera: Camera) -> Camera:
        return replace(camera, z=camera.z + self._road_z(camera.x, camera.y))

    def _road_z(self, x: float, y: float) -> float:
        """Height of the road nearest to our (x, y), in our z."""
        where = self._place.to_unreal(np.array([x, y, 0.0]))
        lane = self._map.get_waypoint(_location(where)).transform
        return float(lane.location.z - self._place.origin[2])

    @contextmanager
    def _taking(self) -> Iterator[tuple[capture.Paint, _Take]]:
        """What paints the sign and what takes a frame; the server is left as it was found, but for the plain face."""
        world, server = self._world, self._server
        rng = np.random.default_rng([self._location.seed, self._cell.lanes, round(100 * self._cell.density)])
        plain = laid_out(stuck_on(None, 1.0), world.face_region)
        with (
            world.answering(),
            capture.synchronous(server, world.time_step_s),
            capture.under(server, self._weather),
            capture.painting(server, self._sign, plain) as paint,
            capture.destroyed_afterwards(self._client) as actors,
        ):
            eye = capture.Eye(server, self._cameras[0], actors, world.timeout_s)
            vehicles = capture.spawned(server, self._traffic, rng, self._place, actors)
            yield paint, partial(self._take, eye, vehicles)

    def _take(self, eye: capture.Eye, vehicles: list[carla.Actor], frame: int) -> tuple[NDArray[np.float32], Array]:
        """The picture and the depth of a frame, with the traffic where it has got to by then."""
        camera = self._cameras[frame]
        for vehicle, placed in zip(vehicles, self._traffic, strict=True):
            y = placed.later(float(self.distance[frame]))
            vehicle.set_transform(capture.transform(self._place, np.array([placed.x, y, self._road_z(placed.x, y)])))
        at = capture.transform(self._place, camera.position, yaw_deg=camera.yaw_deg, pitch_deg=camera.pitch_deg)
        return eye.look(at, self._world.settle_ticks)


def _location(point: Array) -> carla.Location:
    x, y, z = point.tolist()
    return carla.Location(x=x, y=y, z=z)
