"""The alternating training of a policy and its adversary."""

from __future__ import annotations

from matplotlib.figure import Figure

from cavbench import zoo
from cavbench.defenses.driving.atla import AlternatingTraining
from cavbench.driving.victims.dqn import DQN
from docs.figures import style


def atla() -> Figure:
    """Safe progress of the checkpoints, clean and under the adversary of the moment, from the card."""
    recipe = AlternatingTraining()
    curve: list[dict[str, float]] = zoo.card(zoo.Recipe.of(DQN(), recipe), 0)["selection_history"]
    made = style.figure(3.7, "atla: scores of the checkpoints over the training")
    axes = made.subplots()
    turns = range(len(curve))
    for name, colour, dashes, label in (
        ("clean", style.BLUE, "-", "clean"),
        ("attacked", style.RED, "--", "under its own adversary"),
    ):
        scores = [100 * one[name] for one in curve]
        axes.plot(turns, scores, color=colour, ls=dashes, marker="o", ms=4, lw=2.2, label=label)
    full = next(turn for turn, one in enumerate(curve) if one["scale"] == 1)
    best = max(range(full, len(curve)), key=lambda turn: curve[turn]["clean"] + curve[turn]["attacked"])
    for turn, text, height in ((full, "full budget", 91), (best, "ships", 97)):
        axes.axvline(turn, color=style.GREY, lw=1, ls=":")
        axes.annotate(text, (turn + 0.1, height), color=style.GREY, fontsize=9.5)
    axes.set(xlabel="turns of the policy", ylabel="safe progress, %", ylim=(0, 103))
    axes.legend(loc="lower left", fontsize=10)
    return made
