"""Components that act on intervals: the planner's decisions, the shield's mask, and the boxes of the tracker."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from tensordict import TensorDict

from cavbench.attacks.driving.noise import Noise
from cavbench.defenses.driving.pessimist_q import PessimistQ
from cavbench.defenses.driving.tracker import Tracked, Tracker
from cavbench.driving import ObservationThreat, Policy
from cavbench.driving.access import Enforcer
from cavbench.driving.intervals.margins import Margins
from cavbench.driving.intervals.rooms import cars_of
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.planner import IntervalPlanner, Planner
from cavbench.envs.highway.config import ACTIONS
from cavbench.envs.highway.world import HighwayWorld
from docs.figures import style
from docs.figures.decisions import BLOCKED, CLOSING, DISTANCE, _map, _observations
from docs.figures.driving import FACTS

BUDGETS = (0.0, 0.1)
SEED, STEPS = 1_000_000, 90


def planner() -> Figure:
    """The action by distance and closing speed, boxed in, for two assumed budgets."""
    policies = {f"assumed budget {budget:.0%}": Planner(assumed_budget=budget).load(0, FACTS) for budget in BUDGETS}
    return _decisions("planner: the larger the assumed budget, the earlier it brakes", policies)


def pessimist_q() -> Figure:
    """The action of `dqn` by distance and closing speed, boxed in: by the value at the middle, and by the lowest value."""
    policies = {
        f"pessimism {pessimism:.0f}": PessimistQ(pessimism=pessimism).load(DQN(), 0, FACTS) for pessimism in (0.0, 1.0)
    }
    return _decisions("pessimist_q: left, what dqn does; right, by its lowest values", policies)


def _decisions(title: str, policies: Mapping[str, Policy]) -> Figure:
    """The action of each policy, boxed in, by distance and closing speed."""
    made = style.figure(4.1, title)
    flat = _observations(BLOCKED).flatten(0, 1)
    for axes, (name, policy) in zip(made.subplots(1, len(policies), sharey=True), policies.items(), strict=True):
        with torch.no_grad():
            action = policy.decide(flat, policy.initial(torch.arange(len(flat)))).view(len(CLOSING), len(DISTANCE))
        _map(axes, action, name, ListedColormap(list(style.ACTIONS.values())), (-0.5, len(ACTIONS) - 0.5))
    made.axes[0].set_ylabel("closing speed (m/s), own: 25")
    patches = [Patch(color=style.ACTIONS[name], label=name) for name in ACTIONS]
    made.legend(handles=patches, loc="outside lower center", ncols=5, fontsize=9.5, handlelength=1, columnspacing=1)
    return made


def shield() -> Figure:
    """The margin of FASTER and of SLOWER by distance and closing speed."""
    made = style.figure(4.3, "shield: where FASTER and SLOWER are safe")
    policy = Planner().load(0, FACTS)
    assert isinstance(policy, IntervalPlanner)
    flat = _observations(BLOCKED).flatten(0, 1)
    boxes = policy.assumed.boxes(flat)
    with torch.no_grad():
        ego = policy.reckoning.now(boxes, policy.reckoning.unknown(torch.arange(len(flat))))
        found: Margins = policy.judge(ego, cars_of(ego, boxes))
    for place, (axes, name) in enumerate(zip(made.subplots(1, 2, sharey=True), ("FASTER", "SLOWER"), strict=True)):
        margin = found.stay[:, 2 * place].view(len(CLOSING), len(DISTANCE)).clamp(-30, 30)
        drawn = _map(axes, margin, f"margin of {name} (m)", colormaps["PuOr"].resampled(12), (-30, 30))
        axes.contour(DISTANCE, CLOSING, margin, levels=[0.0], colors=style.INK, linewidths=1.2)
        made.colorbar(drawn, ax=axes, location="bottom", aspect=16)
    made.axes[0].set_ylabel("closing speed (m/s), own: 25")
    return made


def tracker() -> Figure:
    """The interval of the distance to the nearest car under noise, from one frame and from all frames so far."""
    made = style.figure(3.8, "tracker: intervals from all frames so far")
    axes = made.subplots()
    world = HighwayWorld()
    env = world.make([world.axes.cell(lanes=3, density=1.0, weather="clear")])
    policy = Tracked(Tracker(), Planner().load(0, FACTS), FACTS)
    threat = ObservationThreat()
    generator = torch.Generator().manual_seed(0)
    td = env.reset(TensorDict({"seed": torch.tensor([SEED])}, batch_size=[1]))
    state, rows = policy.initial(torch.tensor([0])), []
    with torch.no_grad():
        for _ in range(STEPS):
            truth = td["observation"]
            enforcer = Enforcer(CountedPolicy(policy), threat, "oblivious", FACTS.features, generator)
            shown = enforcer.project(Noise().perturb(truth, enforcer.begin(truth, state)))[0]
            plain, boxes = policy.assumed.boxes(shown), policy.boxes(shown, state)
            rows.append(
                [float(truth[0, 1, 1]) * 100, *(float(side[0, 1, 0]) for each in (plain, boxes) for side in each[1:])]
            )
            action = policy.decide(shown, state)
            state = policy.advance(shown, action, state)
            td = env.step(td.set("action", action))["next"]
    seconds, drawn = np.arange(STEPS) / FACTS.decision_hz, np.array(rows)
    axes.fill_between(seconds, drawn[:, 1], drawn[:, 2], color=style.GREY, alpha=0.35, lw=0, label="one frame")
    axes.fill_between(seconds, drawn[:, 3], drawn[:, 4], color=style.BLUE, alpha=0.6, lw=0, label="tracked")
    axes.plot(seconds, drawn[:, 0], color=style.INK, lw=1.2, label="truth")
    axes.set(xlabel="time (s)", ylabel="nearest car ahead\nor behind (m)", xlim=(0, seconds[-1]))
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3)
    return made
