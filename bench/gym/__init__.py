"""Gymnasium: every driving world as an environment, and `GymWorld`, a world made of a gymnasium environment.

Importing this module registers an environment `cavbench/WORLD-v0` for each installed driving world.
"""

try:
    import gymnasium
except ImportError as error:
    raise ImportError("cavbench.gym needs gymnasium: pip install 'cavbench[gym]'") from error

from cavbench.core import sources
from cavbench.gym.environment import DrivingEnv, make
from cavbench.gym.vector import DrivingVectorEnv, make_vec
from cavbench.gym.world import GymWorld

__all__ = ["DrivingEnv", "DrivingVectorEnv", "GymWorld", "make", "make_vec"]

for _name in sources.names("world", "driving"):
    gymnasium.register(
        id=f"cavbench/{_name}-v0",
        entry_point="cavbench.gym.environment:make",
        vector_entry_point="cavbench.gym.vector:make_vec",
        kwargs={"world": _name},
    )
