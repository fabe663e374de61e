"""A policy whose score would be wrong is refused before anything is driven; one that attacks cannot judge is named."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor, nn

import cavbench
from cavbench.api.scoring import _Silent
from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.driving import PolicyWrapper, State
from cavbench.driving.trial import try_policy
from cavbench.driving.victims.from_file import FilePolicy
from cavbench.envs.highway.axes import AXES
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.run import runner
from cavbench.run.config import plan_of

WORLD = HighwayWorld()
CELLS = (AXES.cell(lanes=3, density=1.0, weather="clear"), AXES.cell(lanes=4, density=2.0, weather="fog"))


class Wraps(nn.Module):
    """The zoo's DQN inside of a module that does something else, too."""

    def __init__(self) -> None:
        super().__init__()
        self.net = choose("victim", "dqn").component.load(0, WORLD.facts)
        self.begin()

    def begin(self) -> None:
        pass

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown)


class OfTheBatch(Wraps):
    """Normalises by the batch, as a batch normalisation without running statistics does."""

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown + 0.1 * (shown - shown.mean(0)) * (shown != 0))


class OfItsPlace(Wraps):
    """An observation's answer depends on its place in the batch."""

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) * (1 + 0.1 * (torch.arange(len(shown)) % 2)[:, None])


class OfItsSize(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) if len(shown) < 100 else -self.net(shown)


class Drops(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(nn.functional.dropout(shown, 0.1))


class Seeded(Wraps):
    """Draws from a generator of its own."""

    def begin(self) -> None:
        self.generator = torch.Generator().manual_seed(0)

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) + torch.rand(len(shown), 5, generator=self.generator)


class Buffer(Wraps):
    """A running mean that each call updates, as in many PPO scripts; here it has no weight."""

    def begin(self) -> None:
        self.register_buffer("mean", torch.zeros(10, 5))

    def forward(self, shown: Tensor) -> Tensor:
        self.mean += 0.1 * (shown.detach().mean(0) - self.mean)
        return self.net(shown - 0.0 * self.mean)


class Stack(Wraps):
    """The mean of the last two observations of this size."""

    def begin(self) -> None:
        self.frames: Any = deque(maxlen=2)

    def forward(self, shown: Tensor) -> Tensor:
        self.frames = deque([one for one in self.frames if one.shape == shown.shape] + [shown.detach()], 2)
        return self.net(torch.stack(tuple(self.frames)).mean(0))


class Frames(Stack):
    def begin(self) -> None:
        self.frames = []

    def forward(self, shown: Tensor) -> Tensor:
        self.frames = [*[one for one in self.frames if one.shape == shown.shape][-1:], shown.detach()]
        return self.net(torch.stack(tuple(self.frames)).mean(0))


class Counts(Wraps):
    """Counts its calls; what it answers changes after a while only."""

    calls = 0

    def forward(self, shown: Tensor) -> Tensor:
        self.calls += 1
        return self.net(shown) if self.calls < 10_000 else -self.net(shown)


class Inside(Wraps):
    """A number in an object in a dictionary."""

    def begin(self) -> None:
        self.notes = {"memory": type("Memory", (), {})()}

    def forward(self, shown: Tensor) -> Tensor:
        self.notes["memory"].last = float(shown.mean())
        return self.net(shown)


class Enclosed(Wraps):
    """A list that only a function sees."""

    def begin(self) -> None:
        seen: list[float] = []
        self.note = lambda value: seen.append(value)

    def forward(self, shown: Tensor) -> Tensor:
        self.note(float(shown.mean()))
        return self.net(shown)


CALLS: list[int] = []


class Globally(Wraps):
    """Counts its calls in a global list; what it answers changes much later."""

    def forward(self, shown: Tensor) -> Tensor:
        CALLS.append(1)
        return self.net(shown) if len(CALLS) < 10_000 else -self.net(shown)


class NaN(Wraps):
    """A number divided by the presence of a car: not a number where it is absent."""

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) + 0.0 * (shown[..., 1] / shown[..., 0]).sum(-1, keepdim=True)


class Complex(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) * (1 + 0j)


class InPlace(Wraps):
    """Writes to its input, which has no gradient then."""

    def forward(self, shown: Tensor) -> Tensor:
        shown[..., 0] = 1.0
        return self.net(shown)


class Quantised(Wraps):
    """Its activations are quantised by the range of the batch (docs/pitfalls.md)."""

    def begin(self) -> None:
        torch.manual_seed(0)
        floats = nn.Sequential(nn.Flatten(), nn.Linear(50, 64), nn.ReLU(), nn.Linear(64, 5))
        self.net = torch.ao.quantization.quantize_dynamic(floats, {nn.Linear}, dtype=torch.qint8)


REFUSED: dict[type[Wraps], str] = {
    Quantised: "quantise by fixed statistics",
    OfTheBatch: "answers otherwise about an observation",
    OfItsPlace: "answers otherwise about an observation",
    OfItsSize: "in a large batch",
    Drops: "draws random numbers",
    Seeded: "remembers earlier calls in 'network.generator'",
    Buffer: "remembers earlier calls in 'network.mean'",
    Stack: "remembers earlier calls",
    Frames: "remembers earlier calls",
    Counts: "remembers earlier calls in 'network.calls'",
    Inside: "remembers earlier calls in 'network.notes'",
    Enclosed: "remembers earlier calls in 'network.note'",
    Globally: "remembers earlier calls in 'a global value of its code'",
    NaN: "NaN or infinity",
    Complex: "real numbers",
    InPlace: "asks for its gradient",
}


def tried(network: nn.Module) -> list[str]:
    policy = FilePolicy(network.eval(), (10, 5), "discrete", 5, "")
    return try_policy(policy, WORLD, CELLS, gradients=True, random=False)


@pytest.mark.parametrize("kind", REFUSED, ids=lambda kind: kind.__name__)
def test_a_network_whose_score_would_be_wrong_is_refused(kind: type[Wraps]) -> None:
    with pytest.raises(UserError, match=REFUSED[kind]):
        tried(kind())


class OneHot(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return nn.functional.one_hot(self.net(shown).argmax(-1), 5).float()


class Rounded(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net((shown * 1000).round() / 1000)


class Detached(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown.detach())


class Rooted(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) + 0.0 * shown[..., 4].abs().sqrt().sum(-1, keepdim=True)


class Caches(Wraps):
    """Keeps a constant for each size of a batch: the same calls leave it as it is."""

    def begin(self) -> None:
        self.constants: dict[int, Tensor] = {}

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) + self.constants.setdefault(len(shown), torch.zeros(len(shown), 1))


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        (Wraps, ""),
        (Caches, ""),
        (OneHot, "no gradient|same scores at all points around"),
        (Rounded, "no gradient"),
        (Detached, "no gradient"),
        (Rooted, "NaN"),
    ],
)
def test_a_network_without_a_usable_gradient_is_named(kind: type[Wraps], said: str) -> None:
    found = tried(kind())
    wanted = said.split("|") if said else []
    assert len(found) == len(wanted)
    assert all(words in line for words, line in zip(wanted, found, strict=True))


def test_a_black_box_whose_scores_are_steps_is_named_without_a_gradient() -> None:
    for kind, count in ((OneHot, 1), (Rounded, 0), (Wraps, 0)):
        policy = FilePolicy(kind().eval(), (10, 5), "discrete", 5, "")
        assert len(try_policy(policy, WORLD, CELLS, gradients=False, random=False)) == count


class Controls(nn.Module):
    """Acceleration and steering."""

    def __init__(self, largest: float) -> None:
        super().__init__()
        self.linear, self.largest = nn.Linear(50, 2), largest
        nn.init.constant_(self.linear.weight, 0.01)
        nn.init.constant_(self.linear.bias, 0.5)

    def forward(self, shown: Tensor) -> Tensor:
        return self.largest * self.linear(shown.flatten(1)).tanh()


def test_controls_in_units_of_physics_are_named() -> None:
    for largest, said in ((1.0, []), (5.0, ["answers controls at or beyond an end of [-1, 1]"])):
        policy = FilePolicy(Controls(largest).eval(), (10, 5), "continuous", 2, "")
        found = try_policy(policy, WORLD, CELLS, gradients=False, random=False)
        assert [line[:46] for line in found] == [line[:46] for line in said]


HONEST: dict[str, dict[str, Any]] = {
    "dqn": {},
    "ddpg": {},
    "planner": {},
    "dqn behind": {"victim": "dqn", "behind": "tracker+shield"},
}


@pytest.mark.parametrize("name", HONEST)
@pytest.mark.parametrize("defense", ["none", "frame_stack", "tracker"])
def test_the_zoo_and_the_defences_pass(name: str, defense: str) -> None:
    given = dict(HONEST[name])
    victim = choose("victim", given.pop("victim", name), **given).component
    policy = choose("defense", defense).component.load(victim, 0, WORLD.facts)
    assert try_policy(policy, WORLD, CELLS, gradients=True, random=False) == []


def test_a_policy_that_tells_a_simulated_copy_by_the_batch_is_refused() -> None:
    class Dreams(PolicyWrapper):
        """Marks states that were advanced in another batch than they began in."""

        def initial(self, episodes: Tensor) -> State:
            began = torch.full(episodes.shape, len(episodes))
            return TensorDict({"began": began, "dream": torch.zeros(episodes.shape)}, batch_size=episodes.shape)

        def scores(self, observation: Tensor, state: State = None) -> Tensor:
            assert state is not None
            return self.policy.scores(observation) * (1 - state["dream"].unsqueeze(-1))

        def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
            assert state is not None
            return state.clone().set("dream", (state["began"] != len(observation)).float())

    policy = Dreams(choose("victim", "dqn").component.load(0, WORLD.facts)).requires_grad_(False).eval()
    with pytest.raises(UserError, match="simulated copy"):
        try_policy(policy, WORLD, CELLS, gradients=True, random=True)


def test_a_refused_network_costs_no_baseline(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^Stack-\w+ is refused: it remembers earlier calls") as caught:
        cavbench.score(Stack(), "noise", lanes=3, density=1, weather="clear", episodes=2, out=tmp_path)
    assert "none" not in str(caught.value)
    assert not list(tmp_path.rglob("*.parquet"))


def test_a_network_without_a_gradient_is_named_before_it_is_driven(tmp_path: Path) -> None:
    options: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear", "episodes": 1, "baselines": False}
    with pytest.warns(UserWarning, match="has no gradient in 100 %"):
        cavbench.score(Rounded(), "noise", world=HighwayWorld(max_steps=5), out=tmp_path, **options)


class Noisy(Wraps):
    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) + torch.rand_like(shown[:, 0])


def test_a_file_that_draws_random_numbers_is_refused_before_anything_is_driven(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    pytest.importorskip("onnxruntime")
    path = tmp_path / "drawn.onnx"
    batch = {"shown": {0: torch.export.Dim("batch")}}
    torch.onnx.export(Noisy(), (torch.rand(3, 10, 5),), path, dynamic_shapes=batch, external_data=False, verbose=False)
    words = f"attack=noise victim=onnx victim.path={path} out={tmp_path / 'results'} episodes=1 executor=serial"
    with pytest.raises(UserError, match="is refused: it answers otherwise when it is asked the same again"):
        runner.run(plan_of(words.split()), _Silent())
    assert not list(tmp_path.rglob("*.parquet"))


def test_every_track_tries_its_networks() -> None:
    assert all("try_network" in vars(type(track(name))) for name in ("driving", "detection"))


class Fogged(Wraps):
    """Fails where all cars but one are absent."""

    def forward(self, shown: Tensor) -> Tensor:
        return self.net(shown) / (shown[:, 1:, 0].sum(-1, keepdim=True) > 1)


def test_a_network_is_tried_on_an_empty_road_whatever_the_cells_are() -> None:
    with pytest.raises(UserError, match="NaN or infinity"):
        tried(Fogged())
