"""The start of an episode from its seed: highway-env's HighwayEnv._create_vehicles, equal to the last bit.

highway-env draws single numbers from numpy's Generator. Here the raw 64-bit words of the same PCG64 are drawn at once, and
compiled code converts them to the same numbers, which makes a reset about a hundred times faster.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import entry_point, inner
from cavbench.envs.highway.dynamics import CONTINUOUS, IDM, LANE_WIDTH, SPEED_LIMIT, closest_lane, update_direction
from cavbench.envs.highway.ego import nearest_target_speed
from cavbench.envs.highway.state import Floats, Integers, Parameters, Vehicle, Vehicles

Words = NDArray[np.uint64]

EGO_SPEED = 25.0
TRAFFIC_SPEED_LOW, TRAFFIC_SPEED_HIGH = 0.7 * SPEED_LIMIT, 0.8 * SPEED_LIMIT
SPACING_LOW, SPACING_HIGH = 0.9, 1.1
DELTA_LOW, DELTA_HIGH = 3.5, 4.5
DEFAULT_DELTA = 4.0

LOW_HALF = np.uint64(2**32 - 1)
UNIT_PER_BIT = 1.0 / 2**53


def draw_words(seeds: NDArray[np.int64], vehicles: int) -> NDArray[np.uint64]:
    """[len(seeds), words] the first words of each seed's generator, `gymnasium.utils.seeding.np_random(seed)`.

    A vehicle needs at most 3.5 words; the rest is reserve for the rejections of Lemire's method, about one in 10^9 draws.
    """
    words = 4 * (vehicles + 1) + 16
    drawn = np.empty((len(seeds), words), dtype=np.uint64)
    for row, seed in enumerate(seeds):
        drawn[row] = np.random.PCG64(int(seed)).random_raw(words)
    return drawn


def lane_spacing(lanes: NDArray[np.int64]) -> NDArray[np.float64]:
    """[...] Vehicle.create_random's factor that reduces the spacing with more lanes, computed with numpy as in highway-env."""
    return np.array([np.exp(-5 / 40 * int(lane)) for lane in lanes], dtype=np.float64)


@inner
def next_double(words: Words, cursor: Integers) -> float:
    """Generator.random: 53 bits of the next word. `cursor` holds [next word, stored half word or -1]."""
    word = words[cursor[0]]
    cursor[0] += 1
    return np.float64(word >> np.uint64(11)) * UNIT_PER_BIT


@inner
def next_half_word(words: Words, cursor: Integers) -> np.uint64:
    """PCG64's 32-bit output: the low half of a word first, its high half in the next call."""
    if cursor[1] >= 0:
        half = np.uint64(cursor[1])
        cursor[1] = -1
        return half
    word = words[cursor[0]]
    cursor[0] += 1
    cursor[1] = np.int64(word >> np.uint64(32))
    return word & LOW_HALF


@inner
def next_below(words: Words, cursor: Integers, bound: int) -> np.int64:
    """Generator.integers(bound) and Generator.choice(bound): Lemire's method on 32 bits."""
    limit = np.uint64(bound)
    product = next_half_word(words, cursor) * limit
    threshold = (np.uint64(2**32) - limit) % limit
    while (product & LOW_HALF) < threshold:
        product = next_half_word(words, cursor) * limit
    return np.int64(product >> np.uint64(32))


@inner
def next_uniform(words: Words, cursor: Integers, low: float, high: float) -> float:
    """Generator.uniform(low, high)."""
    return low + (high - low) * next_double(words, cursor)


@inner
def place_vehicle(vehicle: Vehicle, x: float, lane: int | np.int64, lanes: int, speed: float) -> None:
    """Initialise a vehicle on the centre of a lane, driving along it."""
    vehicle.x = x
    vehicle.y = LANE_WIDTH * lane
    vehicle.heading = 0.0
    vehicle.speed = speed
    vehicle.target_speed = speed
    vehicle.timer = ((vehicle.x + vehicle.y) * np.pi) % 1.0
    vehicle.delta = DEFAULT_DELTA
    vehicle.steering = vehicle.acceleration = 0.0
    vehicle.impact_x = vehicle.impact_y = 0.0
    vehicle.impact_pair = -1
    vehicle.lane = closest_lane(vehicle.x, vehicle.y, vehicle.heading, lanes)
    vehicle.target_lane = vehicle.lane
    vehicle.crashed = vehicle.ordered = vehicle.braking = False
    vehicle.held = 0
    vehicle.ordered_acceleration = vehicle.ordered_y = 0.0
    update_direction(vehicle)


@inner
def spawn_episode(
    vehicles: Vehicles,
    words: Words,
    lanes: int,
    ego_spacing: float,
    traffic_spacing: float,
    lane_factor: float,
    ego: int,
    target_speeds: Floats,
    start_lane: int,
) -> None:
    """Fill `vehicles` [N], the ego first; each starts ahead of all previous ones (Vehicle.create_random)."""
    cursor = np.array([0, -1], dtype=np.int64)
    furthest = 0.0
    for number in range(vehicles.size):
        lane = np.int64(start_lane) if number == 0 and start_lane >= 0 else next_below(words, cursor, lanes)
        speed, spacing = EGO_SPEED, ego_spacing
        if number > 0:
            speed, spacing = next_uniform(words, cursor, TRAFFIC_SPEED_LOW, TRAFFIC_SPEED_HIGH), traffic_spacing
        offset = spacing * (12 + 1.0 * speed) * lane_factor
        start = furthest if number > 0 else 3 * offset
        x = start + offset * next_uniform(words, cursor, SPACING_LOW, SPACING_HIGH)
        place_vehicle(vehicles[number], x, lane, lanes, speed)
        furthest = x if number == 0 else max(furthest, x)
        if number > 0:
            vehicles[number].delta = next_uniform(words, cursor, DELTA_LOW, DELTA_HIGH)
    if ego != CONTINUOUS:
        vehicles[0].target_speed = target_speeds[nearest_target_speed(EGO_SPEED, target_speeds)]
    if ego != IDM:
        vehicles[0].timer = 0.0


@entry_point
def spawn_batch(
    vehicles: NDArray[np.void],
    order: Integers,
    episodes: NDArray[np.void],
    chosen: Integers,
    words: Words,
    ego_spacing: float,
    traffic_spacing: Floats,
    lane_factors: Floats,
    parameters: Parameters,
) -> None:
    """Start the episodes `chosen` [R] of `vehicles` [B, N].

    Args:
        words: [R, W] random words of each chosen episode, from `draw_words`.
        traffic_spacing, lane_factors: [R] highway-env's spacing of the traffic, and `lane_spacing`.
    """
    for row in range(chosen.size):
        number = chosen[row]
        spawn_episode(
            vehicles[number],
            words[row],
            episodes[number].lanes,
            ego_spacing,
            traffic_spacing[row],
            lane_factors[row],
            parameters.ego,
            parameters.target_speeds,
            parameters.start_lane,
        )
        for place in range(vehicles.shape[1]):
            order[number, place] = place
