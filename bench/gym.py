"""Gymnasium: every driving world as an environment, and `GymWorld`, a world made of a gymnasium environment.

Importing this module registers an environment `cavbench/WORLD-v0` for each installed driving world.
"""

from cavbench.driving.gym import (
    AttackedEnv,
    DrivingEnv,
    DrivingVectorEnv,
    GymWorld,
    RegisteredWorld,
    make,
    make_vec,
    world,
)

__all__ = [
    "AttackedEnv",
    "DrivingEnv",
    "DrivingVectorEnv",
    "GymWorld",
    "RegisteredWorld",
    "make",
    "make_vec",
    "world",
]
