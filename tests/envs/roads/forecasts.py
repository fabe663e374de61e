"""What an attacker foresees on road networks, beside what then happens in the engine.

python -m tests.envs.roads.forecasts [--weather clear] [--episodes 32] [WORLD ...]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from cavbench.envs.roads.exit_world import ExitWorld
from cavbench.envs.roads.foresight import RoadsDynamics, RoadsRehearsal
from cavbench.envs.roads.intersection_world import IntersectionWorld
from cavbench.envs.roads.merge_world import MergeWorld
from cavbench.envs.roads.racetrack_world import RacetrackWorld
from cavbench.envs.roads.roundabout_world import RoundaboutWorld
from cavbench.envs.roads.state import Floats
from cavbench.envs.roads.two_way_world import TwoWayWorld
from cavbench.envs.roads.u_turn_world import UTurnWorld
from cavbench.envs.roads.world import RoadsWorld

WORLDS: dict[str, RoadsWorld] = {
    kind.name: kind()
    for kind in (MergeWorld, TwoWayWorld, ExitWorld, UTurnWorld, RoundaboutWorld, IntersectionWorld, RacetrackWorld)
}
DECISIONS, HELD, LENGTH = 90, 5, 15
"""Decisions of an episode, those for which an action is held, and those of a forecast: a second."""
SAME = 1.0
"""A car of a belief is a real one if it is where that is, to so many m."""
TAG = "lateral_speed"
"""A field of a body that only a sliding car uses: here it numbers the real cars, whose order changes where some leave."""


@dataclass
class Errors:
    """By how many m forecasts of a second are wrong, and who fails in that second.

    Args:
        ego: places of the ego.
        ego_speed: its speeds, in m/s.
        others: places of the other cars, from the ego.
        straight: those of a forecast in which cars keep their velocity.
        failed: [N, 2] whether the ego failed, and whether it was forecast to.
    """

    ego: Floats
    ego_speed: Floats
    others: Floats
    straight: Floats
    failed: NDArray[np.bool_]


def places(bodies: NDArray[np.void]) -> Floats:
    """[..., 2] x and y in m."""
    return np.stack([bodies["x"], bodies["y"]], -1)


def velocities(bodies: NDArray[np.void]) -> Floats:
    """[..., 2] in m/s."""
    return bodies["speed"][..., None] * np.stack([bodies["cos_heading"], bodies["sin_heading"]], -1)


def errors(world: RoadsWorld, *, weather: str = "clear", episodes: int = 16, first: int = 0) -> Errors:
    """Drive with random actions, and forecast a second from the observation, every second."""
    cells = [world.home.replaced(weather=weather)] * episodes
    env, dynamics = world.make(cells), world.dynamics(cells, "discrete")
    assert isinstance(dynamics, RoadsDynamics)
    now = env.reset(env.reset().set("seed", torch.arange(first, first + episodes)))
    actions = torch.randint(0, 5, (DECISIONS // HELD, episodes), generator=torch.Generator().manual_seed(first))
    belief, row, done = dynamics.unknown(), np.arange(episodes), np.zeros(episodes, np.bool_)
    found: dict[str, list[Floats]] = {name: [] for name in Errors.__annotations__}
    for step in range(DECISIONS):
        belief = dynamics.believe(now["observation"], belief)
        if step % LENGTH == 0:
            running, engine = ~done, env.engine
            engine.bodies[TAG] = np.arange(engine.bodies.shape[1])
            before, ego = engine.bodies.copy(), engine.bodies[row, engine.episodes["ego"]].copy()
            known, foreseen = engine.episodes["cars"].copy(), dynamics.rehearsal(belief, 1)
            assert isinstance(foreseen, RoadsRehearsal)
            start = foreseen.engine.bodies.copy()
        now["action"] = actions[step // HELD]
        now = env.step(now)["next"]
        foreseen.step(actions[step // HELD][None])
        done |= now["done"][:, 0].numpy()
        if step % LENGTH < LENGTH - 1:
            continue
        after, cars = env.engine.bodies, env.engine.episodes["cars"]
        real, failed = (
            after[row, env.engine.episodes["ego"]],
            env.engine.episodes["crashed"] | env.engine.episodes["offroad"],
        )
        found["failed"].append(np.stack([failed, foreseen.failed[0].numpy()], -1)[running])
        for one in np.nonzero(running & ~done & ~foreseen.failed[0].numpy())[0]:
            mine, seconds = foreseen.engine.bodies[one], LENGTH / world.policy_frequency
            found["ego"].append(np.linalg.norm(places(mine[0]) - places(real[one])))
            found["ego_speed"].append(np.abs(mine[0]["speed"] - real[one]["speed"]))
            there = before[one, : known[one]]
            off = places(start[one, 1 : foreseen.engine.episodes["cars"][one]]) - places(start[one, 0])
            apart = np.linalg.norm(off[:, None] - (places(there) - places(ego[one])), axis=-1)
            for car, distance in enumerate(apart):
                now_at = after[one, : cars[one]]
                same = now_at[TAG] == there[distance.argmin()][TAG]
                if distance.min() > SAME or there[distance.argmin()][TAG] == ego[one][TAG] or not same.any():
                    continue
                wanted = places(now_at[same][0]) - places(real[one])
                found["others"].append(np.linalg.norm(places(mine[1 + car]) - places(mine[0]) - wanted))
                straight = places(there[distance.argmin()]) + seconds * velocities(there[distance.argmin()])
                found["straight"].append(np.linalg.norm(straight - places(real[one]) - wanted))
    failed = np.concatenate(found.pop("failed"))
    return Errors(**{name: np.array(values) for name, values in found.items()}, failed=failed)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", metavar="WORLD", help="all by default")
    parser.add_argument("--weather", default="clear")
    parser.add_argument("--episodes", type=int, default=32)
    given = parser.parse_args()
    for name in given.worlds or WORLDS:
        found = errors(WORLDS[name], weather=given.weather, episodes=given.episodes)
        median, most = np.quantile(found.others, [0.5, 0.9])
        straight = np.quantile(found.straight, 0.9)
        real, foreseen = found.failed.T
        sys.stdout.write(
            f"| `{name}` | {found.ego.max():.2f} | {median:.2f} | {most:.2f} | {straight:.2f} | "
            f"{(real & foreseen).sum()} of {real.sum()} | {(foreseen & ~real).sum()} | {len(found.others)} |\n"
        )


if __name__ == "__main__":
    main()
