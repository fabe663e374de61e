"""Layout of the street: the road, its surroundings, and the traffic.

Coordinates as in `cavbench.envs.camera.camera`: the face of the sign at y = 0, the middle of the ego's lane at x = 0.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Literal, get_args

import numpy as np

from cavbench.detection.stopping import SPEED_MPS
from cavbench.envs.camera import sign
from cavbench.envs.camera.camera import Camera
from cavbench.envs.camera.street import material as m
from cavbench.envs.camera.street import occlusion, textures
from cavbench.envs.camera.street.material import Material
from cavbench.envs.camera.street.mesh import Mesh, Rng, block, foliage, ground, join, quad, rod
from cavbench.envs.camera.street.vehicles import LENGTH, PAINTS, SHARES, Model, Part, footprint, vehicle

LANE_M = 2.75
LANES_TO_THE_LEFT = 2
"""Lanes to the left of the ego, which keeps to the third lane; each additional lane puts the sign one lane further away."""
LEFT_EDGE = -LANE_M * (LANES_TO_THE_LEFT + 0.5)
"""x of the left edge of the road in m."""
VERGE_M = 1.1
"""Distance from the kerb to the middle of the sign."""
DISTANCES = tuple(float(distance) for distance in np.linspace(30.0, 8.0, 10))
"""Distances of the frames of an approach to the sign, in m."""
MOST_HIDDEN = 4
"""Largest number of frames of an approach in which traffic may hide the sign."""
CROSSING = (2.5, 11.5)
"""Range along y of the crossing road, to which the sign gives way."""
_NEAR, _FAR = -80.0, 260.0

Surrounding = Literal["avenue", "town", "outskirts"]
SignKind = Literal["limit", "warning", "direction"]


@dataclass(frozen=True, kw_only=True)
class Location:
    """A place with a stop sign.

    Args:
        name: name in tables.
        surrounding: kind of surroundings beside the road.
        sun_azimuth_deg: clockwise from the driving direction; at 180 the sun is behind the ego and shines on the sign.
        seed: seed of everything at this place.
        training: whether attacks and defences may use it; scores come from the other places.
        one_road: whether it is rendered on one road only, for the world `places`.
        closed_loop: whether a car drives there in closed loop. Then the traffic obeys the sign: it waits at the line, so a frame
            depends on the place of the car only.
    """

    name: str
    surrounding: Surrounding
    sun_azimuth_deg: float
    seed: int
    training: bool = False
    one_road: bool = False
    closed_loop: bool = False

    @property
    def scored(self) -> bool:
        """Whether it is a place of the world `camera` that scores come from."""
        return not (self.training or self.one_road or self.closed_loop)


LOCATIONS: dict[str, Location] = {
    location.name: location
    for location in (
        Location(name="sun-behind-ego", surrounding="avenue", sun_azimuth_deg=195.0, seed=1),
        Location(name="sun-beside", surrounding="town", sun_azimuth_deg=262.0, seed=2),
        Location(name="sun-behind-sign", surrounding="outskirts", sun_azimuth_deg=14.0, seed=3),
        Location(name="training-1", surrounding="town", sun_azimuth_deg=150.0, seed=11, training=True),
        Location(name="training-2", surrounding="avenue", sun_azimuth_deg=285.0, seed=12, training=True),
        Location(name="training-3", surrounding="outskirts", sun_azimuth_deg=40.0, seed=13, training=True),
        Location(name="avenue-80", surrounding="avenue", sun_azimuth_deg=80.0, seed=31, one_road=True),
        Location(name="avenue-330", surrounding="avenue", sun_azimuth_deg=330.0, seed=32, one_road=True),
        Location(name="town-30", surrounding="town", sun_azimuth_deg=30.0, seed=33, one_road=True),
        Location(name="town-120", surrounding="town", sun_azimuth_deg=120.0, seed=34, one_road=True),
        Location(name="town-200", surrounding="town", sun_azimuth_deg=200.0, seed=35, one_road=True),
        Location(name="outskirts-140", surrounding="outskirts", sun_azimuth_deg=140.0, seed=36, one_road=True),
        Location(name="outskirts-240", surrounding="outskirts", sun_azimuth_deg=240.0, seed=37, one_road=True),
        Location(name="crossing", surrounding="outskirts", sun_azimuth_deg=215.0, seed=21, closed_loop=True),
    )
}


def right_edge(lanes: int) -> float:
    """x of the right edge of a road of `lanes` lanes, in m."""
    return LANE_M * (lanes - LANES_TO_THE_LEFT - 0.5)


def sign_x(lanes: int) -> float:
    """x of the middle of the sign beside a road of `lanes` lanes, in m."""
    return right_edge(lanes) + VERGE_M


def street(location: Location, *, lanes: int, density: float, distance: float, lights: bool) -> list[Part]:
    """Everything except the face of the sign, as meshes of one material each.

    Args:
        location: the place.
        lanes: number of lanes, 3 to 5.
        density: traffic density factor; at 1 a lane has a vehicle every 36 m.
        distance: distance of the ego to the sign in m; sets the positions of the traffic.
        lights: whether tail lights are on.
    """
    parts = list(_standing(location, lanes))
    for placed in traffic(location, lanes, density):
        y = placed.later(distance)
        paint = PAINTS[placed.paint]
        parts += [(mesh.moved(placed.x, y), material) for mesh, material in vehicle(placed.model, paint, lights=lights)]
    return _merged(parts)


@lru_cache(maxsize=4)
def _standing(location: Location, lanes: int) -> tuple[Part, ...]:
    """The parts that are the same in every frame of an approach."""
    parts = _ground(location, lanes) + _post(lanes) + _beside(location, lanes) + _lamp_posts()
    return tuple(_merged(parts + _other_signs(location, lanes)))


@dataclass(frozen=True)
class Placed:
    """A vehicle when the ego is at `DISTANCES[0]`: its middle in m, its speed in m/s, its index in `PAINTS`."""

    model: Model
    x: float
    y: float
    speed: float
    paint: int

    def later(self, distance: float) -> float:
        """y of its middle when the ego is `distance` m before the sign."""
        return self.y + self.speed * (DISTANCES[0] - distance) / SPEED_MPS


@cache
def traffic(location: Location, lanes: int, density: float) -> tuple[Placed, ...]:
    """The vehicles around the ego: the first draw that hides the sign in at most `MOST_HIDDEN` frames of the approach.

    In dense traffic with lanes between the ego and the sign, it hides the sign in at least one frame.
    """
    if location.closed_loop:
        return _waiting(np.random.default_rng([location.seed, lanes, round(100 * density)]), density)
    least = 1 if lanes > LANES_TO_THE_LEFT + 1 and density > 1 else 0
    for attempt in itertools.count():
        placed = _drawn(np.random.default_rng([location.seed, lanes, round(100 * density), attempt]), lanes, density)
        if least <= sum(_hidden(placed, lanes, distance) for distance in DISTANCES) <= MOST_HIDDEN:
            return placed
    raise AssertionError


def _drawn(rng: Rng, lanes: int, density: float) -> tuple[Placed, ...]:
    """Vehicles in every lane. Those to the right of the ego slow down or wait at the crossing, so the ego passes them."""
    placed = []
    for lane in range(lanes):
        x = LANE_M * (lane - LANES_TO_THE_LEFT)
        side = lane - LANES_TO_THE_LEFT
        y = -DISTANCES[0] + (14.0 if side == 0 else 5.0) + rng.uniform(0, 18 / density)
        speed = SPEED_MPS * (rng.uniform(0.0, 0.5) if side > 0 else rng.uniform(0.95, 1.15))
        while y < 90:
            model = _model(rng)
            half = LENGTH[model] / 2
            placed.append(Placed(model, x + rng.normal(0, 0.1), y + half, speed, int(rng.integers(len(PAINTS)))))
            y += 2 * half + 6.0 + rng.exponential(30 / density)
    return tuple(placed)


def _model(rng: Rng) -> Model:
    """A kind of vehicle, as often as it is on the roads."""
    found: Model = get_args(Model)[int(rng.choice(4, p=SHARES))]
    return found


def _waiting(rng: Rng, density: float) -> tuple[Placed, ...]:
    """Vehicles that stand at the line in the lanes to the left of the ego; its own lane is free."""
    placed = []
    for lane in range(LANES_TO_THE_LEFT):
        front = -rng.uniform(0.5, 1.5)
        for _ in range(1 + rng.poisson(density)):
            model = _model(rng)
            rear, ahead, _ = footprint(model)
            x = LANE_M * (lane - LANES_TO_THE_LEFT) + rng.normal(0, 0.1)
            placed.append(Placed(model, x, front - ahead, 0.0, int(rng.integers(len(PAINTS)))))
            front -= ahead - rear + rng.uniform(1.5, 3.0)
    return tuple(placed)


def _hidden(placed: tuple[Placed, ...], lanes: int, distance: float) -> bool:
    """Whether vehicles hide more than half of the part of the sign that is inside the image."""
    camera, x = Camera(y=-distance), sign_x(lanes)
    alone = occlusion.visible(camera, x, ())
    seen = occlusion.visible(camera, x, [(each.model, each.x, each.later(distance)) for each in placed])
    return seen < alone / 2


def _merged(parts: list[Part]) -> list[Part]:
    """One mesh a material, because fewer shapes load and trace faster."""
    groups: dict[tuple[object, ...], tuple[Material, list[Mesh]]] = {}
    for mesh, material in parts:
        key = (material.kind, material.colour, id(material.texture))
        groups.setdefault(key, (material, []))[1].append(mesh)
    return [(join(meshes), material) for material, meshes in groups.values()]


def _ground(location: Location, lanes: int) -> list[Part]:
    rng = np.random.default_rng([location.seed, 1])
    road = Material("road", texture=textures.asphalt(rng))
    slab = Material("paving", texture=textures.concrete(rng))
    lawn = Material("matt", texture=textures.grass(rng))
    left, right = LEFT_EDGE, right_edge(lanes)
    before, after = CROSSING
    parts = [
        (ground(-200, 200, _NEAR, _FAR, -0.03, 5), lawn),
        (ground(left, right, _NEAR, _FAR, 0, 16), road),
        (ground(-200, left, before, after, 0, 16), road),
        (ground(right, 200, before, after, 0, 16), road),
    ]
    for y0, y1 in ((_NEAR, before), (after, _FAR)):
        parts += [
            (block(right, right + 0.17, y0, y1, -0.1, 0.14, (2, 2)), slab),
            (block(left - 0.17, left, y0, y1, -0.1, 0.14, (2, 2)), slab),
            (ground(right + 0.17, right + 2.6, y0, y1, 0.135, 1.5), slab),
            (ground(left - 2.6, left - 0.17, y0, y1, 0.135, 1.5), slab),
        ]
    stripes = [_stripe(left + 0.12, left + 0.24, y0, y1) for y0, y1 in ((_NEAR, before), (after, _FAR))]
    stripes += [_stripe(right - 0.24, right - 0.12, y0, y1) for y0, y1 in ((_NEAR, before), (after, _FAR))]
    for lane in range(1, lanes):
        x = left + lane * LANE_M
        starts = [y for y in np.arange(_NEAR, _FAR, 9.0) if y + 3 < before - 1 or y > after]
        stripes += [_stripe(x - 0.06, x + 0.06, y, y + 3) for y in starts]
    stripes.append(_stripe(left + 0.3, right - 0.3, 0.4, 0.9))
    parts.append((join(stripes), m.MARKING))
    return parts


def _stripe(x0: float, x1: float, y0: float, y1: float) -> Mesh:
    return ground(x0, x1, y0, y1, 0.006)


def _post(lanes: int) -> list[Part]:
    """The sign's post and its back."""
    x = sign_x(lanes)
    back = sign.corners(x)[::-1] + np.array([0, 0.006, 0])
    middle = back.mean(0)
    triangles = [quad([middle, back[i], back[(i + 1) % 8], back[(i + 1) % 8]]) for i in range(8)]
    return [
        (rod((x, 0.05, 0), (x, 0.05, sign.HEIGHT_M + 0.5), 0.035), m.STEEL),
        (join(triangles), m.STEEL),
    ]


def _lamp_posts() -> list[Part]:
    """Lamp posts beside the left kerb, every 34 m."""
    x = LAMPS_X
    posts = [rod((x, y, 0), (x, y, LAMP_HEIGHT_M), 0.09, 0.05) for y in LAMPS_Y]
    arms = [rod((x, y, LAMP_HEIGHT_M), (x + 2.2, y, LAMP_HEIGHT_M + 0.2), 0.04) for y in LAMPS_Y]
    heads = [block(x + 1.6, x + 2.3, y - 0.14, y + 0.14, LAMP_HEIGHT_M + 0.12, LAMP_HEIGHT_M + 0.24) for y in LAMPS_Y]
    return [(join(posts + arms), Material("metal", (0.3, 0.31, 0.32))), (join(heads), Material("matt", (0.2,) * 3))]


@dataclass(frozen=True)
class OtherSign:
    """A sign other than a stop sign: its kind, and the position of its middle in m."""

    kind: SignKind
    x: float
    y: float
    z: float = 2.4


def other_signs(location: Location, lanes: int) -> list[OtherSign]:
    """Three signs (speed limit, warning or direction): two on the right beyond the sign, one on the left before it."""
    rng = np.random.default_rng([location.seed, 3])
    left, right = LEFT_EDGE - VERGE_M, right_edge(lanes) + VERGE_M
    places = ((right, rng.uniform(24, 30)), (right, rng.uniform(48, 60)), (left, rng.uniform(-16, -10)))
    return [OtherSign(get_args(SignKind)[rng.integers(3)], x, y) for x, y in places]


def _other_signs(location: Location, lanes: int) -> list[Part]:
    white, red = Material("matt", (0.75, 0.75, 0.73)), Material("matt", (0.42, 0.02, 0.03))
    yellow, blue = Material("matt", (0.7, 0.42, 0.02)), Material("matt", (0.02, 0.08, 0.35))
    black = Material("matt", (0.02, 0.02, 0.02))
    parts: list[Part] = []
    for other in other_signs(location, lanes):
        x, y, z = other.x, other.y, other.z
        parts.append((rod((x, y + 0.05, 0), (x, y + 0.05, 2.6), 0.03), m.STEEL))
        if other.kind == "limit":
            parts += [(_polygon(x, y, z, 0.33, 32), red), (_polygon(x, y - 0.01, z, 0.25, 32), white)]
            parts += [(block(x + dx, x + dx + 0.11, y - 0.03, y - 0.02, 2.28, 2.52), black) for dx in (-0.14, 0.03)]
        elif other.kind == "warning":
            parts += [(_polygon(x, y, z, 0.5, 4), black), (_polygon(x, y - 0.01, z, 0.46, 4), yellow)]
            parts.append((block(x - 0.04, x + 0.04, y - 0.03, y - 0.02, 2.22, 2.58), black))
        else:
            parts.append((block(x - 0.55, x + 0.55, y - 0.02, y, 2.15, 2.65), blue))
            parts += [(block(x - 0.4, x + 0.4, y - 0.04, y - 0.03, z, z + 0.09), white) for z in (2.27, 2.45)]
    return parts


def _polygon(x: float, y: float, z: float, radius: float, sides: int) -> Mesh:
    """A regular polygon that faces -y; with four sides it stands on a corner."""
    angle = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    rim = np.stack([x + radius * np.cos(angle), np.full(sides, y), z + radius * np.sin(angle)], 1)
    return join([quad([(x, y, z), rim[i], rim[(i + 1) % sides], rim[(i + 1) % sides]]) for i in range(sides)])


LAMPS_X = LEFT_EDGE - 0.9
LAMP_HEIGHT_M = 8.0
LAMPS_Y = (-48.0, -14.0, 20.0, 54.0, 88.0)


def lamp_heads() -> list[tuple[float, float, float]]:
    """Positions of the light sources of the street lamps."""
    x = LAMPS_X + 1.95
    return [(x, y, LAMP_HEIGHT_M + 0.1) for y in LAMPS_Y]


def _beside(location: Location, lanes: int) -> list[Part]:
    """Houses, trees and the horizon."""
    rng = np.random.default_rng([location.seed, 2])
    left, right = LEFT_EDGE - 3.4, right_edge(lanes) + 3.4
    parts = _horizon(rng)
    if location.surrounding == "town":
        parts += _houses(rng, right, 1) + _houses(rng, left, -1)
        parts += _trees(rng, [(left - 0.3, y) for y in (-30, -8, 34, 60)], (6.5, 8.0))
    elif location.surrounding == "avenue":
        parts += _trees(rng, [(right + 2 + rng.uniform(0, 3), y) for y in (-33, -19, 16, 29, 45, 62, 85)], (8.0, 12.0))
        parts += _trees(rng, [(left - 2 - rng.uniform(0, 3), y) for y in (-35, -20, -6, 17, 33, 50, 75)], (8.0, 12.0))
        parts += _house(rng, right + 14, right + 30, 40, 62, 9.0) + _house(rng, left - 32, left - 15, 14, 40, 8.0)
    else:
        parts += _trees(rng, [(right + rng.uniform(4, 22), y) for y in (-25, 18, 26, 44, 58, 80)], (6.0, 11.0))
        parts += _trees(rng, [(left - rng.uniform(3, 24), y) for y in (-28, -4, 22, 52, 90)], (6.0, 12.0))
        parts += _house(rng, right + 9, right + 38, 60, 96, 10.0) + _house(rng, left - 45, left - 14, -34, 0, 7.5)
    return parts


def _horizon(rng: Rng) -> list[Part]:
    """A line of woods 240 m away."""
    angle = np.linspace(-1.2, 1.2, 60)
    x, y = 240 * np.sin(angle), 240 * np.cos(angle)
    top = 9 + 6 * np.convolve(rng.random(66), np.ones(7) / 7, "valid")
    quads = [
        quad([(x[i], y[i], -1), (x[i + 1], y[i + 1], -1), (x[i + 1], y[i + 1], top[i + 1]), (x[i], y[i], top[i])])
        for i in range(59)
    ]
    return [(join(quads), m.HILLS)]


def _trees(rng: Rng, places: list[tuple[float, float]], heights: tuple[float, float]) -> list[Part]:
    trunks, crowns = [], []
    for x, y in places:
        height = rng.uniform(*heights)
        trunks.append(rod((x, y, 0), (x, y, 0.62 * height), 0.022 * height, 0.01 * height, 10))
        trunks += [
            rod((x, y, 0.4 * height), (x + dx, y + dy, 0.68 * height), 0.008 * height, 0.004 * height, 6)
            for dx, dy in rng.normal(0, 0.12 * height, (4, 2))
        ]
        near = y < 30
        crowns.append(
            foliage(
                x, y, 0.66 * height, 0.34 * height, 0.36 * height, 9000 if near else 4000, rng, 0.17 if near else 0.27
            )
        )
    base = (0.055 * rng.uniform(0.8, 1.4), 0.105, 0.022)
    return [(join(trunks), m.BARK), (join(crowns), Material("matt", texture=textures.leaves(rng, base)))]


def _houses(rng: Rng, x: float, side: int) -> list[Part]:
    """A closed row of house fronts along the road, with a gap for the crossing."""
    parts: list[Part] = []
    for y0, y1 in ((-70, -36), (-36, CROSSING[0] - 3), (CROSSING[1] + 3, 42), (42, 84), (84, 150)):
        deep, height = rng.uniform(11, 15), rng.uniform(9, 16)
        ends = (x, x + deep) if side > 0 else (x - deep, x)
        parts += _house(rng, *ends, y0, y1, height)
    return parts


def _house(rng: Rng, x0: float, x1: float, y0: float, y1: float, height: float) -> list[Part]:
    kind = "brick" if rng.random() < 0.5 else "plaster"
    front = textures.facade(rng, kind)
    roof = Material("matt", (0.12, 0.07, 0.055))
    eaves = block(x0 - 0.3, x1 + 0.3, y0 - 0.3, y1 + 0.3, height, height + 0.35)
    return [
        (block(x0, x1, y0, y1, 0, height, (14, 12)), Material("matt", texture=front)),
        (eaves, roof),
    ]
