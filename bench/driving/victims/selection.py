"""Checkpoint selection: keep the checkpoint with the best score on seeds that are never reported."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench.driving import DrivingWorld, Policy, State, TrainingHooks
from cavbench.driving.metrics import safe_progress
from cavbench.driving.policy import rows_of
from cavbench.driving.victims.practice import roads
from cavbench.scenarios import SeedBlock


@torch.no_grad()
def selection_score(
    policy: Policy,
    world: DrivingWorld,
    episodes: int,
    show: Callable[[Tensor, State], Tensor] | None = None,
    first: int = SeedBlock.SELECT,
) -> dict[str, float]:
    """Mean `safe_progress` for each road and over all, by default on the selection seeds, which are never reported.

    Args:
        policy: the policy.
        world: the world.
        episodes: number of episodes per road.
        show: perturbs the observation [B, V, F] before the policy receives it, and is given the policy's state; None for no
            perturbation.
        first: the first of the scenario seeds.
    """
    cells = roads(world, episodes)
    env = world.make(cells, action_type=policy.action_type)
    seeds = torch.arange(first, first + episodes).repeat(len(cells) // episodes)
    td = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
    state = policy.initial(torch.arange(len(cells)))
    progress, failed = torch.zeros(len(cells)), torch.zeros(len(cells), dtype=torch.bool)
    for _ in range(world.max_steps):
        running = ~td["done"].squeeze(-1)
        shown = td["observation"]
        if show is not None:
            shown = shown.clone()
            shown[running] = show(shown[running], rows_of(state, running))
        action = policy.decide(shown, state)
        td = env.step(td.set("action", action))["next"]
        state = policy.advance(shown, action, state)
        progress += td["info", "progress"].squeeze(-1) * running
        failed |= (td["info", "crashed"] | td["info", "offroad"]).squeeze(-1) & running
        if bool(td["done"].all()):
            break
    score = safe_progress(progress, failed, world.max_steps).view(-1, episodes).mean(1)
    names = [str(cell) for cell in cells[::episodes]]
    return {"mean": float(score.mean()), **dict(zip(names, score.tolist(), strict=True))}


@dataclass
class Best:
    """The best checkpoint so far, by its `selection_score` on true and perturbed (`hooks.selection`) observations.

    Args:
        world: the world for scoring.
        hooks: hooks of the training.
        episodes: number of episodes per road on true observations; a third of it on perturbed ones, which may cost ten times
            as much.
        sign: 1 keeps the highest score; -1 the lowest, for an adversary.
        defended: puts a policy behind the defence that it is trained behind; by default there is none.
    """

    world: DrivingWorld
    hooks: TrainingHooks
    episodes: int
    sign: float = 1.0
    defended: Callable[[Policy], Policy] = lambda policy: policy
    score: float | None = None
    scores: dict[str, dict[str, float]] = field(default_factory=dict)
    share: float = 0.0
    weights: dict[str, Tensor] = field(default_factory=dict)
    history: list[tuple[float, float]] = field(default_factory=list)

    def offer(self, policy: Policy, share: float) -> None:
        """Score `policy` and keep its weights if it is the best so far."""
        driver = self.defended(policy)
        scores = {"clean": selection_score(driver, self.world, self.episodes)}
        for name, show in self.hooks.selection(driver).items():
            scores[name] = selection_score(driver, self.world, self.episodes // 3, show)
        score = self.hooks.ranked({name: by_road["mean"] for name, by_road in scores.items()})
        self.history.append((round(share, 3), round(score, 4)))
        if self.score is None or self.sign * score > self.sign * self.score:
            self.score, self.scores, self.share = score, scores, share
            self.weights = copy.deepcopy(policy.state_dict())

    def restore(self, policy: Policy) -> Policy:
        """`policy` with the best weights, frozen."""
        policy.load_state_dict(self.weights)
        return policy.requires_grad_(False).eval()

    def card(self) -> dict[str, object]:
        """The entries of the card about the selection."""
        return {
            "selection": {"safe_progress": self.scores, "share_of_training": self.share, "episodes": self.episodes},
            "selection_history": self.history,
        }
