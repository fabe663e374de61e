"""How much of the way to perfect information `planner` wins if it knows the future, within the same margins.

    python studies/safe_foresight.py [--lanes 3 4 5] [--density 1 2] [--episodes 16] [--assumed-budget 0 0.1]

Tuning seeds, clear weather, no attack. `rules` is `planner`. `foresight` knows the future: in every frame it rolls 64 plans of
4 s in copies of the simulator, as `clairvoyant` does, but takes only actions that `planner` holds to be safe; where none is,
it does what `planner` does. A better choice of plans than 64 random ones, and one that counts with the margins of later frames,
would score more: this is a lower bound of what the margins allow.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from cavbench.driving.intervals.rooms import cars_of
from cavbench.driving.metrics import safe_progress
from cavbench.driving.victims.planner import IntervalPlanner, Planner
from cavbench.envs.highway.clairvoyant import LIBRARY, PLANS, ClairvoyantPlanner
from cavbench.envs.highway.ego import FASTER, IDLE, LANE_LEFT, LANE_RIGHT, SLOWER
from cavbench.envs.highway.engine import Flag, HighwayEngine, Number
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import in_one_line
from cavbench.run.process import settle
from cavbench.scenarios import Cell, SeedBlock

WORLD = HighwayWorld()
FORBIDDEN = -1e6


class Foresight:
    """Chooses the actions of an engine's episodes among those that are safe on intervals, by their simulated future."""

    def __init__(self, engine: HighwayEngine) -> None:
        self.clairvoyant = ClairvoyantPlanner(engine)
        self.plan = self.clairvoyant.plan

    def actions(self, step: int, safe: NDArray[np.bool_], otherwise: NDArray[np.int64]) -> NDArray[np.int64]:
        """The actions [B] in this step.

        Args:
            step: number of the step.
            safe: bool [B, A], the actions that may be taken.
            otherwise: [B] what is done where there is none.
        """
        tried = self.clairvoyant.library[(step * PLANS + np.arange(PLANS)) % LIBRARY][None].repeat(len(safe), 0)
        if step:
            tried[:, 0] = np.roll(self.plan, -1, axis=1)
            tried[:, 0, -1] = IDLE
        for place, action in enumerate((FASTER, IDLE, SLOWER, LANE_LEFT, LANE_RIGHT), start=1):
            tried[:, place] = FASTER if action in (LANE_LEFT, LANE_RIGHT) else action
            tried[:, place, 0] = action
        worth = self.clairvoyant.worth(np.arange(len(tried)), tried)
        worth = np.where(np.take_along_axis(safe, tried[:, :, 0], 1), worth, FORBIDDEN)
        self.plan = tried[np.arange(len(tried)), worth.argmax(1)]
        return np.where(worth.max(1) > FORBIDDEN, self.plan[:, 0], otherwise)


def driven(cell: Cell, episodes: int, budget: float, foresight: bool) -> tuple[float, float]:
    """Mean `safe_progress` and share of crashes of the episodes of a cell."""
    engine = HighwayEngine(WORLD.configuration((cell,) * episodes))
    engine.reset(np.arange(episodes), SeedBlock.TUNE + np.arange(episodes))
    policy = Planner(assumed_budget=budget).load(0, WORLD.facts)
    assert isinstance(policy, IntervalPlanner)
    state, seer = policy.initial(torch.arange(episodes)), Foresight(engine)
    progress, failed = np.zeros(episodes, np.float32), np.zeros(episodes, np.bool_)
    for step in range(WORLD.max_steps):
        shown = torch.from_numpy(engine.observation.copy())
        boxes = policy.assumed.boxes(shown)
        assert state is not None
        ego = policy.reckoning.now(boxes, state["ego"])
        found = policy.judge(ego, cars_of(ego, boxes))
        change = (found.change >= 0) & found.changeable
        safe = torch.cat((found.stay >= 0, change), -1)[..., policy.reckoning.order]
        action = policy.weighed(shown, boxes, state).argmax(-1).numpy()
        if foresight:
            action = seer.actions(step, safe.numpy(), action)
        state = policy.advance(shown, torch.from_numpy(action), state)
        engine.step(action)
        progress += engine.numbers[Number.PROGRESS]
        failed |= engine.flags[Flag.TERMINATED]
        if engine.flags[Flag.DONE].all():
            break
    score = safe_progress(torch.from_numpy(progress), torch.from_numpy(failed), WORLD.max_steps)
    return float(score.mean()), float(failed.mean())


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--lanes", nargs="+", type=int, default=[3, 4, 5])
    parser.add_argument("--density", nargs="+", type=float, default=[1.0, 2.0])
    parser.add_argument("--episodes", type=int, default=16)
    parser.add_argument("--assumed-budget", nargs="+", type=float, default=[0.0, 0.1])
    asked = parser.parse_args()
    settle()
    for budget, foresight in product(asked.assumed_budget, (False, True)):
        name, found = f"{'foresight' if foresight else 'rules'}, assumed budget {budget:g}", []
        for lanes, density in product(asked.lanes, asked.density):
            cell = WORLD.axes.cell(lanes=lanes, density=density, weather="clear")
            found.append(driven(cell, asked.episodes, budget, foresight))
            print(f"  {name}: {cell}: {found[-1][0]:.3f}, crashed {found[-1][1]:.0%}", flush=True)
        score, crashed = np.mean(found, 0)
        print(f"{name}: {score:.3f}, crashed {crashed:.1%}", flush=True)


if __name__ == "__main__":
    with in_one_line():
        main()
