"""`bench check` finds every broken rule, and says what to fix."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cavbench.checks import examine
from cavbench.core.registry import Kind
from tests.checks.rules import broken
from tests.cli.test_cli import assert_one_line
from tests.command import Said
from tests.plugins.distributions import install

Bench = Callable[..., Said]
CROOKED = '''
import random
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack, DrivingDefense, DrivingVictim, Policy
from cavbench.detection import PatchOracle
from cavbench.detection import PatchAttack


@dataclass(frozen=True, kw_only=True)
class Crooked(DrivingAttack):
    """Breaks one rule.

    Args:
        rule: which.
    """

    access: ClassVar[Access] = "scores"
    rule: str = "none"
    memory: ClassVar[list] = []

    def perturb(self, observation, oracle):
        match self.rule:
            case "shape":
                return observation[..., 1:]
            case "type":
                return (observation + 0.001).float()
            case "nothing":
                return None
            case "graph":
                return observation.clone().requires_grad_(True)
            case "nan":
                return observation / 0 * 0
            case "empty":
                return observation + observation[0] * 0
            case "batch":
                return observation + observation.mean()
            case "global":
                return observation + torch.rand(observation.shape) * oracle.radius
            case "numpy":
                return observation + float(np.random.rand()) * oracle.radius
            case "memory":
                self.memory.append(1)
                return observation + len(self.memory) * 0.01 * oracle.radius
            case "widen":
                oracle._enforcer._set._high = (observation + 1).numpy()
                return observation + 0.9
            case "greedy":
                for _ in range(3):
                    oracle.scores(observation)
                return observation
            case "access":
                oracle.gradient(observation, lambda scores: scores.sum(-1))
                return observation
            case "weights":
                with torch.no_grad():
                    for weight in oracle._enforcer.subject.policy.parameters():
                        weight.add_(0.1)
                return observation
            case "mode":
                oracle._enforcer.subject.policy.train()
                return observation
            case "in place":
                observation += 0.001
                return observation
            case "raise":
                raise ZeroDivisionError("at a loss")
            case "outside":
                return observation + 3 * oracle.radius
        return observation


@dataclass(frozen=True, kw_only=True)
class Undocumented(DrivingAttack):
    access: ClassVar[Access] = "oblivious"
    strength: float = 1.0

    def perturb(self, observation, oracle):
        return observation


@dataclass(frozen=True, kw_only=True)
class Unwritten(DrivingAttack):
    """Keeps a function.

    Args:
        function: any.
        steps: of another type than it says.
    """

    access: ClassVar[Access] = "oblivious"
    function: object = field(default_factory=lambda: lambda: 0)
    steps: int = 1

    def perturb(self, observation, oracle):
        return observation


class Bad(Policy):
    action_type = "discrete"

    def __init__(self, rule):
        super().__init__()
        self.rule = rule
        self.layer = torch.nn.Linear(5, 5)
        torch.nn.init.normal_(self.layer.weight, generator=torch.Generator().manual_seed(0))
        torch.nn.init.zeros_(self.layer.bias)
        if rule != "weights":
            self.requires_grad_(False)
        self.train(rule == "mode")

    def forward(self, observation):
        scores = self.layer(observation.mean(-2))
        match self.rule:
            case "shape":
                return scores.flatten()
            case "nan":
                return scores * torch.nan
            case "batch":
                return scores - scores.mean(0)
            case "random":
                return scores + torch.rand(1)
            case "blind":
                return torch.zeros_like(scores)
            case "masked":
                return scores.detach().round(decimals=2) + 0 * scores
            case "no graph":
                return scores.detach()
            case "learns":
                with torch.no_grad():
                    self.layer.weight.add_(1e-3)
        return scores

    def decide(self, observation, state=None):
        action = super().decide(observation, state)
        return action.float() if self.rule == "float" else action


@dataclass(frozen=True, kw_only=True)
class BadVictim(DrivingVictim):
    """Breaks one rule.

    Args:
        rule: which.
    """

    rule: str = "none"

    @property
    def action_type(self):
        return "continuous" if self.rule == "action type" else "discrete"

    def load(self, seed, facts):
        if self.rule == "raise":
            raise ZeroDivisionError("at a loss")
        return None if self.rule == "nothing" else Bad(self.rule)


@dataclass(frozen=True, kw_only=True)
class BadPatch(PatchAttack):
    """Breaks one rule.

    Args:
        rule: which.
    """

    access: ClassVar[Access] = "scores"
    rule: str = "none"

    def craft(self, oracle, scenes, progress):
        patch = torch.rand(3, 8, 8, generator=oracle.generator)
        match self.rule:
            case "shape":
                return patch[0]
            case "nan":
                return patch * torch.nan
            case "random":
                return patch * random.random()
            case "seeds":
                return patch * 0
            case "greedy":
                oracle.predict(scenes.render(torch.arange(len(scenes)), None, 0.5))
            case "progress":
                progress(2.0, "done twice")
            case "weights":
                with torch.no_grad():
                    for weight in oracle._enforcer.detector.parameters():
                        weight.add_(0.1)
            case "scenes":
                scenes.distance += 1
        return patch
'''
POINTS = {
    "cavbench.attacks": {
        "crooked": "crooked:Crooked",
        "undocumented": "crooked:Undocumented",
        "unwritten": "crooked:Unwritten",
        "bad_patch": "crooked:BadPatch",
    },
    "cavbench.victims": {"bad": "crooked:BadVictim"},
}
RULES: list[tuple[Kind, str, str, str, str]] = [
    ("attack", "crooked", "shape", "shape, type and device", "perturb returned shape [6, 10, 4] for [6, 10, 5]"),
    ("attack", "crooked", "type", "shape, type and device", "perturb returned torch.float32 on cpu for torch.float64"),
    ("attack", "crooked", "nothing", "shape, type and device", "perturb returned a NoneType, not a tensor"),
    ("attack", "crooked", "graph", "shape, type and device", "return answer.detach()"),
    ("attack", "crooked", "nan", "finite numbers", "values of the answer are NaN or infinite"),
    ("attack", "crooked", "empty", "empty batch", "IndexError"),
    ("attack", "crooked", "batch", "batching", "the answer for an episode depends on the others of its batch"),
    ("attack", "crooked", "global", "determinism", "draw with generator=oracle.generator"),
    ("attack", "crooked", "numpy", "determinism", "draw with generator=oracle.generator"),
    ("attack", "crooked", "memory", "determinism", "store nothing on the object"),
    ("attack", "crooked", "widen", "threat model", "the projected answer is outside the perturbation set"),
    (
        "attack",
        "crooked",
        "greedy",
        "query budget",
        "the attack asked for 1 queries in a step, the threat model allows 0",
    ),
    (
        "attack",
        "crooked",
        "access",
        "shape, type and device",
        "used access 'gradients', but declares only 'scores'",
    ),
    ("attack", "crooked", "weights", "victim left alone", "the victim's weights changed"),
    ("attack", "crooked", "mode", "victim left alone", "the victim's mode or gradients changed"),
    ("attack", "crooked", "in place", "victim left alone", "the true observation was changed in place"),
    ("attack", "crooked", "raise", "batching", "ZeroDivisionError: at a loss (crooked.py, line "),
    ("attack", "bad_patch", "shape", "shape and type", "a patch must be [3, P, P]"),
    ("attack", "bad_patch", "nan", "shape and type", "192 of 192 texels are NaN or infinite"),
    ("attack", "bad_patch", "random", "determinism", "draw with generator=oracle.generator"),
    ("attack", "bad_patch", "seeds", "seeds", "set seeded = False"),
    ("attack", "bad_patch", "greedy", "query budget", "the attack asked about 12 images, the threat model allows 0"),
    ("attack", "bad_patch", "progress", "progress", "outside [0, 1]"),
    ("attack", "bad_patch", "weights", "victim left alone", "the detector's weights changed"),
    ("attack", "bad_patch", "scenes", "victim left alone", "the scenes were changed in place"),
    ("victim", "bad", "nothing", "ready to drive", "load returned a NoneType, not a cavbench.driving.Policy"),
    ("victim", "bad", "raise", "behaviour", "ZeroDivisionError: at a loss"),
    ("victim", "bad", "mode", "ready to drive", "load must return policy.eval()"),
    ("victim", "bad", "weights", "ready to drive", "load must return policy.requires_grad_(False)"),
    (
        "victim",
        "bad",
        "action type",
        "ready to drive",
        "the policy's action_type is 'discrete', but the victim's is 'continuous'",
    ),
    ("victim", "bad", "shape", "shape and type", "keep all dimensions but the last two"),
    ("victim", "bad", "nan", "shape and type", "some scores are NaN or infinite"),
    ("victim", "bad", "float", "decisions", "discrete actions are int64"),
    ("victim", "bad", "batch", "batching", "the scores of an episode depend on the others"),
    ("victim", "bad", "random", "determinism", "two loads with the same seed give different scores"),
    ("victim", "bad", "blind", "sees", "set sees = False"),
    ("victim", "bad", "masked", "gradient", "its gradient is 0 everywhere"),
    ("victim", "bad", "no graph", "gradient", "its scores have no graph"),
    ("victim", "bad", "learns", "weights left alone", "its weights changed when it was queried"),
]


@pytest.fixture
def crooked(plugins: Path) -> None:
    install(plugins, "crooked-pack", POINTS, {"crooked": CROOKED})


@pytest.mark.usefixtures("crooked")
@pytest.mark.parametrize(("kind", "name", "rule", "check", "part"), RULES, ids=[f"{r[1]}-{r[2]}" for r in RULES])
def test_a_broken_rule_is_reported_with_its_fix(kind: Kind, name: str, rule: str, check: str, part: str) -> None:
    found = broken(kind, name, rule=rule)
    assert part in found[check]
    assert "\n" not in found[check]


@pytest.mark.usefixtures("crooked")
@pytest.mark.parametrize(("kind", "name"), [("attack", "crooked"), ("attack", "bad_patch"), ("victim", "bad")])
def test_a_component_that_breaks_no_rule_passes(kind: Kind, name: str) -> None:
    assert broken(kind, name) == {}


@pytest.mark.usefixtures("crooked")
def test_rules_for_all_components_are_checked() -> None:
    assert "Undocumented has no docstring" in broken("attack", "undocumented")["docs"]
    unwritten = broken("attack", "unwritten")
    assert "the parameters of attack 'unwritten' cannot be set on the command line" in unwritten["command line"]
    assert "keep only plain values in its fields" in unwritten["worker processes"]


@pytest.mark.usefixtures("crooked")
def test_an_answer_outside_the_set_is_projected_with_a_remark() -> None:
    outcomes = {outcome.check: outcome for outcome in examine("attack", "crooked", {"rule": "outside"})}
    assert outcomes["threat model"].status == "pass"
    assert "outside the set, projected by the oracle" in outcomes["threat model"].text


@pytest.mark.usefixtures("crooked")
def test_check_prints_what_to_fix_and_exits_with_1(bench: Bench) -> None:
    good, bad = bench("check", "crooked"), bench("check", "crooked", "attack.rule=shape")
    assert good.code == 0
    assert "0 to fix" in good.out
    assert bad.code == 1
    assert "✗ fix" in bad.out
    assert "perturb returned shape [6, 10, 4]" in " ".join(bad.out.split())


@pytest.mark.usefixtures("crooked")
@pytest.mark.parametrize(
    ("words", "part"),
    [
        (("croked",), "unknown component 'croked'; did you mean 'crooked'?"),
        (("crooked", "attack.speed=2"), "unknown parameter attack.speed of crooked"),
        (("crooked", "defense.rule=2"), "unknown key 'defense.rule'"),
        (("crooked", "rule"), "cannot read 'rule'"),
        (("pgd", "attack.steps=0"), "steps must be at least 1, got 0"),
    ],
)
def test_bad_options_of_check_are_refused_in_one_line(bench: Bench, words: tuple[str, ...], part: str) -> None:
    assert_one_line(bench("check", *words), part)


@pytest.mark.usefixtures("crooked")
def test_a_defence_is_checked_on_the_given_victim() -> None:
    outcomes: list[Any] = list(examine("defense", "none", victim="bad"))
    skipped = [outcome for outcome in outcomes if outcome.check == "detection: behaviour"]
    assert "victim 'bad' belongs to another track" in skipped[0].text
    assert all(outcome.status != "fail" for outcome in outcomes)
