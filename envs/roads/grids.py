"""Observations as grids: highway-env's OccupancyGridObservation and TimeToCollisionObservation (envs/common/observation.py)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cavbench.compiled import borrowing
from cavbench.envs.highway.dynamics import not_zero
from cavbench.envs.roads.lanes import SINE, STRAIGHT, local_coordinates, position
from cavbench.envs.roads.state import Bodies, Body, Episode, Parameters, Road
from cavbench.envs.roads.traffic import lane_distance

HALF, CELL, CELLS = 18.0, 3.0, 12
"""Half the side of the occupancy grid in m, the side of a cell, and the number of cells on a side."""
FAR = 27.0
"""What is farther from the ego than this in m is outside the grid, whatever the ego's heading: its corners are at 25.5 m."""
SEEN = 100.0
"""Lanes are drawn up to this distance in m along them."""
SPEEDS = LANES = 3
"""Rows of a grid of times to collision: speeds and lanes around the ego's."""
MARGIN = 5.0


@borrowing
def mark(ego: Body, x: float, y: float, layer: NDArray[np.float32]) -> None:
    """Set the cell [12, 12] at a place relative to the ego in m, in the world's axes."""
    cos, sin = ego.cos_heading, ego.sin_heading
    row = math.floor((cos * x + sin * y + HALF) / CELL)
    column = math.floor((-sin * x + cos * y + HALF) / CELL)
    if 0 <= row < CELLS and 0 <= column < CELLS:
        layer[int(row), int(column)] = 1.0


@borrowing
def occupancy(road: Road, bodies: Bodies, episode: Episode, grid: NDArray[np.float32]) -> None:
    """Fill `grid` [24, 12]: twelve rows with cars, the ego's own cell included, then twelve rows with points of the lanes."""
    ego = bodies[episode.ego]
    grid[:] = 0.0
    for number in range(episode.cars):
        mark(ego, bodies[number].x - ego.x, bodies[number].y - ego.y, grid[:CELLS])
    for number in range(road.lane_count):
        lane = road.lanes[number]
        along, across = local_coordinates(lane, ego.x, ego.y)
        if lane.kind != SINE and abs(across) > FAR:
            continue
        # numpy's arange: the step is the difference of the first two numbers.
        first, before = along - SEEN, -1.0
        step = (first + CELL) - first
        for place in range(math.ceil(((along + SEEN) - first) / CELL)):
            point = min(max(first + place * step, 0.0), lane.length)
            # Many points are the same end of the lane, and most others are outside the grid.
            if point == before or (lane.kind == STRAIGHT and abs(point - along) > FAR):
                continue
            before = point
            x, y = position(lane, point, 0.0)
            mark(ego, x - ego.x, y - ego.y, grid[CELLS:])


@borrowing
def is_connected(road: Road, ego: Body, other: Body) -> bool:
    """RoadNetwork.is_connected_road with a depth of 3: whether the other car is on a road that the ego will come to."""
    edge, goal = road.lanes[ego.lane].edge, road.lanes[other.lane].edge
    place, depth = ego.route_place, 3
    while True:
        if edge == goal or road.edges[goal].end == road.edges[edge].start:
            return True
        if depth == 0:
            return False
        following = -1
        if ego.route >= 0:
            following = road.routes[ego.route, place]
        if following == edge:
            place += 1
        elif following >= 0 and road.edges[following].start == road.edges[edge].end:
            edge = following
            place += 1
            depth -= 1
        else:
            return road.reach[depth, edge, goal] > 0


@borrowing
def collide_with(road: Road, ego: Body, other: Body, parameters: Parameters, grid: NDArray[np.float64]) -> None:
    """compute_ttc_grid for one other car; `grid` is [speeds, lanes, T]."""
    if not is_connected(road, ego, other):
        return
    lane, own = road.lanes[other.lane], road.lanes[ego.lane]
    projected = other.speed * (other.cos_heading * ego.cos_heading + other.sin_heading * ego.sin_heading)
    apart = lane_distance(road, ego, other)
    lanes = road.edges[own.edge].lanes
    same = road.edges[lane.edge].lanes == lanes
    for index in range(parameters.speeds):
        speed = parameters.target_speeds[index]
        if speed == other.speed:
            continue
        closing = not_zero(speed - projected)
        for point in range(3):
            shift = 0.0 if point == 0 else (-MARGIN if point == 1 else MARGIN)
            cost = 1.0 if point == 0 else 0.5
            gap = apart + shift
            # The grid ends before these times, which need no division.
            if gap * closing < 0 or abs(gap) > abs(closing) * parameters.period * (grid.shape[2] + 1):
                continue
            time = gap / closing
            if time < 0:
                continue
            for rounded in (int(time / parameters.period), math.ceil(time / parameters.period)):
                if 0 <= rounded < grid.shape[2]:
                    for number in range(lanes):
                        if number == lane.number or not same:
                            grid[index, number, rounded] = max(grid[index, number, rounded], cost)


@borrowing
def times_to_collision(
    road: Road,
    bodies: Bodies,
    episode: Episode,
    parameters: Parameters,
    grid: NDArray[np.float64],
    view: NDArray[np.float32],
) -> None:
    """Fill `view` [9, T]: for three speeds around the target speed and three lanes around the ego's, where cars will be in time.

    A lane beside the road is full; below the lowest and above the highest speed the outermost one is repeated.
    """
    ego = bodies[episode.ego]
    lanes, own = road.edges[road.lanes[ego.lane].edge].lanes, road.lanes[ego.lane].number
    grid[:] = 0.0
    for number in range(episode.cars):
        if number != episode.ego:
            collide_with(road, ego, bodies[number], parameters, grid)
    for row in range(SPEEDS):
        speed = min(max(ego.speed_index - 1 + row, 0), parameters.speeds - 1)
        for column in range(LANES):
            lane = own - 1 + column
            for time in range(view.shape[1]):
                inside = 0 <= lane < lanes
                view[LANES * row + column, time] = grid[speed, lane, time] if inside else 1.0
