"""`bench check` finds policies, attacks and defences that do not keep their memory in the state."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavbench.checks import examine
from cavbench.core.registry import Kind
from tests.plugins.distributions import install
from tests.tree import PLUGINS

POINTS = {
    "cavbench.victims": {"forgetful": "bad_memory_plugin:Forgetful"},
    "cavbench.attacks": {"grudge": "bad_memory_plugin:Grudge"},
    "cavbench.defenses": {"losing": "bad_memory_plugin:Losing"},
}
ON_THE_OBJECT = "keep memory in the state that initial and advance return, not on the object"
RULES: list[tuple[Kind, str, str, str, str]] = [
    ("victim", "forgetful", "counts", "determinism", "two calls give different scores"),
    ("victim", "forgetful", "counts for later", "memory, object", ON_THE_OBJECT),
    ("victim", "forgetful", "object", "memory, scores", ON_THE_OBJECT),
    ("victim", "forgetful", "in place", "memory, scores", "scores changed its state argument"),
    ("victim", "forgetful", "advances in place", "memory, scores", "advance changed its state argument"),
    ("victim", "forgetful", "places", "memory, subsets", "it gives different scores for the episodes [4] alone"),
    ("victim", "forgetful", "mixes", "memory, episodes", "create and advance it row by row"),
    ("victim", "forgetful", "dict", "memory", "initial returned a dict as the state: return TensorDict"),
    ("victim", "forgetful", "batch size", "memory", "the state of initial has batch size [], not [6]"),
    ("victim", "forgetful", "no initial", "memory", "advance returns a state, but initial returned None"),
    ("victim", "forgetful", "forgets", "memory", "advance returns None: return the state of the next step"),
    ("victim", "forgetful", "graph", "memory", "the state of advance carries a graph: detach"),
    ("victim", "forgetful", "draws", "memory", "initial returns two states for the same episodes"),
    ("attack", "grudge", "object", "memory, object", "not on the object"),
    ("attack", "grudge", "places", "memory, episodes", "depends on episodes that have ended"),
    ("attack", "grudge", "asks", "memory", "initial queried the victim: query it in step, where queries are counted"),
    ("attack", "grudge", "no initial", "memory", "step returns a state, but initial returned None"),
    ("attack", "grudge", "forgets", "memory", "step returns None as the state"),
    ("attack", "grudge", "grows", "memory", "step changed names, types or shapes in the state"),
    ("attack", "grudge", "alone", "memory", "step must return a tuple"),
    ("attack", "grudge", "dict", "memory", "initial returned a dict as the state: return TensorDict"),
    ("defense", "losing", "no initial", "memory of the victim", "initial returns None for a victim with a memory"),
    ("defense", "losing", "forgets", "memory of the victim", "the victim's memory has no effect"),
]


@pytest.fixture(autouse=True)
def bad_memory(plugins: Path) -> None:
    source = (PLUGINS / "bad_memory.py").read_text()
    install(plugins, "forgetful-pack", POINTS, {"bad_memory_plugin": source})


@pytest.mark.parametrize(("kind", "name", "rule", "check", "part"), RULES, ids=[f"{r[1]}-{r[2]}" for r in RULES])
def test_a_broken_rule_is_reported_with_its_fix(kind: Kind, name: str, rule: str, check: str, part: str) -> None:
    failed = {
        outcome.check: outcome.text for outcome in examine(kind, name, {"rule": rule}) if outcome.status == "fail"
    }
    assert part in failed[check]
    assert "\n" not in failed[check]


@pytest.mark.parametrize(
    ("kind", "name", "remark"),
    [
        ("victim", "forgetful", "its memory: seen"),
        ("attack", "grudge", "its memory: signs"),
        ("defense", "losing", "it has no memory"),
    ],
)
def test_a_memory_in_the_state_passes_and_is_named_in_the_remark(kind: Kind, name: str, remark: str) -> None:
    outcomes = list(examine(kind, name))
    assert [outcome for outcome in outcomes if outcome.status == "fail"] == []
    assert {outcome.check: outcome.text for outcome in outcomes}["memory"] == remark


def test_a_defence_is_checked_on_a_victim_with_a_memory() -> None:
    outcomes = {outcome.check: outcome for outcome in examine("defense", "losing", victim="forgetful")}
    assert {outcome.status for outcome in outcomes.values()} == {"pass"}
    assert outcomes["memory"].text == "its memory: seen"
