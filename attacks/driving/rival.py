"""Drives cars of the traffic by a policy that was trained against this victim."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor

from cavbench import zoo
from cavbench.attacks.driving.rival_seat import ACTIONS, FEATURES, empty, orders, seated, seen, told
from cavbench.attacks.driving.rival_training import Duel, Lessons, train
from cavbench.core.contracts import Access, Progress, Trained
from cavbench.driving import (
    DrivingAttack,
    DrivingDefense,
    DrivingFacts,
    DrivingVictim,
    DrivingWorld,
    Oracle,
    Policy,
    State,
)
from cavbench.driving.sets import Traffic
from cavbench.driving.victims.networks import QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.errors import UserError
from cavbench.scenarios import SeedBlock


@dataclass(frozen=True, kw_only=True)
class Rival(Lessons, DrivingAttack):
    """Drives cars of the traffic by a policy that was trained against this victim with PPO (Schulman et al. 2017).

    `bench train` drives many episodes at once, in which the defended victim decides at every frame. Every driven car has the same
    policy, and sees itself, the victim and the cars near it as they are. It chooses among four accelerations, and whether to
    go on as ordered, to the lane beside it on the victim's side, or to the one on the other side. Its reward is minus the
    victim's progress, and more for the victim's crash. In a run it shows the truth, makes the most likely choice, and asks
    nothing.

    Distance: the set `traffic` of the threat model; `threat.traffic.cars` says how many cars it drives. It is trained within the
    default bounds.

    Args:
        cars: number of cars that it drives in the training, at least 1 (default 1).
        repeat: frames for which a choice is held, at least 1 (default 5).
        decisions: decisions in the training, of all episodes together, at least 1 (default 400000).
        hidden: width of the hidden layers (default 64).
        crash: what a crash is worth to it, in frames of full progress, in [0, 1e6] (default 200).
        gamma: discount per decision, in [0, 1) (default 0.97).
        trace: lambda of the advantages, in [0, 1] (default 0.9).
        copies: parallel episodes on each road of the grid, at least 1 (default 40).
        rollout: decisions of each episode between two rounds of updates, at least 1 (default 32).
        epochs: how often each decision is learned from, at least 1 (default 4).
        batch: decisions per update, at least 1 (default 1024).
        learning_rate: rate of Adam at the beginning, in (0, 1]; it falls linearly (default 0.001).
        clip: largest change of a choice's probability ratio that is rewarded, in (0, 1) (default 0.2).
        entropy: weight of the entropy bonus, at least 0 (default 0.01).
        trained_in: non-default parameters of the training world; set by `bench train`.

    Shapes: observation [B, V, F] in, the same out. Queries: none in a run.
    """

    access: ClassVar[Access] = "decisions"
    drives: ClassVar[bool] = True
    joint: ClassVar[bool] = True
    learns: ClassVar[bool] = True

    trained_in: str = ""

    @property
    def forges(self) -> tuple[str, ...]:
        return (f"traffic.cars={self.cars}",)

    def zoo_name(self, victim: DrivingVictim) -> str:
        return "rival"

    def initial(self, observation: Tensor, oracle: Oracle) -> State:
        batch = len(observation)
        state = empty(batch, oracle.threat.traffic.cars)
        state["age"] = torch.zeros(batch, dtype=torch.int64)
        return state

    def step(self, observation: Tensor, oracle: Oracle, state: State) -> tuple[Tensor, State]:
        assert isinstance(state, TensorDict)
        assert isinstance(self.adversary, Policy)
        if not len(observation):
            return observation, state
        view, bounds = oracle.traffic, oracle.threat.traffic
        # All episodes of a step have the same age.
        if int(state["age"][0]) % self.repeat == 0:
            seats = seated(view, state)
            state = told(view, seats, self.adversary.decide(seen(view, seats, bounds)), bounds)
        oracle.order(orders(view, state))
        return observation, state.set("age", state["age"] + 1)

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[QPolicy]:
        torch.manual_seed(seed)
        started = time.process_time()
        policy = defense.load(victim, seed, world.facts)
        env = world.make(
            roads(world, self.copies),
            action_type=victim.action_type,
            driver=victim.driver,
            traffic=Traffic(cars=self.cars),
        )
        env.set_seed(SeedBlock.TRAIN * (seed + 1))
        network, found = train(Duel(env, policy, self), progress)
        env.close()
        card = {"against": policy.weights_sha256, **found, "cpu_seconds": round(time.process_time() - started, 1)}
        return Trained(network.requires_grad_(False).eval(), card)

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> QPolicy:
        against = defense.load(victim, seed, facts).weights_sha256
        network = zoo.load(zoo.Recipe.of(victim, defense, self), seed, QPolicy, against=against)
        sizes = {name: network.shape[name] for name in ("features", "actions")}
        if sizes != {"features": FEATURES, "actions": ACTIONS}:
            raise UserError(
                f"the zoo's rival of training seed {seed} is no driver of the traffic: its network has {sizes}"
            )
        return network
