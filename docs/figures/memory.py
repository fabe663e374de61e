"""Components with a memory: an attack that holds its offset, a defence that looks back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavbench.core.pair import choose
from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, ObservationThreat, Policy
from docs.figures import style
from docs.figures.driving import FACTS, FEATURES, Array, episode, physical, scored

OWN = 0
"""The row that is drawn."""
SECONDS = 6.0
FRAMES = (1, 2, 3, 4)
EPISODES = 20
LOOKS = {
    "none": (style.BLUE, "-"),
    "noise": (style.GREY, "-."),
    "bias": (style.ORANGE, "--"),
    "pgd": (style.RED, "-"),
}
"""Of the attacks."""


def bias() -> Figure:
    """The own place across the road as it is shown, and the share of what is allowed that it is off by, beside other attacks."""
    made = style.figure(4.8, "bias: the same share of the budget at every step")
    place, used = made.subplots(2, 1, sharex=True, height_ratios=(1, 1.2))
    _, steps = episode("attack=bias", "victim=dqn")
    for name, colour, text in (("observation", style.TRUE, "measured"), ("perturbed", style.SHOWN, "shown")):
        place.plot(_seconds(steps), _own(torch.tensor(steps[name]), "y"), color=colour, lw=2.2, label=text)
    place.set(ylabel="own place across\nthe road (m)")
    place.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2)
    for attack in ("noise", "pgd", "bias"):
        _, steps = episode(f"attack={attack}", "victim=dqn")
        colour, dashes = LOOKS[attack]
        used.plot(
            _seconds(steps),
            100 * _share(steps, "y"),
            color=colour,
            ls=dashes,
            lw=2.6 if attack == "bias" else 1.4,
            label=attack,
        )
    used.set(xlabel="time (s)", ylabel="% of what\nis allowed", xlim=(0, SECONDS), ylim=(-112, 112))
    used.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3)
    return made


def frame_stack() -> Figure:
    """What reaches the policy under noise, and what the defence costs and saves."""
    made = style.figure(4.0, "frame_stack: smooth, but late")
    seen, scores = made.subplots(1, 2, width_ratios=(1.15, 1))
    _, steps = episode("attack=noise", "victim=dqn")
    shown = torch.tensor(steps["perturbed"])
    behind = _behind(4, shown)
    for values, colour, text, width in (
        (shown, style.GREY, "shown under noise", 1.2),
        (torch.tensor(steps["observation"]), style.TRUE, "measured", 2.2),
        (behind, style.GREEN, "seen behind 4 frames", 2.2),
    ):
        seen.plot(_seconds(steps), _own(values, "vx"), color=colour, lw=width, label=text)
    seen.set(xlabel="time (s)", ylabel="own speed (m/s)", xlim=(0, SECONDS))
    for attack, (colour, dashes) in LOOKS.items():
        means = [_safe_progress(attack, frames) for frames in FRAMES]
        scores.plot(FRAMES, [100 * mean for mean in means], color=colour, ls=dashes, marker="o", ms=4, label=attack)
    scores.set(xlabel="frames (1: no defence)", ylabel="safe progress, %", xticks=FRAMES, ylim=(-3, 103))
    scores.set_title(f"dqn, {EPISODES} scenarios", fontsize=10.5)
    seen.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), fontsize=9.5)
    scores.legend(loc="upper right", fontsize=9.5)
    return made


@cache
def _safe_progress(attack: str, frames: int) -> float:
    """Mean over the first scenarios of the standard grid on the road that is shown."""
    defense = ["defense=frame_stack", f"defense.frames={frames}"] if frames > 1 else []
    return float(scored(EPISODES, f"attack={attack}", "victim=dqn", *defense).columns["safe_progress"].mean())


def _seconds(steps: dict[str, Array]) -> Array:
    return np.arange(len(steps["speed"])) / FACTS.decision_hz


def _own(observations: Tensor, feature: str) -> Array:
    """[T] a feature of the ego, in its unit."""
    return physical(observations)[:, OWN, FEATURES.names.index(feature)].numpy()


def _share(steps: dict[str, Array], feature: str) -> Array:
    """[T] the share of the radius that a feature of the ego is off by."""
    truth, shown = (torch.tensor(steps[name]) for name in ("observation", "perturbed"))
    share = (shown - truth) / ObservationThreat().radius(truth, FEATURES)
    return share[:, OWN, 1 + FEATURES.names.index(feature)].numpy()


class _Echo(Policy):
    """Its scores are what reaches it."""

    action_type = "discrete"

    def forward(self, observation: Tensor) -> Tensor:
        return observation.flatten(-2)


@dataclass(frozen=True, kw_only=True)
class _Looking(DrivingVictim):
    """Loads `_Echo`."""

    @property
    def action_type(self) -> ActionType:
        return "discrete"

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return _Echo()


def _behind(frames: int, shown: Tensor) -> Tensor:
    """[T, V, F] what the policy sees of the observations [T, V, F] of an episode."""
    policy = choose("defense", "frame_stack", frames=frames).component.load(_Looking(), 0, FACTS)
    state, found = policy.initial(torch.zeros(1, dtype=torch.int64)), []
    for observation in shown.split(1):
        scores = policy.scores(observation, state)
        found.append(scores.unflatten(-1, observation.shape[-2:]))
        state = policy.advance(observation, policy.choose(scores), state)
    return torch.cat(found)
