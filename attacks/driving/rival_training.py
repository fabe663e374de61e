"""The training of a learned driver of the traffic: PPO among many episodes at once, with the victim in the loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from cavbench.attacks.driving.rival_seat import ACTIONS, FEATURES, empty, orders, seated, seen, told
from cavbench.core.ranges import Count, NotNegative, Share, Width
from cavbench.driving import Policy, State
from cavbench.driving.sets import Traffic
from cavbench.driving.traffic import View
from cavbench.driving.victims.logits import Logits, sampled
from cavbench.driving.victims.networks import QPolicy, StateValue
from cavbench.errors import UserError

LEAST_RATE = 0.05
"""The learning rate falls to this share of its beginning."""
LEAST = 2
"""Decisions in a round of which something can be learned: one has no advantage over others."""


@dataclass(frozen=True, kw_only=True)
class Lessons:
    """How the driver is trained; the parameters of `cavbench.attacks.driving.rival.Rival`."""

    cars: Annotated[int, Interval(ge=1, le=50)] = 1
    repeat: Count = 5
    decisions: Count = 400_000
    hidden: Width = 64
    crash: Annotated[float, Interval(ge=0, le=1e6)] = 200.0
    gamma: Annotated[float, Interval(ge=0, lt=1)] = 0.97
    trace: Share = 0.9
    copies: Count = 40
    rollout: Count = 32
    epochs: Count = 4
    batch: Count = 1024
    learning_rate: Annotated[float, Interval(gt=0, le=1)] = 1e-3
    clip: Annotated[float, Interval(gt=0, lt=1)] = 0.2
    entropy: NotNegative = 0.01


class Duel:
    """The episodes of a training: the learner in its seats, and the victim at the wheel of its car.

    Args:
        env: B episodes with orders to the traffic, in which a decision is one frame.
        victim: the (defended) victim; it decides at every frame.
        recipe: how the driver is trained.
    """

    def __init__(self, env: EnvBase, victim: Policy, recipe: Lessons) -> None:
        self.env, self.victim, self.recipe, self.bounds = env, victim, recipe, Traffic(cars=recipe.cars)
        self.batch, self.begun = int(env.batch_size[0]), 0
        self.td: TensorDictBase = env.reset()
        self.state: State = None
        self.seats = empty(self.batch, self.recipe.cars)
        self.ends, self.crashes = 0, 0
        self._begin(torch.ones(self.batch, dtype=torch.bool))

    def see(self) -> Tensor:
        """What the seats see now, [B, K, V, F]."""
        return seen(self.view, self.seats, self.bounds)

    @property
    def view(self) -> View:
        """The cars as they are."""
        return View.parsed(self.td["traffic"])

    def step(self, choice: Tensor) -> TensorDict:
        """Drive `repeat` frames by the choices [B, K], and restart what has ended; the transitions' ends, [B, K].

        The reward is minus the victim's progress and `crash` for its crash, times (1 - gamma) / repeat, which keeps the values in
        one range.
        """
        recipe = self.recipe
        self.seats = told(self.view, self.seats, choice, self.bounds)
        harm = torch.zeros(self.batch)
        for _ in range(recipe.repeat):
            running = ~self.td["done"].squeeze(-1)
            shown = self.td["observation"]
            action = self.victim.decide(shown, self.state)
            self.state = self.victim.advance(shown, action, self.state)
            self.td["action"], self.td["orders"] = action, orders(self.view, self.seats).stacked()
            self.td = self.env.step(self.td)["next"]
            harm -= self.td["info", "progress"].squeeze(-1) * running
        done, failed = self.td["done"].squeeze(-1), self.td["terminated"].squeeze(-1)
        harm += recipe.crash * failed
        self.seats = seated(self.view, self.seats)
        after = {"reward": harm * ((1 - recipe.gamma) / recipe.repeat), "done": done, "terminated": failed}
        shape = self.seats["car"].shape
        found = TensorDict(
            {name: one[:, None, None].expand(*shape, 1) for name, one in after.items()}, batch_size=shape
        )
        found["observation"] = self.see()
        self.ends, self.crashes = self.ends + int(done.sum()), self.crashes + int(failed.sum())
        if bool(done.any()):
            self.td = self.env.reset(self.td.set("_reset", done[:, None]))
            self._begin(done)
        return found

    def _begin(self, fresh: Tensor) -> None:
        """Seats and the victim's state in episodes that have just begun, bool [B]."""
        first = self.victim.initial(self.begun + torch.arange(self.batch))
        self.begun += self.batch
        if first is None or self.state is None:
            self.state = first
        else:
            self.state[fresh] = first[fresh]
        self.seats[fresh] = empty(self.batch, self.recipe.cars)[fresh]
        self.seats = seated(self.view, self.seats)


def train(duel: Duel, progress: Callable[[float, str], None]) -> tuple[QPolicy, dict[str, object]]:
    """Train a driver in `duel`; its network, the number of its decisions, and the victim's crash rate at the end.

    The crash rate is that of the episodes that ended in the last quarter of the training, while the driver still explored.

    Raises:
        UserError: if no car came near the victim.
    """
    recipe = duel.recipe
    student = Student(recipe)
    each = recipe.rollout * duel.batch * recipe.cars
    rounds = max(1, round(recipe.decisions / each))
    for number in range(rounds):
        if number == rounds - max(1, rounds // 4):
            duel.ends = duel.crashes = 0
        student.learn(collected(duel, student, recipe.rollout), 1 - number / rounds)
        progress((number + 1) / rounds, f"{duel.crashes} of {duel.ends} episodes ended in a crash")
    if not student.learned:
        raise UserError("there was nothing to learn for rival: no car of the traffic came near the victim")
    rate = round(duel.crashes / max(duel.ends, 1), 4)
    return student.policy, {"decisions": rounds * each, "crash_rate": rate}


@torch.no_grad()
def collected(duel: Duel, student: Student, decisions: int) -> TensorDict:
    """The transitions [B * K, T] of so many decisions."""
    found = []
    for _ in range(decisions):
        before, valid = duel.see(), duel.seats["car"] > 0
        drawn = student.actor(TensorDict({"observation": before}, batch_size=before.shape[:2]))
        after = duel.step(drawn["action"])
        chosen = drawn.select("observation", "action", "action_log_prob")
        found.append(TensorDict({**chosen, "valid": valid, "next": after}, batch_size=before.shape[:2]).flatten(0, 1))
    return torch.stack(found, 1)


class Student:
    """The networks, the loss and the optimiser: TorchRL's ClipPPOLoss and generalised advantages (Schulman et al. 2017, 2016)."""

    def __init__(self, recipe: Lessons) -> None:
        self.recipe, self.learned = recipe, 0
        self.policy = QPolicy(FEATURES, ACTIONS, recipe.hidden)
        with torch.no_grad():
            self.policy.network.head[-1].weight.mul_(0.1)
        self.actor = ProbabilisticTensorDictSequential(
            TensorDictModule(Logits(self.policy.network), in_keys=["observation"], out_keys=["logits"]),
            sampled(default_interaction_type="random"),
        )
        self.critic = TensorDictModule(
            StateValue(FEATURES, recipe.hidden), in_keys=["observation"], out_keys=["state_value"]
        )
        self.loss = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=recipe.clip,
            entropy_coeff=recipe.entropy,
            critic_coeff=1.0,
            normalize_advantage=False,
        )
        self.advantage = GAE(gamma=recipe.gamma, lmbda=recipe.trace, value_network=self.critic)
        self.adam = torch.optim.Adam(self.loss.parameters(), recipe.learning_rate, eps=1e-5)

    def learn(self, experience: TensorDict, left: float) -> None:
        """Learn from transitions [A, T]; `left` of the training is left."""
        recipe = self.recipe
        for group in self.adam.param_groups:
            group["lr"] = recipe.learning_rate * max(LEAST_RATE, left)
        with torch.no_grad():
            flat = self.advantage(experience).exclude("next").reshape(-1)
        flat = flat[flat["valid"]]
        if len(flat) < LEAST:
            return
        self.learned += len(flat)
        advantage = flat["advantage"]
        flat["advantage"] = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        for _ in range(recipe.epochs):
            for rows in torch.randperm(len(flat)).split(recipe.batch):
                losses = self.loss(flat[rows])
                self.adam.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                self.adam.step()
