"""The driving worlds and gymnasium: what `cavbench.gym` offers."""

try:
    import gymnasium
except ImportError as error:
    raise ImportError("cavbench.gym needs gymnasium: pip install 'cavbench[gym]'") from error

from cavbench.core import sources
from cavbench.driving.gym.attacked import AttackedEnv
from cavbench.driving.gym.environment import DrivingEnv, make
from cavbench.driving.gym.given import world
from cavbench.driving.gym.registered import RegisteredWorld
from cavbench.driving.gym.vector import DrivingVectorEnv, make_vec
from cavbench.driving.gym.world import GymWorld

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

for _name in sources.names("world", "driving"):
    if _name == "gym":
        continue  # An environment of gymnasium already.
    gymnasium.register(
        id=f"cavbench/{_name}-v0",
        entry_point="cavbench.driving.gym.environment:make",
        vector_entry_point="cavbench.driving.gym.vector:make_vec",
        kwargs={"world": _name},
    )
