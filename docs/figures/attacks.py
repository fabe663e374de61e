"""Attacks on drivers: the same moment of one episode under each attack."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from cavbench.core.pair import choose
from cavbench.driving import DrivingAttack
from cavbench.envs.highway.config import ACTIONS
from docs.figures import road, style
from docs.figures.driving import FACTS, FEATURES, Moment, attacked, episode, physical, policy

STEP = 200
"""The moment: 13.3 s into the episode, close behind a slower car."""
LANES = 3
FAR = 2.5
"""A car that is shown displaced by more than this many m gets an arrow."""
NEAR = -0.12
"""Actions whose Q-value beyond that of the taken action never exceeds this are not drawn."""
DRAWS = 40
"""Number of draws of the noise, which makes no queries."""


def noise() -> Figure:
    """Random noise: the policy's Q-values under many draws."""
    moment = attacked(choose("attack", "noise").component, _moment(), DRAWS)
    flipped = int((_decisions(moment.shown) != _decisions(moment.true)).sum())
    title = f"noise: {flipped} of {DRAWS} random draws change the decision"
    return _figure(moment, torch.cat((moment.true[None], moment.shown)), title, "random draw")


def pessimist() -> Figure:
    """The pessimist: every car nearer and closing faster."""
    moment = attacked(choose("attack", "pessimist").component, _moment())
    points = torch.cat((moment.true[None], moment.shown))
    return _figure(moment, points, "pessimist: every car nearer and closing faster", "true and shown observation")


def plan() -> Figure:
    """The planning attack: all of its queries."""
    attack = choose("attack", "plan").component
    moments = (attacked(attack, _moment(step)) for step in range(STEP, STEP + 100))
    moment = next(each for each in moments if bool((_decisions(each.shown) != _decisions(each.true)).all()))
    asked = torch.cat([points.flatten(0, -3) for points in moment.asked])
    return _figure(moment, asked, f"plan: {len(asked)} queries turn {_turned(moment)}", "query")


def rehearse() -> Figure:
    """The rehearsing attack: the lie that it chooses."""
    moment = attacked(choose("attack", "rehearse").component, _moment())
    points = torch.cat((moment.true[None], moment.shown))
    return _figure(moment, points, "rehearse: the worst of eight lies", "true and shown observation")


def zo() -> Figure:
    """ZO-SignSGD: all of its queries."""
    moment = attacked(choose("attack", "zo").component, _moment())
    asked = torch.cat([points.flatten(0, -3) for points in moment.asked])
    return _figure(moment, asked, f"zo: {len(asked)} queries turn {_turned(moment)}", "query")


def art() -> Figure:
    """An attack of the Adversarial Robustness Toolbox: all queries of its SquareAttack."""
    moment = attacked(choose("attack", "art:SquareAttack").component, _moment())
    asked = torch.cat([points.flatten(0, -3) for points in moment.asked])
    return _figure(moment, asked, f"art:SquareAttack: {len(asked)} queries turn {_turned(moment)}", "query")


def pgd() -> Figure:
    """Projected gradient descent: the steps of the best restart."""
    return _descent("pgd", choose("attack", "pgd").component, "ten")


def two_stage() -> Figure:
    """The two-stage attack: the steps of the best restart."""
    return _descent("two_stage", _learned("two_stage"), "eight")


def paad() -> Figure:
    """PA-AD: the steps of the best restart."""
    return _descent("paad", _learned("paad"), "eight")


def sarsa() -> Figure:
    """Robust Sarsa: the steps of the best restart."""
    return _descent("sarsa", _learned("sarsa"), "ten")


def none() -> Figure:
    """No attack: a clean episode."""
    _, steps = episode("attack=none", "victim=dqn")
    title = f"none: the policy sees what is there; {len(steps['speed']) / FACTS.decision_hz:.0f} s without a crash"
    made = style.figure(4.6, title)
    above, speed, values = made.subplots(3, 1, height_ratios=(1.1, 1, 1.5))
    true = _moment()
    _bird(above, Moment(true, shown=true[None], radius=torch.zeros_like(true), asked=[]))
    seconds = [step / FACTS.decision_hz for step in range(len(steps["speed"]))]
    speed.plot(seconds, steps["speed"], color=style.TRUE)
    speed.set(ylabel="speed (m/s)", xlim=(0, seconds[-1]), xticklabels=[])
    for number, name in enumerate(ACTIONS):
        taken = [second for second, action in zip(seconds, steps["action"], strict=True) if action == number]
        values.plot(taken, [number] * len(taken), "|", color=style.ACTIONS[name], ms=9)
    values.set(xlabel="time (s)", yticks=range(len(ACTIONS)), yticklabels=ACTIONS, xlim=(0, seconds[-1]))
    values.invert_yaxis()
    for axes in (speed, values):
        axes.axvline(STEP / FACTS.decision_hz, color=style.GREY, lw=1, ls=":")
    return made


def _moment(step: int = STEP) -> Tensor:
    return torch.tensor(episode("attack=none", "victim=dqn")[1]["observation"][step])


def _learned(name: str) -> DrivingAttack:
    """An attack that learns, with its network against the undefended `dqn` of training seed 0."""
    attack = choose("attack", name).component
    adversary = attack.load(choose("victim", "dqn").component, choose("defense", "none").component, 0, FACTS)
    return attack.armed(adversary)


def _descent(name: str, attack: DrivingAttack, count: str) -> Figure:
    """A descent from several starts: the steps of the best one."""
    # The first moment at which the attack changes the decision.
    moments = (attacked(attack, _moment(step)) for step in range(STEP, STEP + 100))
    moment = next(each for each in moments if bool((_decisions(each.shown) != _decisions(each.true)).all()))
    restarts = [points for points in moment.asked if points.ndim == 4]
    steps = torch.stack(restarts)[:, :, 0]
    winner = (steps == moment.shown).flatten(2).all(-1).any(0).int().argmax()
    taken = torch.cat((moment.true[None], steps[:, winner]))
    queries = sum(points.shape[:-2].numel() for points in moment.asked)
    title = f"{name}: {count} gradient steps turn {_turned(moment)}"
    return _figure(
        moment, taken, title, f"gradient step of the best of {steps.shape[1]} restarts\n({queries} queries in all)"
    )


def _decisions(observations: Tensor) -> Tensor:
    return policy().decide(observations)


def _turned(moment: Moment) -> str:
    before, after = (ACTIONS[int(_decisions(each))] for each in (moment.true, moment.shown[0]))
    return f"{before} into {after}"


def _figure(moment: Moment, points: Tensor, title: str, counted: str) -> Figure:
    """The road, the perturbation as a share of its budget, and the Q-values of `points` [N, V, F]."""
    made = style.figure(5.4, title)
    above, below = made.subfigures(2, 1, height_ratios=(1, 1.8))
    _bird(above.subplots(), moment)
    used, values = below.subplots(1, 2, width_ratios=(1, 2.1))
    _budget(used, moment)
    _values(values, moment, points, counted)
    return made


def _bird(axes: Axes, moment: Moment) -> None:
    """The true and the shown positions of the cars around the ego."""
    present = moment.true[:, 0] > 0
    true, shown = (physical(each)[present] for each in (moment.true, moment.shown[0]))
    ego = float(true[0, 1])
    there, seen = (
        [(0.0, float(each[0, 1])), *((float(car[0]), ego + float(car[1])) for car in each[1:])]
        for each in (true, shown)
    )
    road.lanes(axes, LANES, (-14, 106))
    road.cars(axes, there[1:], style.TRUE)
    road.cars(axes, there[:1], style.INK)
    if not torch.equal(moment.true, moment.shown[0]):
        road.cars(axes, seen, style.SHOWN, filled=False)
        arrow = {"arrowstyle": "->", "color": style.SHOWN, "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
        for (x, y), (to_x, to_y) in zip(there, seen, strict=True):
            if abs(to_x - x) > FAR:
                axes.annotate("", (to_x, to_y), (x, y), arrowprops=arrow)
        axes.set_title("filled: where the cars are (black: own); outlined: where it is shown them", fontsize=10)
    else:
        axes.set_title("the moment at the dotted line: own car black, the others blue", fontsize=10)
    axes.set_xlabel("m ahead", labelpad=1)


def _budget(axes: Axes, moment: Moment) -> None:
    """The deviation of each value as a share of the allowed one."""
    rows = int((moment.true[:, 0] > 0).sum())
    share = ((moment.shown[0] - moment.true) / moment.radius)[:rows, 1:]
    axes.imshow(share, cmap="PuOr", vmin=-1, vmax=1, aspect="auto")
    axes.set(xticks=range(4), xticklabels=FEATURES.names, yticks=(0, rows - 1), yticklabels=("own", "farthest"))
    axes.set_title("budget used: brown\n−100 %, violet +100 %", fontsize=10)
    axes.tick_params(length=0)


def _values(axes: Axes, moment: Moment, points: Tensor, counted: str) -> None:
    """Q-values of `points` [N, V, F] minus that of the clean action, which the policy takes at the first point."""
    with torch.no_grad():
        values = policy().scores(points)
    clean, now = int(values[0].argmax()), int(_decisions(moment.shown[0]))
    lead = values - values[:, clean : clean + 1]
    axes.axhspan(0, 1, color=style.RED, alpha=0.07, lw=0)
    for number, name in enumerate(ACTIONS):
        if lead[:, number].max() < NEAR:
            continue
        strong = number in (clean, now)
        axes.plot(lead[:, number], color=style.ACTIONS[name], lw=2.4 if strong else 1.2, label=name)
    shown = int((points == moment.shown[0]).flatten(1).all(1).nonzero()[0])
    axes.plot(shown, lead[shown, now], "o", mfc="none", mec=style.INK, ms=10, mew=1.6)
    axes.annotate("shown", (shown, lead[shown, now]), (0, 9), textcoords="offset points", ha="center", fontsize=10)
    axes.set(xlabel=counted, ylim=(-0.13, 0.1), xlim=(-0.5, len(points) - 0.5))
    axes.set_title(f"Q-value beyond that of {ACTIONS[clean]}\n(above 0: the decision changes)", fontsize=10)
    axes.legend(loc="upper left", ncols=2, fontsize=9, handlelength=1.2, columnspacing=1)
