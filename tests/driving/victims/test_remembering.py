"""Recurrent drivers from outside: what they remember is a state of each episode, as a module and as a program."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, LSTMModule

from cavbench.core.pair import choose
from cavbench.driving import Policy
from cavbench.driving.trial import try_policy
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from tests.driving.victims.policy_files import FACTS, driven

SHOWN = torch.rand(6, 4, 10, 5, generator=torch.Generator().manual_seed(0)) * 2 - 1
"""Observations of six decisions in four episodes."""
BATCH = torch.export.Dim("batch")


def actor() -> TensorDictSequential:
    torch.manual_seed(0)
    found = TensorDictSequential(
        TensorDictModule(nn.Flatten(-2), in_keys=["observation"], out_keys=["flat"]),
        LSTMModule(input_size=50, hidden_size=12, num_layers=2, in_key="flat", out_key="flat"),
        TensorDictModule(MLP(in_features=12, out_features=5, num_cells=[16]), in_keys=["flat"], out_keys=["logits"]),
    )
    with torch.no_grad():
        for weight in found.parameters():
            weight.mul_(3)
    return found


class Called(nn.Module):
    """A recurrent actor as docs/victims/torch.md exports it."""

    def __init__(self, actor: nn.Module) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, observation: Tensor, h: Tensor, c: Tensor, is_init: Tensor) -> tuple[Tensor, ...]:
        entries = {"observation": observation, "recurrent_state_h": h, "recurrent_state_c": c, "is_init": is_init}
        td = self.actor(TensorDict(entries, batch_size=observation.shape[:1]))
        return td["logits"], td["next", "recurrent_state_h"], td["next", "recurrent_state_c"]


class Plain(nn.Module):
    """A GRU of torch, whose memory has the batch as its second axis; it also returns a value."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(1)
        self.gru, self.head = nn.GRU(50, 8), nn.Linear(8, 6)

    def forward(self, observation: Tensor, memory: Tensor) -> tuple[Tensor, ...]:
        hidden, memory = self.gru(observation.flatten(1)[None], memory)
        value, logits = self.head(hidden[0] * 5).tensor_split([1], -1)
        return value, logits, memory


def program(path: Path, network: nn.Module, *given: Tensor, axes: tuple[int, ...], strict: bool = False) -> str:
    shapes = tuple({axis: BATCH} for axis in axes)
    torch.export.save(torch.export.export(network, given, dynamic_shapes=shapes, strict=strict), path)
    return str(path)


@pytest.fixture(scope="module")
def lstm_program(tmp_path_factory: pytest.TempPathFactory) -> str:
    first = torch.ones(4, 1, dtype=torch.bool)
    path = tmp_path_factory.mktemp("lstm") / "lstm.pt2"
    states = torch.zeros(4, 2, 12), torch.zeros(4, 2, 12)
    # The LSTMModule cannot be traced with a dynamic batch otherwise.
    return program(path, Called(actor()), SHOWN[0], *states, first, axes=(0, 0, 0, 0), strict=True)


def loaded(path: str, **options: Any) -> Policy:
    return choose("victim", "torch", path=path, **options).component.load(0, FACTS)


def follows(policy: Policy, step: Callable[[Tensor, Any], tuple[Tensor, Any]], memory: Any) -> None:
    """The policy answers as the network does that is given its own memory."""
    state = policy.initial(torch.arange(4))
    differs = False
    for shown in SHOWN:
        fresh = policy.scores(shown, policy.initial(torch.arange(4)))
        wanted, memory = step(shown, memory)
        torch.testing.assert_close(policy.scores(shown, state), wanted)
        differs = differs or not torch.allclose(fresh, wanted)
        state = policy.advance(shown, policy.decide(shown, state), state)
    assert differs, "the memory would not matter"


def test_a_recurrent_actor_answers_the_same_as_an_object_and_as_a_program(lstm_program: str) -> None:
    network = Called(actor())

    @torch.no_grad()
    def step(shown: Tensor, memory: Any) -> tuple[Tensor, Any]:
        logits, *after = network(shown, *memory, torch.zeros(4, 1, dtype=torch.bool))
        return logits, after

    for policy in (
        loaded(lstm_program),
        in_process([actor()], FACTS, SHOWN[0], None).load(0, FACTS),
    ):
        follows(policy, step, [torch.zeros(4, 2, 12)] * 2)


def test_the_batch_may_be_any_axis_of_a_memory(tmp_path: Path) -> None:
    path = program(tmp_path / "gru.pt2", Plain(), SHOWN[0], torch.zeros(1, 4, 8), axes=(0, 1))

    @torch.no_grad()
    def step(shown: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        _, logits, after = Plain()(shown, memory)
        return logits, after

    follows(loaded(path), step, torch.zeros(1, 4, 8))


def test_a_recurrent_program_passes_the_trial_and_is_driven_and_attacked(lstm_program: str) -> None:
    path, world = lstm_program, HighwayWorld(max_steps=40)
    cells = [world.axes.cell(lanes=3, density=1.0, weather="clear")]
    for policy in (loaded(path), in_process([actor()], FACTS, SHOWN[0], None).load(0, FACTS)):
        assert try_policy(policy, world, cells, gradients=True, random=False) == []
    clean = driven("attack=none", "victim=torch", f"victim.path={path}")
    assert clean["inconsistent"].max() == 0
    attacked = driven("attack=pgd", "threat.norm=linf", "threat.budget=0.2", "victim=torch", f"victim.path={path}")
    assert attacked["queries"].min() > 1
    assert attacked["inconsistent"].max() == 0
    assert attacked["changed"].max() > 0


class Merged(nn.Module):
    """A network with two memories."""

    def forward(self, observation: Tensor, h: Tensor, c: Tensor) -> tuple[Tensor, ...]:
        return observation[:, 0] + h - 2 * c, h + 1, c + 2


def test_a_program_that_took_two_memories_for_one_is_refused(tmp_path: Path) -> None:
    one, other = torch.zeros(4, 1), torch.zeros(4, 1)
    wrong = torch.export.export(Merged(), (SHOWN[0], one, one)).module()
    h, c = torch.ones(4, 1), torch.full((4, 1), 7.0)
    # What is guarded against: torch computes with the second memory in the place of the first.
    torch.testing.assert_close(wrong(SHOWN[0], h, c)[0], Merged()(SHOWN[0], c, c)[0])
    path = program(tmp_path / "one.pt2", Merged(), SHOWN[0], one, one, axes=(0, 0, 0))
    with pytest.raises(
        UserError, match=r"does not read its input 'h'. torch.export takes two example inputs that are one tensor"
    ):
        loaded(path)
    path = program(tmp_path / "two.pt2", Merged(), SHOWN[0], one, other, axes=(0, 0, 0))
    assert torch.equal(
        loaded(path).scores(SHOWN[0], TensorDict({"memory1": h, "memory2": c, "begun": h[:, 0] > 0}, [4])),
        Merged()(SHOWN[0], h, c)[0],
    )


class Extra(Plain):
    def forward(self, observation: Tensor, speed: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        hidden, _ = self.gru(observation.flatten(1)[None])
        return (self.head(hidden[0])[:, :5] + speed,)


class Numbers(Plain):
    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        hidden, _ = self.gru(observation.flatten(1)[None])
        logits = self.head(hidden[0])[:, :5]
        return logits.argmax(-1), logits.amax(-1)


class Two(Numbers):
    def forward(self, observation: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        hidden, _ = self.gru(observation.flatten(1)[None])
        logits = self.head(hidden[0])[:, :5]
        return logits.exp(), logits


def test_a_program_that_does_not_say_what_drives_is_told_what_to_type(tmp_path: Path) -> None:
    path = program(tmp_path / "two.pt2", Two(), SHOWN[0], axes=(0,))
    with pytest.raises(
        UserError, match=r"returns 0: float32 \[any, 5\]; 1: float32 \[any, 5\]. Say which of these drives"
    ):
        loaded(path)
    with pytest.raises(UserError, match=r"victim.output=2, but .* returns 0: float32"):
        loaded(path, output=2)
    torch.testing.assert_close(loaded(path, output=1).scores(SHOWN[0]).exp(), loaded(path, output=0).scores(SHOWN[0]))
    path = program(tmp_path / "numbers.pt2", Numbers(), SHOWN[0], axes=(0,))
    with pytest.raises(UserError, match=r"returns 0: int64 \[any\]; 1: float32 \[any\]. Say which has 5 real numbers"):
        loaded(path)


def test_a_program_with_another_input_than_a_memory_is_refused(tmp_path: Path) -> None:
    path = program(tmp_path / "extra.pt2", Extra(), SHOWN[0], torch.zeros(4, 1), axes=(0, 0))
    with pytest.raises(
        UserError, match=r"takes a memory of speed float32 \[any, 1\], and does not return it in the same order"
    ):
        loaded(path)
