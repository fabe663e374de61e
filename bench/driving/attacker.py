"""An attack at work on a batch of episodes: asked about the running ones, its answer projected, its queries counted."""

from __future__ import annotations

import time
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.driving.contracts import DrivingAttack
from bench.driving.features import Features
from bench.driving.oracle import Oracle
from bench.driving.policy import Policy, State, rows_of
from bench.driving.threat import ObservationThreat
from bench.errors import UserError


@dataclass(frozen=True)
class Shown:
    """What the victim is shown in a step, and what the attack spent on it; 0 for episodes that have ended.

    Args:
        observation: [B, V, F], in the perturbation set.
        queries: int64 [B] evaluations of the victim.
        gradients, zero_gradients: int64 [B] gradients taken, and those of them that were 0 everywhere.
        excess: [B] how far outside the set the attack's own answer was, L-inf on the normalised scale.
        milliseconds: the attack's wall time, for the whole batch.
    """

    observation: Tensor
    queries: Tensor
    gradients: Tensor
    zero_gradients: Tensor
    excess: Tensor
    milliseconds: float = 0.0


class Attacker:
    """Runs an attack step by step, and keeps what it remembers of each episode.

    Args:
        attack: the attack; None shows the victim the world as it is.
        policy: the victim, reached by the attack through an oracle only.
        threat: the threat model, enforced here.
        features: of the observation.
        seed: of the attack's random generator.
    """

    def __init__(
        self, attack: DrivingAttack | None, policy: Policy, threat: ObservationThreat, features: Features, *, seed: int
    ) -> None:
        self.attack = attack
        access = attack.access if attack else "oblivious"
        self.oracle = Oracle(policy, threat, access, features, torch.Generator().manual_seed(seed))
        self.state: State = None
        self.begun = False

    def show(self, observation: Tensor, running: Tensor, policy_state: State) -> Shown:
        """What the victim is shown.

        Args:
            observation: true, [B, V, F].
            running: bool [B]; the others are neither attacked nor counted.
            policy_state: what the victim remembers of the B episodes.
        """
        counts = torch.zeros(3, observation.shape[0], dtype=torch.int64)
        excess = observation.new_zeros(observation.shape[0])
        if self.attack is None:
            return Shown(observation, counts[0], counts[1], counts[2], excess)
        if not self.begun:
            self._begin(observation, policy_state)
        rows = running.nonzero().squeeze(-1)
        perturbed = observation.clone()
        start = time.perf_counter()
        if rows.numel():
            self.oracle.begin_step(observation[rows], rows_of(policy_state, rows))
            perturbed[rows], excess[rows] = self._answer(observation[rows], rows)
            spent = (self.oracle.spent, self.oracle.gradients, self.oracle.zero_gradients)
            counts[:, rows] = torch.stack(spent)
        milliseconds = (time.perf_counter() - start) * 1000
        return Shown(perturbed, counts[0], counts[1], counts[2], excess, milliseconds)

    def _begin(self, observation: Tensor, policy_state: State) -> None:
        """Ask the attack what it remembers before the first step. It may ask nothing: such queries would be in no record.

        The state is the run's own copy, which is written to in place.
        """
        assert self.attack is not None
        self.oracle.begin_step(observation, policy_state)
        state = self.attack.initial(observation, self.oracle)
        if bool(self.oracle.spent.any()):
            raise UserError(
                f"{type(self.attack).__name__}.initial asked the victim: ask in step, where queries are counted"
            )
        self.state, self.begun = None if state is None else state.detach().clone(), True

    def _answer(self, observation: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
        """The attack's answer for the running episodes, projected, and how far outside the set it was."""
        assert self.attack is not None
        answer, state = self.attack.step(observation, self.oracle, rows_of(self.state, rows))
        name = type(self.attack).__name__
        if not isinstance(answer, Tensor) or answer.shape != observation.shape:
            found = f"shape {tuple(answer.shape)}" if isinstance(answer, Tensor) else f"a {type(answer).__name__}"
            raise UserError(f"{name}.perturb returned {found}, not {tuple(observation.shape)}")
        if (self.state is None) != (state is None):
            raise UserError(f"{name}.step and {name}.initial must both return a state, or both None")
        if self.state is not None and state is not None:
            self.state[rows] = state.detach()
        answer = answer.detach()
        shown = self.oracle.project(answer)
        excess = (answer - shown).abs().flatten(1).amax(1)
        if not bool(excess.isfinite().all()):
            raise UserError(f"{name}.perturb returned numbers that are NaN or infinite")
        return shown, excess
