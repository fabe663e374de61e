"""What no attack within a threat model can change: decisions of frames, and the score of whole scenarios."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from cavbench.core import sets
from cavbench.core.pair import Pair
from cavbench.core.progress import share_done
from cavbench.core.track import Certified
from cavbench.driving.attacker import Attacker
from cavbench.driving.bounds.networks import BoundedNetwork
from cavbench.driving.contracts import DrivingAttack, DrivingVictim, DrivingWorld
from cavbench.driving.metrics import safe_progress
from cavbench.driving.policy import Policy
from cavbench.driving.threat import ObservationThreat, bounds
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.scenarios import Cell

Watcher = Callable[[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]], None]
"""Is told, of each step, the truth [B, V, F], the running episodes, the decisions, and the possible ones by both bounds."""
TOGETHER = 64
"""Branches that are driven in one batch."""


@dataclass
class Branch:
    """One course of a scenario: an attack may have changed the decisions of some frames.

    Args:
        scenario: number of the scenario.
        actions: decisions up to and with the last one that was changed; after them the victim decides on the truth.
        changed: number of frames whose decision was changed.
        before: the true observation [V, F] of the last changed frame.
        score: its score, once it is driven.
    """

    scenario: int
    actions: list[int] = field(default_factory=list)
    changed: int = 0
    before: Tensor | None = None
    score: float = np.nan


class Certifier:
    """Certifies one policy in the scenarios of a world.

    Args:
        pair: the attack that is compared with the bounds, the defended victim, world and threat model.
        training_seed: training seed of the victim.
        cells: the cell of each scenario [S].
        seeds: the seed of each scenario [S].

    Raises:
        UserError: if its decisions cannot be bounded.
    """

    def __init__(self, pair: Pair, training_seed: int, cells: Sequence[Cell], seeds: Sequence[int]) -> None:
        world, threat, victim = pair.world.component, pair.threat, pair.victim.component
        assert isinstance(world, DrivingWorld)
        assert isinstance(threat, ObservationThreat)
        assert isinstance(victim, DrivingVictim)
        if beyond := list(sets.present(threat)):
            raise UserError(
                f"bounds are of changed values, this threat model allows more than that: leave out threat.{beyond[0]}"
            )
        self.world, self.threat, self.facts = world, threat, world.facts_at(cells[0])
        self.pair, self.training_seed = pair, training_seed
        self.cells, self.seeds = list(cells), list(seeds)
        self.policy: Policy = pair.load(training_seed, cells[0])
        if self.policy.initial(torch.zeros(1, dtype=torch.int64)) is not None:
            raise UserError(f"bounds need a victim without a memory, {pair.defense} + {pair.victim} has one")
        self.network = BoundedNetwork(self.policy)
        self.frames = threat.frames(self.facts.max_steps)

    def certify(self, leaves: int) -> Certified:
        """Bound every frame without an attack, ask the attack about each, then drive all courses that are left.

        Args:
            leaves: courses of a scenario that are driven at most; 0 bounds the frames alone.
        """
        count = len(self.seeds)
        clean = [Branch(scenario) for scenario in range(count)]
        shares, courses = self._clean(clean)
        scores = np.array([branch.score for branch in clean])
        bound, given_up = (
            self._tree(courses, scores, leaves) if leaves else (np.full(count, np.nan), np.zeros(count, bool))
        )
        return Certified(seeds=np.array(self.seeds), **shares, clean=scores, bound=bound, given_up=given_up)

    def _tree(
        self, courses: list[Branch], clean: NDArray[np.float64], leaves: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Drive the courses of each scenario until none is left, one fails, or there are too many: then its bound is 0."""
        bound, driven, given_up = clean.copy(), np.ones(len(clean), np.int64), np.zeros(len(clean), np.bool_)
        while courses:
            waiting = np.bincount([one.scenario for one in courses], minlength=len(bound))
            given_up |= (driven + waiting > leaves) & (bound > 0)
            bound[given_up] = 0.0
            courses = [one for one in courses if bound[one.scenario] > 0]
            part, courses = courses[:TOGETHER], courses[TOGETHER:]
            if part:
                courses += self._drive(part)
            for one in part:
                driven[one.scenario] += 1
                bound[one.scenario] = min(bound[one.scenario], one.score)
        return bound, given_up

    def _clean(self, branches: list[Branch]) -> tuple[dict[str, NDArray[np.float64]], list[Branch]]:
        """Of each scenario without an attack the share of frames by what is known of them, and the courses that leave it."""
        attack = self.pair.armed(self.training_seed)
        assert isinstance(attack, DrivingAttack)
        dynamics = self.world.dynamics(self.cells, self.policy.action_type)
        attacker = Attacker(
            attack, CountedPolicy(self.policy), self.threat, self.facts.features, seed=0, dynamics=dynamics
        )
        counted = {name: np.zeros(len(branches)) for name in ("frames", "interval", "linear", "changed", "refuted")}

        def watch(truth: Tensor, running: Tensor, action: Tensor, possible: tuple[Tensor, Tensor]) -> None:
            shown = attacker.show(truth, running, None).observation
            changed = self.policy.decide(shown) != action
            by_interval, by_linear = (only(found, action) for found in possible)
            refuted = changed & ~possible[1].gather(1, self.policy.decide(shown)[:, None]).squeeze(1)
            for name, value in zip(counted, (running, by_interval, by_linear, changed, refuted), strict=True):
                counted[name] += (value & running).numpy()

        courses = self._drive(branches, watch)
        frames = counted.pop("frames")
        if counted.pop("refuted").any():
            raise UserError("an attack made a decision that the bounds had ruled out: please report this error")
        return {name: value / np.maximum(frames, 1) for name, value in counted.items()}, courses

    @torch.no_grad()
    def _drive(self, branches: list[Branch], watch: Watcher | None = None) -> list[Branch]:
        """Drive branches to their end, set their scores, and return the branches that leave them."""
        found: list[Branch] = []
        env = self.world.make([self.cells[one.scenario] for one in branches], action_type="discrete")
        try:
            self._drive_in(env, branches, watch, found)
        finally:
            env.close(raise_if_closed=False)
        return found

    def _drive_in(self, env: EnvBase, branches: list[Branch], watch: Watcher | None, found: list[Branch]) -> None:
        seeds = torch.tensor([self.seeds[one.scenario] for one in branches])
        td = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
        planned = torch.tensor([len(one.actions) for one in branches])
        progress, failed = torch.zeros(len(branches)), torch.zeros(len(branches), dtype=torch.bool)
        taken: list[Tensor] = []
        for step in range(self.facts.max_steps):
            share_done(step / self.facts.max_steps)
            truth, running = td["observation"], ~td["done"].squeeze(-1)
            action = self.policy.decide(truth)
            self._check_repeated(branches, truth, step)
            free = running & (planned <= step)
            given = [one.actions[step] if step < len(one.actions) else 0 for one in branches]
            action = torch.where(planned > step, torch.tensor(given), action)
            asked = free & torch.tensor([one.changed < self.frames for one in branches])
            possible = self._possible(truth, asked if watch is None else running)
            if watch is not None:
                watch(truth, running, action, possible)
            past = torch.stack([*taken, action], 1)
            for row in (asked & (possible[1].sum(1) > 1)).nonzero().squeeze(-1).tolist():
                for other in possible[1][row].nonzero().squeeze(-1).tolist():
                    if other != int(action[row]):
                        course = [*past[row, :-1].tolist(), other]
                        own = branches[row]
                        found.append(Branch(own.scenario, course, own.changed + 1, truth[row].clone()))
            taken.append(action)
            td = env.step(td.set("action", action))["next"]
            info = td["info"]
            progress += torch.where(running, info["progress"].squeeze(-1), 0.0)
            failed |= (info["crashed"] | info["offroad"]).squeeze(-1) & running
            if bool(td["done"].all()):
                break
        for one, score in zip(branches, safe_progress(progress, failed, self.facts.max_steps).tolist(), strict=True):
            one.score = score

    def _check_repeated(self, branches: list[Branch], truth: Tensor, step: int) -> None:
        """Raise UserError if the same actions do not lead to the same observation: a tree of actions says nothing then."""
        for own, one in zip(truth, branches, strict=True):
            if len(one.actions) == step + 1 and one.before is not None and not torch.equal(own, one.before):
                raise UserError("the world does not repeat a scenario with the same actions: use leaves=0")

    def _possible(self, truth: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """As `BoundedNetwork.possible`, for the chosen rows, bool [B]; all False for the others."""
        scores = self.policy.scores(truth)
        found = torch.zeros(2, *scores.shape, dtype=torch.bool)
        if bool(rows.any()):
            chosen = truth[rows]
            box = bounds(chosen, self.threat.radius(chosen, self.facts.features))
            found[0][rows], found[1][rows] = self.network.possible(scores[rows], *box)
        return found[0], found[1]


def only(possible: Tensor, action: Tensor) -> Tensor:
    """bool [B], whether the action [B] is the only possible one, of bool [B, A]."""
    return possible.gather(1, action.unsqueeze(1)).squeeze(1) & (possible.sum(1) == 1)
