"""A surrogate that is trained from the victim's decisions alone."""

from __future__ import annotations

import copy
import time
from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from cavbench import zoo
from cavbench.attacks.driving.surrogates import SurrogateAttack, Surrogates
from cavbench.core.contracts import Access, Progress, Trained
from cavbench.core.ranges import Count, Natural, Positive, Width
from cavbench.driving import DrivingDefense, DrivingFacts, DrivingVictim, DrivingWorld, Policy, State
from cavbench.driving.policy import rows_of
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.driving.victims.practice import roads
from cavbench.scenarios import SeedBlock

COPIES = 8
"""Episodes on each training road in which frames are gathered."""
BATCH = 64
LEARNING_RATE = 2e-3
HELD_OUT = 0.2
"""Share of the frames on which the network is compared with the victim, and never trained."""


class Copy(Surrogates):
    """The substitute: a network of the victim's kind of actions.

    Args:
        features: F, size of an observation row.
        actions: number of discrete actions; 0 for continuous ones.
        hidden: width of the two hidden layers.
        steering: largest |steering| of a continuous victim.
    """

    weights_sha256 = ""

    def __init__(self, features: int, actions: int, hidden: int, steering: float) -> None:
        super().__init__([QPolicy(features, actions, hidden) if actions else ActorPolicy(features, hidden, steering)])
        self.shape = {"features": features, "actions": actions, "hidden": hidden, "steering": steering}

    @property
    def policy(self) -> Policy:
        """The network."""
        found = self.policies[0]
        assert isinstance(found, Policy)
        return found


@dataclass(frozen=True, kw_only=True)
class Substitute(SurrogateAttack):
    """PGD on a network that is trained from the victim's decisions alone (Papernot et al. 2017, arXiv 1602.02697).

    The attacker watches the defended victim drive, and keeps some frames. It asks for the victim's decision on each, trains a
    network to decide likewise, moves every frame a little in the direction in which that network's decision changes most, asks
    again, and so on (Jacobian-based augmentation). `bench train` does this once for each defended victim and training seed. In a
    run it asks nothing: it descends on the network.

    Distance: the perturbation set of the threat model.

    Args:
        frames: frames to begin with, at least 1 (default 2000). Each round doubles them.
        rounds: rounds of augmentation, at least 0 (default 3).
        reach: length of a move on the normalised scale, above 0 (default 0.05).
        epochs: passes over all frames after each round, at least 1 (default 10).
        hidden: width of the hidden layers (default 128).
        steps: gradient steps per restart, at least 1 (default 10).
        restarts: independent random starts, at least 1 (default 2).
        step_size: length of a step as a share of the radius, in (0, 2] (default 0.5).
        momentum: decay of the accumulated gradient, in [0, 1]; 1 sums all gradients (default 1).
        objective: the loss, as in `pgd` (default collision), with the log-probabilities of the decisions as Q-values. For
            continuous decisions `collision` and `expected` are `target`: there is no critic.
        temperature: temperature of an expectation, as a share of the spread of the scores, above 0 (default 0.5).
        target_action: discrete target, at least 0 (default 3, FASTER).
        target_acceleration: continuous target, in [-1, 1] (default 1).
        target_steering: continuous target, in [-1, 1] (default 0.5).
        braking_action: index of the braking action for `collision`, at least 0 (default 4, SLOWER).
        trained_in: non-default parameters of the training world; set by `bench train`.

    Shapes: observation [B, V, F] in, the same out. Queries: none in a run; in the training frames * 2^rounds.
    """

    access: ClassVar[Access] = "decisions"
    joint: ClassVar[bool] = True
    learns: ClassVar[bool] = True
    judges: ClassVar[bool] = False
    at_run_time: ClassVar[tuple[str, ...]] = (
        "steps",
        "restarts",
        "step_size",
        "momentum",
        "objective",
        "temperature",
        "target_action",
        "target_acceleration",
        "target_steering",
        "braking_action",
    )

    frames: Count = 2000
    rounds: Natural = 3
    reach: Positive = 0.05
    epochs: Count = 10
    hidden: Width = 128
    trained_in: str = ""

    def zoo_name(self, victim: DrivingVictim) -> str:
        return "substitute"

    def train(
        self, victim: DrivingVictim, defense: DrivingDefense, world: DrivingWorld, *, seed: int, progress: Progress
    ) -> Trained[Copy]:
        torch.manual_seed(seed)
        started = time.process_time()
        policy = defense.load(victim, seed, world.facts)
        frames, states = _watched(policy, victim, world, round(self.frames / (1 - HELD_OUT)), seed)
        every = _labels(policy, frames, states)
        count = max(1, round(len(frames) * (1 - HELD_OUT)))
        seen, asked = frames[:count], every[:count]
        actions = len(world.facts.actions) if victim.action_type == "discrete" else 0
        limit = float(asked[:, 1].abs().max().clamp(min=0.01)) if not actions else 1.0
        network = Copy(seen.shape[-1], actions, self.hidden, limit)
        rows = torch.arange(len(seen))
        for number in range(self.rounds + 1):
            if number:
                moved = _moved(network.policy, seen, asked, self.reach)
                more = _labels(policy, moved, rows_of(states, rows))
                seen, asked, rows = torch.cat((seen, moved)), torch.cat((asked, more)), torch.cat((rows, rows))
            _fit(network.policy, seen, asked, self.epochs)
            agreed = _agreement(network.policy, frames[count:], every[count:])
            progress((number + 1) / (self.rounds + 1), f"{len(seen)} queries, decides likewise on {100 * agreed:.0f} %")
        card = {"against": policy.weights_sha256, "queries": len(seen), "agreement": round(agreed, 4)}
        found = copy.deepcopy(network).requires_grad_(False).eval()
        return Trained(found, {**card, "cpu_seconds": round(time.process_time() - started, 1)})

    def load(self, victim: DrivingVictim, defense: DrivingDefense, seed: int, facts: DrivingFacts) -> Copy:
        against = defense.load(victim, seed, facts).weights_sha256
        return zoo.load(zoo.Recipe.of(victim, defense, self), seed, Copy, against=against)


@torch.no_grad()
def _watched(policy: Policy, victim: DrivingVictim, world: DrivingWorld, count: int, seed: int) -> tuple[Tensor, State]:
    """Random frames [N, V, F] of the victim's driving on the training roads, and its states in them."""
    env = world.make(roads(world, COPIES), action_type=victim.action_type, driver=victim.driver)
    batch = int(env.batch_size[0])
    seeds = SeedBlock.TRAIN * (seed + 1) + torch.arange(batch)
    td = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
    state, frames, states = policy.initial(seeds), [], []
    steps = world.facts.max_steps
    for _ in range(steps):
        observation, running = td["observation"], ~td["done"].squeeze(-1)
        kept = running & (torch.rand(batch) < 2 * count / (steps * batch))
        frames.append(observation[kept].clone())
        states.append(None if state is None else state[kept].clone())
        action = policy.decide(observation, state)
        td = env.step(td.set("action", action))["next"]
        state = policy.advance(observation, action, state)
        if bool(td["done"].all()):
            break
    env.close()
    every = torch.cat(frames)
    chosen = torch.randperm(len(every))[:count]
    if state is None:
        return every[chosen], None
    return every[chosen], torch.cat([one for one in states if one is not None])[chosen]


@torch.no_grad()
def _labels(policy: Policy, observation: Tensor, state: State) -> Tensor:
    """The victim's decisions, int64 [N] or float [N, 2]: all that the attacker asks."""
    return policy.decide(observation, state)


def _moved(policy: Policy, seen: Tensor, asked: Tensor, reach: float) -> Tensor:
    """The frames [N, V, F], each moved along the sign of the Jacobian of the substitute in the victim's decision."""
    points = seen.clone().requires_grad_(True)
    with torch.enable_grad():
        scores = policy.scores(points)
        chosen = scores.gather(-1, asked[:, None]) if asked.ndim == 1 else scores
        (slope,) = torch.autograd.grad(chosen.sum(), points)
    # Rows without a car stay empty, and no car appears.
    slope = slope * (seen[..., :1] > 0)
    slope[..., 0] = 0
    return (seen + reach * slope.sign()).clamp(-1, 1)


def _fit(policy: Policy, seen: Tensor, asked: Tensor, epochs: int) -> None:
    """Train the substitute on all frames."""
    adam = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE)
    policy.train()
    with torch.enable_grad():
        for _ in range(epochs):
            for rows in torch.randperm(len(seen)).split(BATCH):
                found = policy.scores(seen[rows])
                if asked.ndim == 1:
                    loss = nn.functional.cross_entropy(found, asked[rows])
                else:
                    loss = nn.functional.mse_loss(found, asked[rows])
                adam.zero_grad()
                loss.backward()
                adam.step()
    policy.eval()


@torch.no_grad()
def _agreement(policy: Policy, seen: Tensor, asked: Tensor) -> float:
    """The share [0, 1] of the frames in which the substitute decides as the victim does; continuous decisions within 0.1."""
    own = policy.decide(seen)
    same = own == asked if asked.ndim == 1 else ((own - asked).abs() < 0.1).all(-1)
    return float(same.float().mean())
