"""Pictures from a CARLA server: synchronous ticks, actors that are gone afterwards, one camera moved from pose to pose."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from queue import Empty, SimpleQueue

import carla
import numpy as np
from numpy.typing import NDArray

from bench.errors import UserError
from envs.camera.camera import Array, Camera
from envs.camera.carla.geometry import Place, decoded_depth
from envs.camera.street.layout import Placed
from envs.camera.street.vehicles import Model

BASE_TYPES: dict[Model, str] = {"saloon": "car", "hatchback": "car", "van": "van", "lorry": "truck"}
"""What a vehicle of the embedded world is among CARLA's blueprints."""
_LENS = {"motion_blur_intensity": "0.0", "lens_flare_intensity": "0.0", "chromatic_aberration_intensity": "0.0"}
"""A camera that jumps from pose to pose must not blur, and ours is a pinhole."""
_WAITING_M = 50.0
"""Above the road: where vehicles are spawned out of each other's way, before they are put on it."""


@contextmanager
def synchronous(world: carla.World, time_step_s: float) -> Iterator[None]:
    """The server steps when we tick, by `time_step_s` seconds; its settings are restored afterwards, come what may."""
    before, settings = world.get_settings(), world.get_settings()
    settings.synchronous_mode = True
    settings.no_rendering_mode = False
    settings.fixed_delta_seconds = time_step_s
    try:
        world.apply_settings(settings)
        yield
    finally:
        world.apply_settings(before)


@contextmanager
def under(world: carla.World, weather: dict[str, float]) -> Iterator[None]:
    """The world in a weather (`weather.parameters`); its own is restored afterwards."""
    before = world.get_weather()
    try:
        world.set_weather(carla.WeatherParameters(**weather))
        yield
    finally:
        world.set_weather(before)


@contextmanager
def destroyed_afterwards(client: carla.Client) -> Iterator[list[carla.Actor]]:
    """A list for actors, which are destroyed at the end in one call; sensors stop first."""
    actors: list[carla.Actor] = []
    try:
        yield actors
    finally:
        for actor in actors:
            if isinstance(actor, carla.Sensor):
                actor.stop()
        client.apply_batch_sync([carla.command.DestroyActor(actor) for actor in actors], False)


Paint = Callable[[NDArray[np.uint8]], None]


@contextmanager
def painting(world: carla.World, name: str, plain: NDArray[np.uint8]) -> Iterator[Paint]:
    """What puts a texture [H, W, 3] on the object of a name; it has the plain one at the beginning and at the end."""
    on = plain

    def paint(texture: NDArray[np.uint8]) -> None:
        nonlocal on
        if not np.array_equal(texture, on):
            on = texture
            _apply(world, name, texture)

    try:
        _apply(world, name, plain)
        yield paint
    finally:
        paint(plain)


def _apply(world: carla.World, name: str, texture: NDArray[np.uint8]) -> None:
    """Put a texture [H, W, 3] sRGB, its first row at v = 0, on an object; pixels can only be set one by one."""
    height, width = texture.shape[:2]
    painted = carla.TextureColor(width, height)
    for v, row in enumerate(texture.tolist()):
        for u, (red, green, blue) in enumerate(row):
            painted.set(u, v, carla.Color(red, green, blue, 255))
    world.apply_color_texture_to_object(name, carla.MaterialParameter.Diffuse, painted)


class Eye:
    """An rgb and a depth camera at the same place, which take their pictures in the same tick.

    Args:
        world: in synchronous mode.
        camera: size and focal length; every pose must have the same.
        actors: where the two sensors are put for destruction.
        timeout_s: how long a picture may take to arrive.
    """

    def __init__(self, world: carla.World, camera: Camera, actors: list[carla.Actor], timeout_s: float) -> None:
        self._world, self._timeout_s = world, timeout_s
        self._sensors: list[carla.Sensor] = []
        self._arrived: list[SimpleQueue[carla.Image]] = []
        library = world.get_blueprint_library()
        for kind, lens in (("sensor.camera.rgb", _LENS), ("sensor.camera.depth", {})):
            blueprint = library.find(kind)
            for key, value in {**attributes(camera), **lens}.items():
                blueprint.set_attribute(key, value)
            sensor = world.spawn_actor(blueprint, carla.Transform())
            actors.append(sensor)
            arrived: SimpleQueue[carla.Image] = SimpleQueue()
            sensor.listen(arrived.put)
            self._sensors.append(sensor)
            self._arrived.append(arrived)

    def look(self, at: carla.Transform, settle_ticks: int) -> tuple[NDArray[np.float32], Array]:
        """The picture [3, H, W] sRGB in [0, 1] and the depth [H, W] in m, after some ticks at a pose.

        Raises:
            UserError: if a picture does not arrive.
        """
        for sensor in self._sensors:
            sensor.set_transform(at)
        for _ in range(settle_ticks + 1):
            frame = self._world.tick()
        colour, depth = (self._of(frame, arrived) for arrived in self._arrived)
        rgb = colour[..., 2::-1].transpose(2, 0, 1).astype(np.float32) / np.float32(255)
        return rgb, decoded_depth(depth)

    def _of(self, frame: int, arrived: SimpleQueue[carla.Image]) -> NDArray[np.uint8]:
        """[H, W, 4] BGRA of a tick; those of earlier ticks are dropped."""
        while True:
            try:
                image = arrived.get(timeout=self._timeout_s)
            except Empty:
                raise UserError(f"CARLA sent no picture of tick {frame} within {self._timeout_s:g} s") from None
            if image.frame == frame:
                return np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)


def attributes(camera: Camera) -> dict[str, str]:
    """Our pinhole as a CARLA camera's blueprint attributes; the field of view is horizontal, in degrees."""
    return {
        "image_size_x": str(camera.width),
        "image_size_y": str(camera.height),
        "fov": repr(camera.field_of_view_deg),
    }


def transform(place: Place, position: Array, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> carla.Transform:
    """Where a thing at our position [3] stands in CARLA; yaw to the right of the direction of driving, pitch upwards."""
    x, y, z = place.to_unreal(position).tolist()
    rotation = carla.Rotation(pitch=pitch_deg, yaw=place.yaw_deg + yaw_deg)
    return carla.Transform(carla.Location(x=x, y=y, z=z), rotation)


def spawned(
    world: carla.World, traffic: Sequence[Placed], rng: np.random.Generator, place: Place, actors: list[carla.Actor]
) -> list[carla.Actor]:
    """A vehicle without physics for each of the traffic, above the road, by blueprints of its kind that `rng` draws.

    Raises:
        UserError: if the server has no blueprint of a kind.
    """
    library = sorted(world.get_blueprint_library().filter("vehicle.*"), key=lambda blueprint: blueprint.id)
    found = []
    for number, placed in enumerate(traffic):
        kind = BASE_TYPES[placed.model]
        fitting = [blueprint for blueprint in library if _base_type(blueprint) == kind]
        if not fitting:
            raise UserError(f"the CARLA server has no vehicle blueprint whose base_type is {kind!r}")
        blueprint = fitting[int(rng.integers(len(fitting)))]
        above = transform(place, np.array([placed.x, placed.y, _WAITING_M + 10.0 * number]))
        vehicle = world.spawn_actor(blueprint, above)
        actors.append(vehicle)
        vehicle.set_simulate_physics(False)
        found.append(vehicle)
    return found


def _base_type(blueprint: carla.ActorBlueprint) -> str:
    return blueprint.get_attribute("base_type").as_str() if blueprint.has_attribute("base_type") else ""
