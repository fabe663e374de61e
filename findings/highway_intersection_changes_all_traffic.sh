#!/usr/bin/env bash
# One guesses: environments of highway-env in one process do not know each other.
# What happens: making any intersection writes other constants into the class IDMVehicle, which drives the traffic of all tasks. From then on
# the same seed of highway-v0 gives other traffic, also in environments that were made before.
# Versions: highway-env 1.12.1, gymnasium 1.4.0. Source: a parity test that failed depending on the order of its cases.
source "$(dirname "$0")/fresh.sh"
fresh highway-env==1.12.1 gymnasium==1.4.0 numpy
see <<'P'
from importlib.metadata import version

import gymnasium
import highway_env  # noqa: F401
from highway_env.vehicle.behavior import IDMVehicle

NAMES = ("DISTANCE_WANTED", "COMFORT_ACC_MAX", "COMFORT_ACC_MIN")


def traffic():
    """Where the cars are after ten decisions of one seed."""
    env = gymnasium.make("highway-fast-v0")
    env.reset(seed=5)
    for _ in range(10):
        env.step(1)
    return [round(float(number), 2) for car in env.unwrapped.road.vehicles[1:4] for number in car.position]


before, places = {name: getattr(IDMVehicle, name) for name in NAMES}, traffic()
same = traffic() == places
gymnasium.make("intersection-v0").reset(seed=0)
after, others = {name: getattr(IDMVehicle, name) for name in NAMES}, traffic()
print(f"highway-env {version('highway-env')}: {before} -> {after}; highway-fast-v0, seed 5: {places[:2]} -> {others[:2]}")
raise SystemExit(not (same and before != after and others != places))
P
