"""Runs an attack on a batch of episodes: calls it for the running ones, projects its answer and counts its queries."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from cavbench.driving.access import Enforcer
from cavbench.driving.contracts import DrivingAttack
from cavbench.driving.dynamics import Dynamics
from cavbench.driving.features import Features
from cavbench.driving.forgery import Forgery
from cavbench.driving.forging import Forging, Used
from cavbench.driving.parts import Part, parts_of
from cavbench.driving.policy import State, rows_of
from cavbench.driving.threat import ObservationThreat
from cavbench.driving.traffic import ORDERED, View
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError


@dataclass(frozen=True)
class Shown:
    """The observation that the victim receives in a step, and its cost; the cost is 0 for episodes that have ended.

    Args:
        observation: [B, V, F], in the perturbation set.
        queries: int64 [B] evaluations of the victim.
        gradients, zero_gradients, nan_gradients: int64 [B] number of gradients computed, of those that were 0 everywhere, and
            of those that were NaN or infinite where the attack may change the value.
        excess: [B] L-inf distance from the attack's answer before projection to the set, on the normalised scale.
        milliseconds: the attack's wall time for the whole batch.
        used: what was used of the other sets of the threat model.
        orders: [B, N, 3] orders to cars of the traffic (`cavbench.driving.traffic.Orders`); None if the attack drives none.
    """

    observation: Tensor
    queries: Tensor
    gradients: Tensor
    zero_gradients: Tensor
    nan_gradients: Tensor
    excess: Tensor
    milliseconds: float = 0.0
    used: Used | None = None
    orders: Tensor | None = None


class Attacker:
    """Runs an attack step by step and keeps its state for each episode.

    Args:
        attack: the attack; None leaves the observations unchanged.
        subject: the victim; the attack reaches it only through an oracle.
        threat: the threat model, enforced here.
        features: features of the observation.
        seed: seed of the attack's random generator; of a `joint` attack, one seed for each episode: episodes with the same
            seed are one unit, and stand together.
        dynamics: the world's rules of motion; None if the world does not offer them.
        frames: frames of each episode that may be attacked (`ObservationThreat.frames`); None for all.
        period: seconds between decisions.
        steps: decisions of a full episode.
        actions: number of discrete actions.
    """

    def __init__(
        self,
        attack: DrivingAttack | None,
        subject: CountedPolicy,
        threat: ObservationThreat,
        features: Features,
        *,
        seed: int | Sequence[int],
        dynamics: Dynamics | None = None,
        frames: int | None = None,
        period: float = 1 / 15,
        steps: int = 450,
        actions: int = 5,
    ) -> None:
        self.attack, self.subject = attack, subject
        access = attack.access if attack else "oblivious"
        if attack is not None and attack.drives and not threat.traffic.cars:
            raise UserError(
                "the attack drives cars of the traffic, the threat model allows none: threat.traffic.cars=1"
            )
        seeds = [seed] if isinstance(seed, int) else list(seed)
        starts = [place for place, one in enumerate(seeds) if place == 0 or one != seeds[place - 1]]
        self.parts = [
            Part(slice(start, end), torch.Generator().manual_seed(seeds[start]))
            for start, end in pairwise([*starts, len(seeds)])
        ]
        self.enforcer = Enforcer(subject, threat, access, features, self.parts[0].generator, dynamics)
        self.seeds = [seeds[part.rows.start] for part in self.parts]
        self.frames, self.period, self.steps, self.actions = frames, period, steps, actions
        self.changed = torch.zeros(0, dtype=torch.int64)
        self.differs = torch.zeros(0, dtype=torch.bool)
        self.state: State = None
        self.begun = False

    def show(self, observation: Tensor, running: Tensor, policy_state: State, view: View | None = None) -> Shown:
        """Attack the running episodes and return the observations for the victim.

        A frame is attacked if any value shown differs from the truth. Once an episode has no frame left, the truth is shown and
        the attack is not asked.

        Args:
            observation: the true observation, [B, V, F].
            running: bool [B]; the other episodes are neither attacked nor counted.
            policy_state: the victim's state for the B episodes.
            view: the traffic, if the attack drives some of it.
        """
        counts = torch.zeros(4, observation.shape[0], dtype=torch.int64)
        excess = observation.new_zeros(observation.shape[0])
        if self.attack is None:
            return Shown(observation, counts[0], counts[1], counts[2], counts[3], excess)
        if not self.begun:
            self._begin(self.attack, observation, policy_state)
        forging = self.enforcer.forging
        assert forging is not None
        forging.see(observation)
        if self.frames is not None:
            running = running & (self.changed < self.frames)
        rows = running.nonzero().squeeze(-1)
        perturbed = observation.clone()
        orders = None if view is None else torch.zeros(*view.x.shape, ORDERED, dtype=torch.float64)
        start = time.perf_counter()
        if rows.numel():
            perturbed[rows], excess[rows] = self._answer(
                self.attack,
                observation[rows],
                rows,
                rows_of(policy_state, rows),
                None if view is None else view.of(rows),
            )
            if orders is not None and self.enforcer.orders is not None:
                orders[rows] = self.enforcer.orders
            counts[:, rows] = torch.stack(self.enforcer.counts)
        self.differs = (perturbed != observation).flatten(1).any(1)
        self.changed += self.differs
        forging.close(observation, rows)
        milliseconds = (time.perf_counter() - start) * 1000
        used = forging.used
        return Shown(perturbed, counts[0], counts[1], counts[2], counts[3], excess, milliseconds, used, orders)

    def execute(self, action: Tensor) -> Tensor:
        """What the cars execute of the victim's decisions [B] or [B, 2]. A command that is executed otherwise attacks a frame."""
        if self.attack is None or self.enforcer.forging is None:
            return action
        executed = self.enforcer.forging.execute(action, self.subject.action_type, self.actions)
        if executed is not action:
            self.changed += (executed != action).reshape(len(action), -1).any(1) & ~self.differs
        return executed

    def _begin(self, attack: DrivingAttack, observation: Tensor, policy_state: State) -> None:
        """Get the attack's initial state. It may not query the victim: no record would count these queries.

        The run keeps its own copy of the state and updates it in place.
        """
        self.changed = torch.zeros(len(observation), dtype=torch.int64)
        self._prepare(len(observation)).see(observation)
        rows = torch.arange(len(observation))
        oracle = self.enforcer.begin(observation, policy_state, parts=parts_of(self.parts, rows), rows=rows)
        with self.subject.turn():
            state = attack.initial(observation.clone(), oracle)
        self.enforcer.close()
        if bool(self.enforcer.counts[0].any()):
            raise UserError(f"{type(attack).__name__}.initial asked the victim: ask in step, where queries are counted")
        self.state, self.begun = None if state is None else state.detach().clone(), True
        # The first frame is seen in its step.
        self._prepare(len(observation))

    def _prepare(self, batch: int) -> Forging:
        sizes = [batch] if len(self.parts) == 1 else [part.rows.stop - part.rows.start for part in self.parts]
        parts = list(zip(sizes, self.seeds, strict=True))
        threat, features = self.enforcer.threat, self.enforcer.features
        self.enforcer.forging = Forging(threat, features, self.period, self.steps, parts)
        return self.enforcer.forging

    def _answer(
        self, attack: DrivingAttack, observation: Tensor, rows: Tensor, policy_state: State, view: View | None
    ) -> tuple[Tensor, Tensor]:
        """The attack's answer for the running episodes, projected, and its distance to the perturbation set."""
        oracle = self.enforcer.begin(observation, policy_state, parts=parts_of(self.parts, rows), rows=rows, view=view)
        name = type(attack).__name__
        with self.subject.turn():
            answer, state = attack.step(observation, oracle, rows_of(self.state, rows))
        self.enforcer.close()
        if (self.state is None) != (state is None):
            raise UserError(f"{name}.step and {name}.initial must both return a state or both return None")
        if self.state is not None and state is not None:
            self.state[rows] = state.detach()
        given = answer if isinstance(answer, Forgery) else _values(answer, observation, name)
        shown, excess = self.enforcer.project(given, name)
        if not bool(excess.isfinite().all()):
            raise UserError(f"{name}.perturb returned numbers that are NaN or infinite")
        return shown, excess


def _values(answer: Tensor, observation: Tensor, name: str) -> Tensor:
    """The perturbed values of an attack's answer."""
    # A subclass of Tensor could change what its methods answer.
    if type(answer) is not Tensor or answer.shape != observation.shape:
        got = f"shape {tuple(answer.shape)}" if type(answer) is Tensor else f"a {type(answer).__name__}"
        raise UserError(f"{name}.perturb returned {got}, not a torch.Tensor of shape {tuple(observation.shape)}")
    if answer.is_complex():
        raise UserError(f"{name}.perturb returned complex numbers")
    return answer.detach().to(observation.dtype)
