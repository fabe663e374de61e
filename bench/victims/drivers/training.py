"""How a driver learns, whatever its algorithm: the roads it practises on, its reward, and the choice of the checkpoint."""

from __future__ import annotations

import copy
import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, ExplorationType, MultiStepTransform, set_exploration_type

from bench.driving import DrivingFacts, DrivingVictim, DrivingWorld, Policy
from bench.driving.contracts import AttackInLoop
from bench.plugins import registry
from bench.plugins.contracts import Progress, Trained
from bench.scenarios import Cell, SeedBlock
from bench.victims import zoo

CHUNK = 8
"""Decisions taken between two rounds of gradient updates."""
WARM_UP = 40
"""Decisions taken before the first update."""


def roads(copies: int) -> list[Cell]:
    """The roads of the standard grid in clear weather, `copies` of each: one batch practises on all of them."""
    grid = registry.grid("standard-v1")
    pairs = itertools.product(grid.values["lanes"], grid.values["density"])
    return [Cell(lanes=lanes, density=density, weather="clear") for lanes, density in pairs for _ in range(copies)]


@dataclass(frozen=True)
class Phase:
    """A stretch of the training in which a decision is held for `repeat` frames.

    Args:
        repeat: frames a decision is held.
        decisions: taken on every road in this phase.
        gamma: discount a decision.
        n_step: decisions in a return.
        exploration: final exploration of the recipe is multiplied by this: random actions a second stay as rare.
        gap: of advantage learning, in [0, 1): gaps between the values of actions grow by 1 / (1 - gap).
    """

    repeat: int
    decisions: int
    gamma: float
    n_step: int
    exploration: float = 1.0
    gap: float = 0.0


class Learner(ABC):
    """One algorithm: networks, loss, optimiser.

    Args:
        attack: what it learns under, None for nothing.
    """

    policy: Policy
    """The network that is trained; the attack in the loop aims at it."""
    explore: nn.Module
    """Takes a tensordict with `observation` [B, V, F], writes an exploring `action`."""

    def __init__(self, attack: AttackInLoop | None) -> None:
        self.start = attack.start if attack else None
        self.consistency = attack.consistency if attack else 0.0

    def inconsistency(self, sample: TensorDictBase) -> Tensor | float:
        """How far what is decided on what is shown is from what `start` decides on the truth, weighted; 0 without a start.

        The regulariser of TRADES (Zhang et al. 2019, Eq. 5), with a teacher that stays as it is.
        """
        if self.start is None or self.consistency == 0:
            return 0.0
        with torch.no_grad():
            wanted = self.start.scores(sample["truth"])
        return self.consistency * self.divergence(sample["observation"], wanted)

    @abstractmethod
    def divergence(self, observation: Tensor, wanted: Tensor) -> Tensor:
        """Mean distance of what the trained network decides on [N, V, F] from the scores `wanted` [N, A] or [N, 2]."""

    @abstractmethod
    def enter(self, phase: Phase) -> None:
        """Take on the phase's discount and exploration."""

    @abstractmethod
    def update(self, sample: TensorDictBase, learning_rate: float) -> None:
        """One gradient step on a batch of transitions."""

    @abstractmethod
    def anneal(self) -> None:
        """Explore less: a chunk of decisions more has been taken."""

    @abstractmethod
    def averaged(self) -> Policy:
        """The policy with the Polyak-averaged weights of the target networks."""


@dataclass(frozen=True, kw_only=True)
class LearningDriver(DrivingVictim):
    """What all trained drivers share.

    At 15 Hz single frames explore nothing, so a first phase holds each decision for `repeat` frames; but a lane change sent twice
    in a row crosses two lanes, so a second phase decides at every frame, as the scored policy does.

    Args:
        decisions: of the whole training, on every road at once.
        fine: share of them taken frame by frame, in the second phase.
        repeat: frames a decision is held in the first phase.
        hidden: width of the hidden layers behind the encoder.
        gamma: discount a decision of the first phase; a frame's share of it in the second.
        n_step: decisions in a return of the first phase; as many frames in the second.
        crash_penalty: reward of a crash or of leaving the road, in frames of perfect driving.
        learning_rate: of Adam; falls linearly to a twentieth over the second half; half of it where a trained policy goes on.
        batch: transitions an update.
        updates: gradient updates a decision of the whole batch of roads.
        copies: of each of the six roads, driven at once.
        memory: transitions in the replay buffer.
        tau: rate of the target networks' soft update.
        checkpoints: candidates for the final weights, spread over the last `fine` of the training; half as many under attack.
    """

    learns: ClassVar[bool] = True
    policy_type: ClassVar[type[Policy]]

    decisions: int = 36_000
    fine: float = 0.45
    repeat: int = 5
    hidden: int = 128
    gamma: float = 0.97
    n_step: int = 3
    crash_penalty: float = 40.0
    learning_rate: float = 5e-4
    batch: int = 512
    updates: int = 1
    copies: int = 24
    memory: int = 600_000
    tau: float = 0.005
    checkpoints: int = 8

    def __post_init__(self) -> None:
        for name in ("decisions", "hidden", "n_step", "repeat", "batch", "updates", "copies", "memory", "checkpoints"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        for name in ("gamma", "tau", "fine"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} must be between 0 and 1, got {getattr(self, name)}")

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        return zoo.load(self.zoo_name(), seed, self.policy_type, made_by={"victim": asdict(self)})

    def phases(self, attack: AttackInLoop | None) -> list[Phase]:
        """Held decisions first, then frame by frame; a policy that drives already goes on frame by frame. Whole chunks."""
        started = attack is not None and attack.start is not None
        fine = attack.decisions if attack and started else round(self.decisions * self.fine)
        phases = [
            Phase(self.repeat, self.decisions - fine, self.gamma, self.n_step),
            # One frame of another action is worth a fifth of five: the gap keeps the size it had. Returns are short under
            # attack, because they take what was done for what the policy would do.
            Phase(
                1,
                fine,
                self.gamma ** (1 / self.repeat),
                self.repeat if attack else self.n_step * self.repeat,
                exploration=1 / self.repeat,
                gap=1 - 1 / self.repeat,
            ),
        ]
        whole = [replace(phase, decisions=max(1, round(phase.decisions / CHUNK)) * CHUNK) for phase in phases]
        return whole[1:] if started else whole

    @abstractmethod
    def learner(self, env: EnvBase, attack: AttackInLoop | None) -> Learner:
        """The algorithm on `env`, from fresh weights or from `attack.start`."""

    def train(
        self, world: DrivingWorld, *, seed: int, attack: AttackInLoop | None = None, progress: Progress
    ) -> Trained[Policy]:
        """Train on all roads of the standard grid at once, and keep the best checkpoint."""
        torch.manual_seed(seed)
        started = time.process_time()
        generator = torch.Generator().manual_seed(seed)
        best, learner, done, attacked = Best(world, attack, episodes=60), None, 0, 0
        phases = self.phases(attack)
        total = sum(phase.decisions for phase in phases)
        for number, phase in enumerate(phases):
            env = world.make(roads(self.copies), action_type=self.action_type, action_repeat=phase.repeat)
            env.set_seed(SeedBlock.TRAIN * (seed + 1) + number * SeedBlock.REPORT)
            learner = learner or self.learner(env, attack)
            learner.enter(phase)
            practice = Practice(env, learner, self, phase, attack, generator)
            for taken in range(CHUNK, phase.decisions + 1, CHUNK):
                share = done / total
                practice.drive(CHUNK, share)
                done += CHUNK
                learner.anneal()
                if taken > WARM_UP:
                    rate = self.learning_rate * max(0.05, min(1.0 if len(phases) > 1 else 0.5, 2 * (1 - share)))
                    for _ in range(CHUNK * self.updates):
                        learner.update(practice.sample(share), rate)
                if phase.repeat == 1 and self._due(done / total, len(best.history), bool(attack)):
                    best.offer(learner.averaged(), done / total)
                progress(done / total, f"safe_progress {best.score:.2f}" if best.history else "")
            attacked += practice.attacked
        assert learner is not None
        card = {"victim": asdict(self), "seed": seed, "attacked_decisions": attacked, **best.card()}
        card["cpu_seconds"] = round(time.process_time() - started, 1)
        return Trained(best.restore(learner.averaged()), card)

    def _due(self, share: float, offered: int, attacked: bool) -> bool:
        """Whether another checkpoint is due; they are spread over the last `fine` of the training."""
        checkpoints = math.ceil(self.checkpoints / 2) if attacked else self.checkpoints
        return share >= 1 - self.fine * (1 - (offered + 1) / checkpoints) - 1e-9


class Practice:
    """Drives the roads, under attack where a defence asks for it, and remembers n-step transitions.

    The reward is Eq. 4.1 of the thesis without highway-env's normalisation, over 0.5, with a failure at -`crash_penalty`; the
    mean over the frames a decision is held, times (1 - gamma), so that values stay in one range. (On the normalised reward a
    car that only brakes earns 0.70 of the maximum, and learners stay there.)
    """

    def __init__(
        self,
        env: EnvBase,
        learner: Learner,
        recipe: LearningDriver,
        phase: Phase,
        attack: AttackInLoop | None,
        generator: torch.Generator,
    ) -> None:
        self.env, self.learner, self.recipe, self.phase = env, learner, recipe, phase
        self.attack, self.generator = attack, generator
        self.buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(recipe.memory), batch_size=recipe.batch)
        # Without done_keys=[] the transform keeps the first step's `terminated` and bootstraps through crashes.
        self.multi_step = MultiStepTransform(n_steps=phase.n_step, gamma=phase.gamma, done_keys=[])
        self.td = env.reset()
        self.attacked = 0

    @torch.no_grad()
    def drive(self, decisions: int, share: float) -> None:
        """Take `decisions` on every road; `share` of the training is done."""
        chunk = []
        for _ in range(decisions):
            truth = self.td["observation"]
            if self.attack is not None and self.attack.where != "replay":
                self.td.set("observation", self.perturbed(truth, share))
            with set_exploration_type(ExplorationType.RANDOM):
                self.learner.explore(self.td)
            if self.attack is not None and self.attack.where == "both":
                self.td.set("observation", truth)
            step, self.td = self.env.step_and_maybe_reset(self.td)
            chunk.append(self._transition(step))
        transitions = self.multi_step.inv(torch.stack(chunk, -1))
        if transitions is not None and transitions.numel():
            self.buffer.extend(transitions.exclude("gamma", "nonterminal", ("next", "original_reward")).reshape(-1))

    def sample(self, share: float) -> TensorDictBase:
        """A batch of transitions, attacked afresh where the defence attacks the replay; `truth` is what was remembered."""
        sample = self.buffer.sample()
        sample.set("truth", sample["observation"])
        if self.attack is not None and self.attack.where != "acting":
            sample.set("observation", self.perturbed(sample["observation"], share))
        return sample

    def _transition(self, step: TensorDictBase) -> TensorDict:
        after, phase = step["next"], self.phase
        failed = after["info", "crashed"] | after["info", "offroad"]
        reward = after["info", "progress"] - self.recipe.crash_penalty * failed.float()
        after = after.select("observation", "terminated", "done")
        after.set("reward", reward * ((1 - phase.gamma) / phase.repeat))
        return TensorDict(
            {"observation": step["observation"], "action": step["action"], "next": after}, batch_size=step.batch_size
        )

    def perturbed(self, observation: Tensor, share: float) -> Tensor:
        """The observation [B, V, F] after the attack in the loop: each row attacked with probability 1 - skip."""
        loop = self.attack
        if loop is None or loop.skip >= 1 or share < loop.ramp[0]:
            return observation
        hit = torch.rand(observation.shape[0], generator=self.generator) >= loop.skip
        if not bool(hit.any()):
            return observation
        scale = min(1.0, (share - loop.ramp[0]) / max(loop.ramp[1] - loop.ramp[0], 1e-9))
        result = observation.clone()
        result[hit] = loop.attack(observation[hit], self.learner.policy, scale)
        self.attacked += int(hit.sum())
        return result


def target_state(params: TensorDictBase, module: nn.Module) -> dict[str, Tensor]:
    """The state dict of `module` out of the parameters of a TorchRL loss, whose flattened names end in the module's own.

    Args:
        params: for instance `loss.target_value_network_params`; twins are stacked, the first is taken.
        module: the module to load the state into.
    """
    flat = {str(name): value for name, value in params.data.flatten_keys(".").items()}
    state = {}
    for name, own in module.state_dict().items():
        for key, value in flat.items():
            if key == name or key.endswith("." + name):
                state[name] = value if value.shape == own.shape else value[0]
    return state


@torch.no_grad()
def selection_score(
    policy: Policy, world: DrivingWorld, episodes: int, perturb: Callable[[Tensor], Tensor] | None = None
) -> dict[str, float]:
    """Mean `safe_progress`, by road and over all, on the seeds that select checkpoints and are never reported.

    Args:
        policy: what drives.
        world: where.
        episodes: a road.
        perturb: what the policy is shown for an observation [B, V, F]; None is the truth.
    """
    cells = roads(episodes)
    env = world.make(cells, action_type=policy.action_type)
    seeds = torch.arange(SeedBlock.SELECT, SeedBlock.SELECT + episodes).repeat(len(cells) // episodes)
    td = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
    progress, failed = torch.zeros(len(cells)), torch.zeros(len(cells), dtype=torch.bool)
    for _ in range(world.max_steps):
        running = ~td["done"].squeeze(-1)
        shown = td["observation"]
        if perturb is not None:
            shown = shown.clone()
            shown[running] = perturb(shown[running])
        td.set("action", policy.decide(shown))
        td = env.step(td)["next"]
        progress += td["info", "progress"].squeeze(-1) * running
        failed |= (td["info", "crashed"] | td["info", "offroad"]).squeeze(-1) & running
        if bool(td["done"].all()):
            break
    score = torch.where(failed, 0.0, progress / world.max_steps).view(-1, episodes).mean(1)
    names = [f"{cell.lanes} lanes, density {cell.density:g}" for cell in cells[::episodes]]
    return {"mean": float(score.mean()), **dict(zip(names, score.tolist(), strict=True))}


@dataclass
class Best:
    """The best checkpoint so far: by its `selection_score`, or by the mean of that with and without the attack it trains on."""

    world: DrivingWorld
    attack: AttackInLoop | None
    episodes: int
    score: float = -1.0
    scores: dict[str, dict[str, float]] = field(default_factory=dict)
    share: float = 0.0
    weights: dict[str, Tensor] = field(default_factory=dict)
    history: list[tuple[float, float]] = field(default_factory=list)

    def offer(self, policy: Policy, share: float) -> None:
        """Score `policy` and keep its weights if none before was better."""
        scores = {"clean": selection_score(policy, self.world, self.episodes)}
        loop = self.attack
        if loop is not None and loop.skip < 1:
            # An attacked episode costs more than ten clean ones.
            scores["attacked"] = selection_score(
                policy, self.world, self.episodes // 3, lambda observation: loop.attack(observation, policy, 1.0)
            )
        score = sum(found["mean"] for found in scores.values()) / len(scores)
        self.history.append((round(share, 3), round(score, 4)))
        if score > self.score:
            self.score, self.scores, self.share = score, scores, share
            self.weights = copy.deepcopy(policy.state_dict())

    def restore(self, policy: Policy) -> Policy:
        """`policy` with the best weights, frozen."""
        policy.load_state_dict(self.weights)
        return policy.requires_grad_(False).eval()

    def card(self) -> dict[str, object]:
        """What the card says of the selection and the time."""
        return {
            "selection": {"safe_progress": self.scores, "share_of_training": self.share, "episodes": self.episodes},
            "selection_history": self.history,
        }
