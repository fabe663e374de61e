"""What the worlds of road networks call progress; see `Measure`."""

from __future__ import annotations

import math

import numpy as np

from cavbench.compiled import inner
from cavbench.envs.highway.dynamics import clip, linear_map
from cavbench.envs.highway.ego import PROGRESS_SPEED
from cavbench.envs.roads.lanes import heading_at
from cavbench.envs.roads.state import Bodies, Body, Episode, Kind, Measure, Parameters, Road

CONTINUOUS = int(Kind.CONTINUOUS)
HIGHWAY, WAY, PACE = int(Measure.HIGHWAY), int(Measure.WAY), int(Measure.PACE)


@inner
def way_left(road: Road, ego: Body) -> float:
    """Metres of the way from the ego to its goal; inf where it is beside the way."""
    length = road.way_length[ego.lane]
    if length == 0.0:
        return np.inf
    lane = road.lanes[ego.lane]
    # The last road counts up to the goal, the others count as long as their first lane.
    whole = length if road.way_after[ego.lane] == 0.0 else lane.length
    return road.way_after[ego.lane] + length * (1.0 - clip(ego.along / whole, 0.0, 1.0))


@inner
def highway_progress(road: Road, ego: Body, parameters: Parameters) -> float:
    """Thesis Eq. 4.1 without its offset, in [0, 1]: the lane to the right, and the forward speed from 20 to 30 m/s."""
    lane = road.lanes[ego.lane if ego.kind == CONTINUOUS else ego.target_lane]
    last = road.edges[0].lanes - 1
    right = min(lane.number, last) / max(last, 1)
    low, high = parameters.reward_speed_low, parameters.reward_speed_high
    speed = clip(linear_map(ego.speed * ego.cos_heading, low, high, 0.0, 1.0), 0.0, 1.0)
    weight = parameters.lane_weight
    return (weight * right + PROGRESS_SPEED * speed) / (weight + PROGRESS_SPEED)


@inner
def progress(road: Road, bodies: Bodies, episode: Episode, parameters: Parameters) -> float:
    """The progress of a decision in [0, 1]; see `Measure`.

    On a way, metres count once, and at most so many in a decision as the reference speed covers: what is more, counts later.
    Where traffic is recorded, the reference is the mean speed of the recorded driver.
    """
    ego = bodies[episode.ego]
    if parameters.progress == HIGHWAY:
        return highway_progress(road, ego, parameters)
    if parameters.progress == WAY:
        covered = parameters.reference_speed * parameters.period
        share = clip((episode.ahead - way_left(road, ego)) / covered, 0.0, 1.0)
        episode.ahead -= share * covered
        return share
    if parameters.progress == PACE:
        covered = episode.pace * parameters.period
        share = clip((ego.x - episode.ahead) / covered, 0.0, 1.0)
        episode.ahead += share * covered
        return share
    turned = ego.heading - heading_at(road.lanes[ego.lane], ego.along)
    return clip(ego.speed * math.cos(turned) / parameters.reference_speed, 0.0, 1.0)
