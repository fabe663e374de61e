#!/usr/bin/env bash
# One guesses: Scenario.translate_rotate moves states and occupancies, or neither.
# What happens: the occupancies of a trajectory are computed once, when they are first asked for. After translate_rotate the states are at
# the new place, and occupancies that were asked for before are at the old one: collision checks and drawings are of the old place.
# Versions: commonroad-io 2026.1. Source: collisions were not found after a scenario was moved to the origin.
source "$(dirname "$0")/fresh.sh"
fresh commonroad-io==2026.1
see <<'P'
import numpy as np
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.scenario import Scenario
from commonroad.scenario.state import InitialState, KSState
from commonroad.scenario.trajectory import Trajectory


def moved(asked_before):
    """x of the state and of the occupancy at time step 2 after a shift by 100 m."""
    shape = RectObstacleShape(width=2, length=4)
    rest = {"orientation": 0.0, "velocity": 10.0}
    first = InitialState(position=np.zeros(2), time_step=0, acceleration=0.0, yaw_rate=0.0, slip_angle=0.0, **rest)
    later = [KSState(time_step=step, position=np.array([float(step), 0.0]), steering_angle=0.0, **rest) for step in (1, 2)]
    car = DynamicObstacle(1, ObstacleType.CAR, shape, first, TrajectoryPrediction(Trajectory(1, later), shape))
    if asked_before:
        car.occupancy_at_time(2)
    scenario = Scenario(dt=0.1)
    scenario.add_objects(car)
    scenario.translate_rotate(np.array([100.0, 0.0]), 0.0)
    return float(car.state_at_time(2).position[0]), car.occupancy_at_time(2).rect_center.x


fresh, stale = moved(False), moved(True)
print(f"commonroad-io 2026.1: (state, occupancy) after a shift from 2 to 102: {fresh}; if the occupancy was asked for before: {stale}")
raise SystemExit((fresh, stale) != ((102.0, 102.0), (102.0, 2.0)))
P
