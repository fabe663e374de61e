"""Actors of TorchRL are driven by what they compute before they explore, or refused in one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.data import Bounded, Categorical, OneHot
from torchrl.envs import VecNorm
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import (
    Actor,
    EGreedyModule,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    QValueModule,
    TanhModule,
    TanhNormal,
)

from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError

FACTS = HighwayWorld().facts
SHOWN = torch.rand(6, 10, 5, generator=torch.Generator().manual_seed(0)) * 2 - 1


def network(outputs: int, *more: nn.Module, flat: bool = True) -> nn.Sequential:
    """Large weights, so that squashing matters."""
    torch.manual_seed(outputs)
    layers = nn.Sequential(*([nn.Flatten(-2)] if flat else []), nn.Linear(50, outputs), *more)
    with torch.no_grad():
        for weight in layers.parameters():
            weight.mul_(4)
    return layers


def module(net: nn.Module, *keys: str) -> TensorDictModule:
    return TensorDictModule(net, in_keys=["observation"], out_keys=list(keys))


def normal(**options: Any) -> ProbabilisticActor:
    net = module(network(4, NormalParamExtractor()), "loc", "scale")
    return ProbabilisticActor(net, in_keys=["loc", "scale"], distribution_class=TanhNormal, **options)


def categorical(kind: Any = torch.distributions.Categorical) -> ProbabilisticActor:
    return ProbabilisticActor(module(network(5), "logits"), in_keys=["logits"], distribution_class=kind)


def exploring() -> TensorDictSequential:
    actor = QValueActor(network(5), in_keys=["observation"], spec=Categorical(5))
    return TensorDictSequential(actor, EGreedyModule(spec=Categorical(5), eps_init=1.0, eps_end=1.0))


def normalised() -> TensorDictSequential:
    """Behind the statistics that a VecNorm has learned, as its actor was in training."""
    learning = VecNorm(in_keys=["observation"])
    for _ in range(3):
        learning(TensorDict({"observation": SHOWN.flatten(1) * 3 + 1}, batch_size=[len(SHOWN)]))
    actor = QValueActor(network(5, flat=False), in_keys=["observation"], spec=Categorical(5))
    return TensorDictSequential(learning.to_observation_norm(), actor)


ACTORS: dict[str, Callable[[], TensorDictModuleBase]] = {
    "values": lambda: module(network(5), "action_value"),
    "another name": lambda: module(network(5), "q"),
    "QValueActor": lambda: QValueActor(network(5), in_keys=["observation"], spec=Categorical(5)),
    "one-hot QValueActor": lambda: QValueActor(network(5), in_keys=["observation"], spec=OneHot(5)),
    "QValueModule": lambda: TensorDictSequential(module(network(5), "action_value"), QValueModule(spec=Categorical(5))),
    "with exploration": exploring,
    "Actor": lambda: Actor(network(2), in_keys=["observation"]),
    "TanhNormal": normal,
    "TanhNormal with log_prob": lambda: normal(return_log_prob=True),
    "TanhNormal, its action only": lambda: normal().select_out_keys("action"),
    "Categorical": categorical,
    "OneHotCategorical": lambda: categorical(OneHotCategorical),
    "OneHotCategorical, its action only": lambda: categorical(OneHotCategorical).select_out_keys("action"),
    "normalised": normalised,
    "flat": lambda: module(network(5, flat=False), "action_value"),
}


def own_action(actor: TensorDictModuleBase) -> Tensor:
    shown = SHOWN.flatten(1) if not any(isinstance(part, nn.Flatten) for part in actor.modules()) else SHOWN
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        written = actor(TensorDict({"observation": shown}, batch_size=[len(shown)]))
    action = next((written[key] for key in ("action", "action_value", "q") if key in written.keys()), None)  # noqa: SIM118
    assert action is not None
    if action.shape[-1:] == (5,):
        return action.float().argmax(-1)
    return action.clamp(-1, 1) if action.is_floating_point() else action


@pytest.mark.parametrize("name", ACTORS)
def test_an_actor_is_driven_without_its_exploration(name: str) -> None:
    actor = ACTORS[name]()
    policy = in_process([actor], FACTS, SHOWN, None).load(0, FACTS)
    wanted = own_action(actor)
    for _ in range(2):
        torch.testing.assert_close(policy.decide(SHOWN), wanted)
    shown = SHOWN.clone().requires_grad_(True)
    policy.scores(shown).sum().backward()
    assert shown.grad is not None
    assert shown.grad.abs().sum() > 0


REFUSED: dict[str, tuple[Callable[[], nn.Module], str]] = {
    "two inputs": (
        lambda: TensorDictModule(network(5), in_keys=["observation", "mask"], out_keys=["logits"]),
        "reads observation, mask, a driver is given one observation",
    ),
    "a memory": (
        lambda: TensorDictModule(nn.GRUCell(50, 5), in_keys=["observation", "h"], out_keys=["logits", ("next", "h")]),
        "remembers h, whose shape only an LSTMModule or a GRUModule says; give a cavbench.driving.Policy",
    ),
    "nothing of an action": (
        lambda: module(network(4, NormalParamExtractor()), "loc", "scale"),
        "writes loc, scale; a driver writes one of action_value, logits, probs, action",
    ),
    "numbers of actions": (
        lambda: module(Number(), "action"),
        "it returns",
    ),
    "one-hot actions": (lambda: module(Chosen(), "action"), "writes one-hot actions, without the values"),
    "another scale": (
        lambda: normal(distribution_kwargs={"low": -2.0, "high": 2.0}),
        r"has actions up to -2, controls are in \[-1, 1\]",
    ),
    "another scale in a squashing": (
        lambda: TensorDictSequential(module(network(2), "action"), TanhModule(in_keys=["action"], low=-5.0, high=5.0)),
        r"has actions up to -5, controls are in \[-1, 1\]",
    ),
    "another scale in its spec": (
        lambda: Actor(network(2), in_keys=["observation"], spec=Bounded(-3.0, 3.0, (2,))),
        r"has actions up to -3, controls are in \[-1, 1\]",
    ),
    "a normalisation that goes on learning": (
        lambda: TensorDictSequential(VecNorm(in_keys=["observation"]), module(network(5), "action_value")),
        r"holds a VecNorm, which goes on learning its statistics when it is called: put transform.to_observation_norm\(\)",
    ),
    "other rows": (
        lambda: module(nn.Sequential(nn.Flatten(-2), nn.Linear(25, 5)), "action_value"),
        r"on \[6, 10, 5\] it fails \(RuntimeError: mat1 and mat2 .*6x50",
    ),
}


class Number(nn.Module):
    def forward(self, observation: Tensor) -> Tensor:
        return observation[:, 0].argmax(-1)


class Chosen(nn.Module):
    def forward(self, observation: Tensor) -> Tensor:
        return torch.nn.functional.one_hot(observation[:, 0].argmax(-1), 5).float()


@pytest.mark.parametrize("name", REFUSED)
def test_an_actor_that_cannot_be_driven_is_refused_in_one_line(name: str) -> None:
    make, line = REFUSED[name]
    with pytest.raises(UserError, match=line) as error:
        in_process([make()], FACTS, SHOWN, None)
    assert "\n" not in str(error.value)


def test_the_given_actor_stays_as_it_is() -> None:
    actor = normal().select_out_keys("action")
    in_process([actor], FACTS, SHOWN, None)
    assert list(actor.out_keys) == ["action"]
