"""Victims under attack, undefended and adversarially trained (hardened)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cavbench import zoo
from cavbench.core.pair import choose
from cavbench.defenses.driving.advtrain import AdversarialTraining
from cavbench.defenses.driving.car import ConsistentAdversarialRobustness
from cavbench.defenses.driving.robust_loss import RobustLoss
from cavbench.defenses.driving.sa import StateAdversarial
from cavbench.driving import DrivingDefense, ObservationThreat, Policy
from cavbench.driving.attacker import Attacker
from cavbench.driving.victim import CountedPolicy
from cavbench.driving.victims.dqn import DQN
from docs.figures import style
from docs.figures.driving import FEATURES, episode, policy
from docs.figures.sightings import clean, curve, frame_axes, patched, undisturbed

BUDGETS = (0.01, 0.025, 0.05, 0.1, 0.15, 0.2)
TRAINED_AT = 0.1
EVERY = 5
"""A moment is attacked every so many steps of the episode."""
SKIPS = ("0", "0.3", "0.5", "1")
SEEDS = (0, 1, 2)


def none() -> Figure:
    """Share of decisions of the undefended DQN that attacks change, and the confidence of YOLOv3-tiny under patches."""
    made = style.figure(3.7, "none: small changes turn the undefended")
    driving, detection = made.subplots(1, 2, width_ratios=(1.25, 1))
    for attack, colour, dashes in (("pgd", style.RED, "-"), ("zo", style.ORANGE, "--"), ("noise", style.GREY, "-.")):
        changed = [_changed(attack, "none", budget) for budget in BUDGETS]
        driving.plot(
            _percent(BUDGETS), _percent(changed), color=colour, ls=dashes, marker="o", ms=4, lw=2.2, label=attack
        )
    _changes(driving, "dqn")
    driving.legend(loc="upper left", bbox_to_anchor=(0.35, 0.93), fontsize=10)
    pair = patched("eot")
    measured = {
        "none": undisturbed(pair),
        "grey": pair.baseline_scores["grey_patch"].estimate,
        "noise": pair.baseline_scores["noise_patch"].estimate,
        "eot": pair.score.estimate,
    }
    colours = (style.BLUE, style.GREY, style.GREY, style.RED)
    detection.bar_label(detection.bar(list(measured), list(measured.values()), color=colours), fmt="%.2f", fontsize=10)
    detection.set(ylabel="stop score", xlabel="patch", ylim=(0, 1))
    detection.set_title("yolov3_tiny", fontsize=10.5)
    return made


def advtrain() -> Figure:
    """Share of decisions that PGD changes, undefended and hardened, and the trade-off of the skip probability."""
    made = style.figure(3.9, "advtrain: the hardened policy is harder to turn")
    turned, traded = made.subplots(1, 2)
    for defense, colour, dashes in (("none", style.UNDEFENDED, "-"), ("advtrain", style.HARDENED, "--")):
        changed = [_changed("pgd", defense, budget) for budget in BUDGETS]
        turned.plot(_percent(BUDGETS), _percent(changed), color=colour, ls=dashes, marker="o", ms=4, lw=2.2)
    _changes(turned, "dqn under pgd")
    turned.axvline(100 * TRAINED_AT, color=style.GREY, lw=1, ls=":")
    turned.annotate("undefended", (7, 91), color=style.UNDEFENDED)
    turned.annotate("hardened", (11.5, 45), color=style.HARDENED)
    turned.annotate("budget of\nthe training", (10.3, 3), color=style.GREY, fontsize=9.5)
    cards = {skip: [_scores(AdversarialTraining(skip=float(skip)), seed) for seed in SEEDS] for skip in SKIPS}
    for score, colour in (("clean", style.BLUE), ("attacked", style.RED)):
        known = {skip: _percent([card[score] for card in cards[skip]]) for skip in SKIPS if score in cards[skip][0]}
        means = [each.mean() for each in known.values()]
        traded.plot(list(known), means, color=colour, marker="o", lw=2.2, label=score)
        for skip, each in known.items():
            traded.plot([skip] * len(each), each, "_", color=colour, ms=9)
    traded.set(xlabel="skip probability", ylabel="safe progress, %", ylim=(0, 103))
    traded.set_title("hardened dqn, three seeds", fontsize=10.5)
    traded.legend(loc="lower right", fontsize=10)
    return made


def sa() -> Figure:
    """As `_robust`, for the regulariser of state-adversarial learning."""
    return _robust("sa", StateAdversarial(), [{}, {"weight": 0.3}, {"weight": 0.3, "budget": 0.02}])


def car() -> Figure:
    """As `_robust`, for consistent adversarial robustness."""
    return _robust("car", ConsistentAdversarialRobustness(), [{}, {"budget": 0.02}])


def _robust(name: str, defense: RobustLoss, variants: Sequence[dict[str, float]]) -> Figure:
    """What the DQN decides at the moments of one episode, and safe progress of trainings with other parameters."""
    made = style.figure(3.9, f"{name}: decisions that cannot be turned depend on little")
    decided, traded = made.subplots(1, 2)
    moments = torch.tensor(episode("attack=none", "victim=dqn")[1]["observation"])
    drivers = {"undefended": "none", "advtrain": "advtrain", name: name}
    shares = np.array([_shares(policy("dqn", each), moments) for each in drivers.values()])
    left = np.zeros(len(drivers))
    for (action, colour), share in zip(style.ACTIONS.items(), shares.T, strict=True):
        decided.barh(list(drivers), share, left=left, color=colour, label=action.lower().replace("_", " "))
        left += share
    decided.invert_yaxis()
    decided.set(xlabel="share of the decisions, %", xlim=(0, 100))
    decided.set_title("dqn, one episode without an attack", fontsize=10.5)
    decided.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, fontsize=9.5)
    cards = [_scores(replace(defense, **changes), 0) for changes in variants]
    for place, (score, colour) in enumerate((("clean", style.BLUE), ("attacked", style.RED))):
        where = np.arange(len(cards)) + 0.38 * (place - 0.5)
        bars = traded.bar(where, _percent([card[score] for card in cards]), 0.36, color=colour, label=score)
        traded.bar_label(bars, fmt="%.0f", fontsize=10)
    named = ["\n".join(f"{key}\n{value:g}" for key, value in changes.items()) or "default" for changes in variants]
    traded.set_xticks(range(len(named)), named, fontsize=9)
    traded.set(ylabel="safe progress, %", ylim=(0, 103))
    traded.set_title(f"dqn + {name}", fontsize=10.5)
    traded.legend(loc="upper left", fontsize=10)
    return made


def _shares(driver: Policy, moments: torch.Tensor) -> np.ndarray:
    """Share of each action among the decisions at some moments, %."""
    with torch.no_grad():
        return _percent(np.bincount(driver.decide(moments).numpy(), minlength=len(style.ACTIONS)) / len(moments))


def advtrain_detection() -> Figure:
    """Confidence during the approach, undefended and hardened, from the published records."""
    pairs = {"undefended": patched("eot"), "hardened": patched("eot", "advtrain_detection")}
    left = {name: pair.score.estimate for name, pair in pairs.items()}
    title = f"advtrain: stop score under eot {left['undefended']:.2f} undefended,\n{left['hardened']:.2f} hardened"
    made = style.figure(4.0, title)
    for axes, (name, pair) in zip(made.subplots(1, 2, sharey=True), pairs.items(), strict=True):
        curve(axes, clean(pair), style.BLUE, "no patch")
        curve(axes, pair.own.table, style.RED, "eot", "--")
        frame_axes(axes)
        axes.set_title(f"yolov3_tiny, {name}", fontsize=10.5)
    made.axes[1].set_ylabel("")
    made.legend(*made.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return made


def _changed(attack: str, defense: str, budget: float) -> float:
    """Share of the moments of one episode at which an attack changes the decision of the (defended) DQN."""
    moments = torch.tensor(episode("attack=none", "victim=dqn")[1]["observation"][::EVERY])
    driver = policy("dqn", defense)
    threat = ObservationThreat(budget=budget)
    attacker = Attacker(choose("attack", attack).component, CountedPolicy(driver), threat, FEATURES, seed=0)
    shown = attacker.show(moments, torch.ones(len(moments), dtype=torch.bool), None).observation
    with torch.no_grad():
        return float((driver.decide(shown) != driver.decide(moments)).float().mean())


def _scores(defense: DrivingDefense, seed: int) -> dict[str, float]:
    """Safe progress, `clean` and `attacked`, of a DQN that a defence trained, on the seeds that selected its checkpoint."""
    scores = zoo.card(zoo.Recipe.of(DQN(), defense), seed)["selection"]["safe_progress"]
    return {name: float(score["mean"]) for name, score in scores.items()}


def _changes(axes: Axes, title: str) -> None:
    axes.set(xlabel="budget, % of each value", ylabel="decisions changed, %", ylim=(0, 103))
    axes.set_title(title, fontsize=10.5)


def _percent(shares: object) -> np.ndarray:
    return 100 * np.asarray(shares, dtype=np.float64)
