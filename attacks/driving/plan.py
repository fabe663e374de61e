"""A planning attack: which action that the victim can be led to take ends worst, by the world's own rules of motion?"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Annotated, ClassVar

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.attacks.driving.candidates import best_of, random_starts
from cavbench.attacks.driving.objectives import TIE_BREAK, distance, expected, margin, spared, taken, temperature
from cavbench.attacks.driving.pgd import descend
from cavbench.core.contracts import Access
from cavbench.core.ranges import Count, Natural, Positive, Share
from cavbench.driving import DrivingAttack, Dynamics, Forecast, Oracle, State

CORNERS = ((1.0, -1.0), (1.0, 1.0), (1.0, 0.0), (-1.0, 0.0), (-1.0, 1.0), (-1.0, -1.0))
"""The [acceleration, steering] towards which a continuous victim is pulled; the first one where no forecast fails."""
IMMINENT = 0.4
"""A forecast departure from the road counts within this time in s."""
HASTE = 0.1
"""Weight of slowness in the worth of a plan: between plans that do not fail, the faster one is the more dangerous."""


@dataclass(frozen=True, kw_only=True)
class Plan(DrivingAttack):
    """Looks ahead with the world's rules of motion, and leads the victim into the action that ends worst.

    White box with access `dynamics`: it knows how the world moves, never the hidden state of an episode. It computes a belief
    about the traffic from the true observations alone (`cavbench.driving.Dynamics`), and rolls plans forward from it.

    Discrete victims: the worth of an action is the mean time to a failure (crash or road departure) over plans that begin with it
    and continue with each of the actions. PGD on the victim then searches the perturbation set for the observation whose greedy
    action has the least worth: some of its starts pull towards the worst actions (targeted margin, Carlini and Wagner 2017),
    the others lower the expected worth. Where no plan fails, it is `pgd` with the objective `collision`.
    Continuous victims: PGD pulls the action towards six corners of its range; each action that is reached is held in a forecast,
    and the one that crashes soonest is shown, or leaves the road at once; if there is none, full throttle to the left.

    Compare Qu et al. 2021, "Attacking Deep Reinforcement Learning with Decoupled Adversarial Policy", whose attacker learns what
    to aim for. Distance: L-inf in shares of the threat model's radius, for each feature.

    Args:
        horizon: length of a plan in seconds, above 0 (default 3).
        replan: frames for which a forecast is used, at least 1; discrete victims only (default 2).
        steps: gradient steps per start, at least 1 (default 10).
        step_size: length of a step as a share of the radius, in (0, 2] (default 0.5).
        restarts: starts for a discrete victim, at least 1 (default 4); a continuous one has a start for each corner.
        targeted: how many of the starts pull towards the worst actions, one start for each, the worst first (default 3).
        temperature: temperature of the expected worth, as a share of the spread of the clean Q-values, above 0 (default 0.5).
        braking_action: index of the braking action that `collision` spares, at least 0 (default 4, SLOWER).
        gap: attack only where the worth of the victim's own action is above that of the action it is led into by at least this,
            in [0, 1]; 0 attacks every frame. A worth of 1 is no failure within the horizon. It makes the most of a threat model
            with `share` below 1, as the strategically-timed attack of Lin et al. 2017 does with the victim's preferences.
        draw: number of the random draw: another number is the same attack with other random starts.

    Shapes: observation [B, V, F] in, the same out. Queries per step: 1 + restarts * (steps + 1), or 1 + 6 * (steps + 2) for
    continuous actions. With a smaller query budget it uses fewer starts, then fewer steps.

    Raises:
        UserError: if the world does not offer its dynamics.
    """

    access: ClassVar[Access] = "dynamics"
    joint: ClassVar[bool] = True

    horizon: Positive = 3.0
    replan: Count = 2
    steps: Count = 10
    step_size: Annotated[float, Interval(gt=0, le=2)] = 0.5
    restarts: Count = 4
    targeted: Natural = 3
    temperature: Positive = 0.5
    braking_action: Natural = 4
    gap: Share = 0.0
    draw: Natural = 0

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        state = oracle.dynamics.unknown()
        state["age"] = torch.zeros(len(state), dtype=torch.int64)
        if oracle.action_type == "discrete":
            state["worth"] = torch.ones(len(state), oracle.dynamics.actions)
            state["danger"] = torch.zeros(len(state), dtype=torch.bool)
        return state

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert state is not None
        if not len(observation):
            return observation, state
        belief = oracle.dynamics.believe(observation, state)
        belief["age"] = state["age"] + 1
        if oracle.action_type == "discrete":
            belief["worth"], belief["danger"] = state["worth"].clone(), state["danger"].clone()
            due = (state["age"] % self.replan == 0).nonzero().squeeze(-1)
            if len(due):
                belief["worth"][due], belief["danger"][due] = self._worths(belief[due], oracle.dynamics)
        if int(oracle.remaining.min()) < 4:
            return observation, belief
        lead = self._lead_actions if oracle.action_type == "discrete" else self._lead_controls
        return lead(observation, oracle, belief), belief

    def _frames(self, dynamics: Dynamics) -> int:
        return max(1, round(self.horizon / dynamics.period))

    def _worths(self, belief: TensorDictBase, dynamics: Dynamics) -> tuple[Tensor, Tensor]:
        """The worth of each action [B, A], the mean over the plans that begin with it, and whether any plan fails, bool [B]."""
        frames = self._frames(dynamics)
        found = dynamics.roll(belief, plans(dynamics.actions, frames))
        worth = worth_of(found, frames).unflatten(1, (dynamics.actions, -1)).mean(-1)
        return worth, (found.failed < frames).any(-1)

    def _lead_actions(self, observation: Tensor, oracle: Oracle, belief: TensorDictBase) -> Tensor:
        """The observation whose greedy action has the least worth."""
        restarts, steps = self._affordable(self.restarts, oracle, asked=1)
        clean = oracle.scores(observation)
        danger = belief["danger"]
        worth = torch.where(danger[:, None], belief["worth"], self._collision(clean))
        targets = worth.argsort(-1)[:, : min(self.targeted, restarts)].T
        tau = temperature(clean, self.temperature)

        def loss(scores: Tensor) -> Tensor:
            pulled = [-margin(one, target) for one, target in zip(scores, targets, strict=False)]
            others = expected(scores[len(pulled) :], worth, tau)
            return torch.cat((torch.stack(pulled), others)) if pulled else others

        def key(scores: Tensor, _: Tensor) -> Tensor:
            return taken(scores, worth) + TIE_BREAK * expected(scores, worth, tau)

        known = key(clean, clean)
        start = random_starts(observation, restarts, oracle)
        best, lowest = descend(start, loss, key, oracle, steps=steps, step_size=self.step_size)
        if self.gap > 0:
            # The keys are worths up to the tie-break.
            lowest = lowest.where(danger & (known - lowest >= self.gap), torch.inf)
        return best_of(best, lowest, observation, known)

    def _collision(self, clean: Tensor) -> Tensor:
        """[B, A] the worth of the actions by `pgd`'s objective `collision`, from the clean Q-values, scaled to [0, 1]."""
        if self.braking_action >= clean.shape[-1]:
            raise ValueError(
                f"braking_action must be below the victim's {clean.shape[-1]} actions, got {self.braking_action}"
            )
        worth = spared(clean, self.braking_action)
        worth = worth - worth.amin(-1, keepdim=True)
        return worth / worth.amax(-1, keepdim=True).clamp(min=torch.finfo(worth.dtype).tiny)

    def _lead_controls(self, observation: Tensor, oracle: Oracle, belief: TensorDictBase) -> Tensor:
        """The observation whose action, held, has the least worth."""
        starts, steps = self._affordable(len(CORNERS), oracle, asked=2)
        clean = oracle.scores(observation)
        corners = torch.tensor(CORNERS[:starts]).to(observation)[:, None]

        def loss(scores: Tensor) -> Tensor:
            return distance(scores, corners)

        start = random_starts(observation, starts, oracle)
        best, _ = descend(start, loss, lambda _, value: value, oracle, steps=steps, step_size=self.step_size)
        held = torch.cat((clean[None], oracle.scores(best)))
        frames = self._frames(oracle.dynamics)
        found = oracle.dynamics.roll(belief, held.transpose(0, 1)[:, :, None].expand(-1, -1, frames, -1))
        # A departure that is not imminent can be steered away from; a crash at speed cannot be undone.
        counts = found.crashed | (found.failed <= IMMINENT / oracle.dynamics.period)
        lasting = torch.where(counts, found.failed, frames).T / frames
        known, lowest = lasting[0], lasting[1:].clone()
        # Where nothing else counts, the first corner.
        lowest[0] -= TIE_BREAK
        if self.gap > 0:
            lowest = lowest.where(known - lowest >= self.gap, torch.inf)
        return best_of(best, lowest, observation, known)

    def _affordable(self, starts: int, oracle: Oracle, *, asked: int) -> tuple[int, int]:
        """Numbers of starts and steps within the query budget, with `asked` queries of each start besides its gradients."""
        left = int(oracle.remaining.min()) - 1
        starts = max(1, min(starts, left // (1 + asked)))
        return starts, min(self.steps, left // starts - asked)


def worth_of(forecast: Forecast, frames: int) -> Tensor:
    """[B, P] the worth of plans in [0, 1]: the time to a failure and, with a small weight, how slow the car is."""
    return (forecast.failed + HASTE * (frames - forecast.progress)) / ((1 + HASTE) * frames)


@cache
def plans(actions: int, frames: int) -> Tensor:
    """[A * A, T] every action, followed by every action until the end."""
    first = torch.arange(actions).repeat_interleave(actions)
    then = torch.arange(actions).repeat(actions)
    return torch.cat((first[:, None], then[:, None].expand(-1, frames - 1)), 1)
