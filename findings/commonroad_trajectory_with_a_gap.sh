#!/usr/bin/env bash
# One guesses: state_at_time(3) and occupancy_at_time(3) of a car that was not seen at steps 3 and 4 are both None, or the trajectory raises.
# What happens: states are counted and occupancies are looked up. At step 3 the state is that of step 5 and there is no occupancy; at step 5
# there is an occupancy and no state.
# Versions: commonroad-io 2026.1. Its docstring assumes steps without gaps, and nothing checks it. Source: recorded traffic with occlusions.
source "$(dirname "$0")/fresh.sh"
fresh commonroad-io==2026.1
see <<'P'
import numpy as np
from commonroad.geometry.obstacle_shapes.rect_obstacle_shape import RectObstacleShape
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
from commonroad.scenario.state import InitialState, KSState
from commonroad.scenario.trajectory import Trajectory

shape = RectObstacleShape(width=2, length=4)
rest = {"orientation": 0.0, "velocity": 10.0}
first = InitialState(position=np.zeros(2), time_step=0, acceleration=0.0, yaw_rate=0.0, slip_angle=0.0, **rest)
later = [KSState(time_step=step, position=np.array([float(step), 0.0]), steering_angle=0.0, **rest) for step in (1, 2, 5)]
car = DynamicObstacle(1, ObstacleType.CAR, shape, first, TrajectoryPrediction(Trajectory(1, later), shape))
states = {step: getattr(car.state_at_time(step), "time_step", None) for step in (2, 3, 5)}
occupied = {step: getattr(getattr(car.occupancy_at_time(step), "rect_center", None), "x", None) for step in (2, 3, 5)}
print(f"commonroad-io 2026.1: seen at steps 0, 1, 2, 5: step of the state {states}, x of the occupancy {occupied}")
raise SystemExit((states, occupied) != ({2: 2, 3: 5, 5: None}, {2: 2.0, 3: None, 5: 5.0}))
P
