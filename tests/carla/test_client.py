"""Every name and every call of the client that the backend uses, looked up in the real package. No server is needed."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import envs.camera.carla as backend
from bench.scenarios.grid import WEATHERS
from envs.camera.camera import Camera
from envs.camera.carla.geometry import Place, stand
from envs.camera.carla.weather import parameters
from tests.carla.test_geometry import box_of

carla: ModuleType = pytest.importorskip("carla", reason="needs the carla package: pip install cavbench[carla]")

from envs.camera.carla import capture  # noqa: E402, it imports the package

USED = {
    "Actor": ("set_transform", "set_simulate_physics"),
    "ActorAttribute": ("as_str",),
    "ActorBlueprint": ("get_attribute", "has_attribute", "id", "set_attribute"),
    "BlueprintLibrary": ("filter", "find"),
    "BoundingBox": ("get_world_vertices",),
    "Client": ("apply_batch_sync", "get_client_version", "get_server_version", "get_world", "set_timeout"),
    "EnvironmentObject": ("bounding_box", "name"),
    "Image": ("frame", "height", "raw_data", "width"),
    "Location": ("x", "y", "z"),
    "Map": ("get_waypoint", "name"),
    "Rotation": ("yaw",),
    "Sensor": ("listen", "set_transform", "stop"),
    "TextureColor": ("set",),
    "Transform": ("location", "rotation"),
    "Waypoint": ("transform",),
    "World": (
        "apply_color_texture_to_object",
        "apply_settings",
        "get_blueprint_library",
        "get_environment_objects",
        "get_map",
        "get_names_of_all_objects",
        "get_settings",
        "get_weather",
        "set_weather",
        "spawn_actor",
        "tick",
    ),
    "WorldSettings": ("fixed_delta_seconds", "no_rendering_mode", "synchronous_mode"),
}
MEMBERS = [(owner, member) for owner, members in USED.items() for member in members]


def nodes() -> Iterator[ast.AST]:
    for path in Path(backend.__file__).parent.glob("*.py"):
        yield from ast.walk(ast.parse(path.read_text()))


def test_every_name_taken_from_the_package_is_in_it() -> None:
    chains = {ast.unparse(node) for node in nodes() if isinstance(node, ast.Attribute)}
    chains = {chain for chain in chains if re.fullmatch(r"carla(\.\w+)+", chain)}
    assert {"carla.MaterialParameter.Diffuse", "carla.command.DestroyActor"} <= chains
    for chain in chains:
        found: object = carla
        for name in chain.split(".")[1:]:
            found = getattr(found, name)


@pytest.mark.parametrize(("owner", "member"), MEMBERS)
def test_every_member_is_there_and_every_call_of_it_fits(owner: str, member: str) -> None:
    found = getattr(getattr(carla, owner), member)
    calls = [n for n in nodes() if isinstance(n, ast.Call) and getattr(n.func, "attr", "") == member]
    used = [n for n in nodes() if isinstance(n, ast.Attribute) and n.attr == member]
    assert used, "the backend no longer uses it: take it off the list"
    for call in calls if callable(found) else ():
        least, most = arguments(found.__doc__)
        assert least <= 1 + len(call.args) <= most
        assert not call.keywords


def arguments(doc: str) -> tuple[int, int]:
    """The fewest and the most arguments, self included, that boost.python's docstring of a method allows."""
    line = next(line for line in doc.splitlines() if "->" in line)
    required, _, optional = line.partition("(")[2].partition("[")
    least = len(re.findall(r"\(\w+\)\w+", required))
    return least, least + len(re.findall(r"\(\w+\)\w+", optional))


@pytest.mark.parametrize("name", WEATHERS)
def test_the_client_takes_every_weather_and_says_it_back(name: str) -> None:
    wanted = parameters(WEATHERS[name], -30.0)
    weather = carla.WeatherParameters(**wanted)
    assert {key: getattr(weather, key) for key in wanted} == pytest.approx(wanted, rel=1e-6)


def test_a_step_longer_than_the_physics_can_divide_is_not_offered() -> None:
    settings = carla.WorldSettings()
    assert settings.max_substeps * settings.max_substep_delta_time == pytest.approx(0.1)


@pytest.mark.parametrize("yaw", [0.0, 37.0, 90.0, -140.0])
def test_the_clients_own_transform_agrees_with_our_coordinates(yaw: float) -> None:
    place = Place((5.0, -7.0, 1.0), yaw)
    theirs = carla.Transform(carla.Location(*place.origin), carla.Rotation(yaw=yaw))
    right, forward, up = 2.0, 11.0, 3.0
    seen = theirs.transform(carla.Vector3D(forward, right, up))
    assert (seen.x, seen.y, seen.z) == pytest.approx(place.to_unreal(np.array([right, forward, up])), abs=1e-4)


@pytest.mark.parametrize("yaw", [0.0, 37.0, -140.0])
def test_the_clients_camera_looks_where_ours_looks(yaw: float) -> None:
    place, camera = Place((5.0, -7.0, 1.0), yaw), Camera(y=-20.0, x=0.3, yaw_deg=4.0, pitch_deg=-2.0)
    theirs = np.array(
        capture.transform(place, camera.position, yaw_deg=camera.yaw_deg, pitch_deg=camera.pitch_deg).get_matrix()
    )
    assert theirs[:3, 3] == pytest.approx(place.to_unreal(camera.position), abs=1e-4)
    right, down, forward = camera.rotation
    for column, ours in ((0, forward), (1, right), (2, -down)):
        axis = place.to_unreal(ours) - place.to_unreal(np.zeros(3))
        assert theirs[:3, column] == pytest.approx(axis, abs=1e-5)


def test_a_box_of_the_client_gives_its_sign() -> None:
    box = carla.BoundingBox(carla.Location(100.0, 50.0, 2.5), carla.Vector3D(0.03, 0.4, 0.4))
    box.rotation = carla.Rotation(yaw=25.0)
    vertices = np.array([(v.x, v.y, v.z) for v in box.get_world_vertices(carla.Transform())])
    place, face = stand(vertices, road_yaw_deg=0.0, road_z=0.2, sign_x=3.0)
    assert place.yaw_deg == pytest.approx(25.0, abs=1e-3)
    assert (face.x, face.z, face.side) == pytest.approx((3.0, 2.3, 0.8), abs=1e-4)
    wanted = box_of(place, 3.0, (1.9, 2.7), 0.8)
    assert np.sort(vertices, 0) == pytest.approx(np.sort(wanted, 0), abs=0.02)


class Recording:
    """Stands where the world and the client stand, and only writes down what is asked of them."""

    def __init__(self) -> None:
        self.settings, self.weather = carla.WorldSettings(), carla.WeatherParameters.CloudyNoon
        self.painted: list[tuple[str, object, Any]] = []
        self.destroyed: list[int] = []

    def get_settings(self) -> Any:
        return carla.WorldSettings(self.settings.synchronous_mode, False, self.settings.fixed_delta_seconds or 0.0)

    def apply_settings(self, settings: Any) -> None:
        self.settings = settings

    def get_weather(self) -> Any:
        return self.weather

    def set_weather(self, weather: Any) -> None:
        self.weather = weather

    def apply_color_texture_to_object(self, name: str, parameter: object, texture: Any) -> None:
        self.painted.append((name, parameter, texture))

    def apply_batch_sync(self, commands: list[Any], tick: bool) -> None:
        self.destroyed += [command.actor_id for command in commands]


def breaks_off(server: Recording) -> None:
    plain = np.zeros((4, 6, 3), np.uint8)
    with (
        capture.synchronous(server, 0.05),
        capture.under(server, parameters(WEATHERS["fog"], 0.0)),
        capture.painting(server, "BP_Stop_1", plain) as paint,
        capture.destroyed_afterwards(server) as actors,
    ):
        assert (server.settings.synchronous_mode, server.settings.fixed_delta_seconds) == (True, 0.05)
        assert server.weather.fog_density == pytest.approx(25.0)
        paint(plain + 1)
        actors += [7, 8]
        raise KeyboardInterrupt


def test_a_capture_that_breaks_off_leaves_the_server_as_it_was() -> None:
    server = Recording()
    with pytest.raises(KeyboardInterrupt):
        breaks_off(server)
    assert server.settings == carla.WorldSettings()
    assert server.weather == carla.WeatherParameters.CloudyNoon
    assert server.painted[-1][2].get(0, 0) == carla.Color(0, 0, 0, 255)
    assert server.destroyed == [7, 8]


def test_what_the_sign_is_painted_with_is_what_the_texture_holds() -> None:
    server, plain = Recording(), np.zeros((4, 6, 3), np.uint8)
    other = np.arange(72, dtype=np.uint8).reshape(4, 6, 3)
    with capture.painting(server, "BP_Stop_1", plain) as paint:
        paint(other)
        paint(other)
    assert len(server.painted) == 3
    name, parameter, texture = server.painted[1]
    assert (name, parameter) == ("BP_Stop_1", carla.MaterialParameter.Diffuse)
    assert (texture.width, texture.height) == (6, 4)
    assert texture.get(5, 2) == carla.Color(51, 52, 53, 255)
