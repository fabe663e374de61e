"""NAME:CHOICE: adapters, plug-ins with many components, of which the command line chooses one."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.checks import complaints
from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.run.config import plan_of
from tests.command import Said
from tests.plugins.distributions import install

ADAPTER = '''
from dataclasses import dataclass, field, make_dataclass
from typing import ClassVar

from cavbench.core.contracts import Access
from cavbench.driving import DrivingAttack


@dataclass(frozen=True, kw_only=True)
class Shelf(DrivingAttack):
    """An adapter to two components.

    Args:
        strength: how far, as a share of the radius.
    """

    access: ClassVar[Access] = "oblivious"
    libraries: ClassVar[tuple[str, ...]] = ("pytest",)
    sign: ClassVar[int]
    strength: float = 0.5

    @classmethod
    def choices(cls):
        return {"up": "everything is farther", "down": "everything is nearer"}

    @classmethod
    def chosen(cls, choice):
        return {"up": Up, "down": Down}[choice]

    def perturb(self, observation, oracle):
        return oracle.project(observation + self.sign * self.strength * oracle.radius)


@dataclass(frozen=True, kw_only=True)
class Up(Shelf):
    """Farther."""

    sign: ClassVar[int] = 1


@dataclass(frozen=True, kw_only=True)
class Down(Shelf):
    """Nearer.

    Args:
        steps: that nobody counts.
    """

    sign: ClassVar[int] = -1
    steps: int = 1
'''


@pytest.fixture
def shelf(plugins: Path) -> None:
    install(plugins, "cavbench-shelf", {"cavbench.attacks": {"shelf": "shelf:Shelf"}}, {"shelf": ADAPTER})


@pytest.mark.usefixtures("shelf")
def test_a_choice_is_a_component_with_parameters_of_its_own(bench: Callable[..., Said], tmp_path: Path) -> None:
    said = bench(
        *("run", "attack=shelf:up,shelf:down", "attack.strength=0.5,1", "attack.steps=3", "victim=toy", "world=toy"),
        *("lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0", "executor=serial", "reference=false"),
        f"out={tmp_path}",
    )
    assert said.code == 0, said.err
    assert "shelf:up" in said.out
    rows = [row for row in reading.read(tmp_path, track=track("driving")).to_pylist() if row["attack"] != "none"]
    made = {(row["attack"], row["attack_params"]) for row in rows}
    assert made == {
        ("shelf:up", '{"strength":0.5}'),
        ("shelf:up", '{"strength":1.0}'),
        ("shelf:down", '{"steps":3,"strength":0.5}'),
        ("shelf:down", '{"steps":3,"strength":1.0}'),
    }
    assert {row["attack_shipped_by"] for row in rows} == {"cavbench-shelf 1.0"}
    assert {json.loads(row["libraries"])["pytest"] for row in rows} == {pytest.__version__}
    assert all(":" not in row["pair"] for row in rows)


@pytest.mark.usefixtures("shelf")
def test_list_prints_the_choices_of_an_adapter(bench: Callable[..., Said]) -> None:
    assert "shelf:down  everything is nearer" in bench("list", "shelf").out
    assert "attack.steps" in bench("list", "shelf:down").out


@pytest.mark.usefixtures("shelf")
def test_a_choice_is_checked_as_any_component_is() -> None:
    assert complaints("attack", "shelf:down") == []


@pytest.mark.usefixtures("shelf")
@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("attack=shelf", "attack 'shelf' needs a choice; write shelf:NAME, with one of up, down"),
        ("attack=shelf:donw", "unknown attack 'shelf:donw'; did you mean 'down'? known: up, down"),
        ("attack=shelf:up attack.steps=3", "unknown parameter attack.steps of shelf:up; known: strength"),
        ("attack=noise:up", "attack 'noise' has no choices; write noise"),
        ("attack=shef:up", "unknown attack 'shef'; did you mean 'shelf'?"),
    ],
)
def test_a_bad_choice_is_refused_in_one_line(line: str, reason: str) -> None:
    with pytest.raises(UserError) as raised:
        plan_of(line.split())
    assert reason in str(raised.value)
    assert "\n" not in str(raised.value)
