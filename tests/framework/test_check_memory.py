"""`bench check` finds policies, attacks and defences that keep what they remember in the wrong place."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.conformance import examine
from bench.plugins.registry import Kind
from tests.framework.distributions import install

POINTS = {
    "cavbench.victims": {"forgetful": "bad_memory_plugin:Forgetful"},
    "cavbench.attacks": {"grudge": "bad_memory_plugin:Grudge"},
    "cavbench.defenses": {"losing": "bad_memory_plugin:Losing"},
}
ON_THE_OBJECT = "keep what it remembers in the state that initial and advance return, not on the object"
RULES: list[tuple[Kind, str, str, str, str]] = [
    ("victim", "forgetful", "counts", "determinism", "asked twice, it scores differently"),
    ("victim", "forgetful", "counts for later", "memory, object", ON_THE_OBJECT),
    ("victim", "forgetful", "object", "memory, scores", ON_THE_OBJECT),
    ("victim", "forgetful", "in place", "memory, scores", "scores changed the state it was given"),
    ("victim", "forgetful", "advances in place", "memory, scores", "advance changed the state it was given"),
    ("victim", "forgetful", "places", "memory, subsets", "asked about episodes [4] only, it scores differently"),
    ("victim", "forgetful", "mixes", "memory, episodes", "begin and advance it row by row"),
    ("victim", "forgetful", "dict", "memory", "initial returned a dict as the state: return TensorDict"),
    ("victim", "forgetful", "batch size", "memory", "the state of initial has batch size [], not [6]"),
    ("victim", "forgetful", "no initial", "memory", "advance returns a state, but initial gave None"),
    ("victim", "forgetful", "forgets", "memory", "advance returns None: return the state of the next step"),
    ("victim", "forgetful", "graph", "memory", "the state of advance carries a graph: detach"),
    ("victim", "forgetful", "draws", "memory", "initial gives two states for the same episodes"),
    ("attack", "grudge", "object", "memory, object", "not on the object"),
    ("attack", "grudge", "places", "memory, episodes", "changes with episodes that have ended"),
    ("attack", "grudge", "asks", "memory", "initial asked the victim: ask in step, where queries are counted"),
    ("attack", "grudge", "no initial", "memory", "step returns a state, but initial gave none"),
    ("attack", "grudge", "forgets", "memory", "step returns None as the state"),
    ("attack", "grudge", "grows", "memory", "step changed names, types or shapes in the state"),
    ("attack", "grudge", "alone", "memory", "step must return two things"),
    ("attack", "grudge", "dict", "memory", "initial returned a dict as the state: return TensorDict"),
    ("defense", "losing", "no initial", "memory of the victim", "initial gives None where the victim remembers"),
    ("defense", "losing", "forgets", "memory of the victim", "what the victim remembers makes no difference"),
]


@pytest.fixture(autouse=True)
def bad_memory(plugins: Path) -> None:
    source = Path(__file__).with_name("bad_memory.py").read_text()
    install(plugins, "forgetful-pack", POINTS, {"bad_memory_plugin": source})


@pytest.mark.parametrize(("kind", "name", "rule", "check", "part"), RULES, ids=[f"{r[1]}-{r[2]}" for r in RULES])
def test_a_broken_rule_is_found_and_what_to_do_is_said(kind: Kind, name: str, rule: str, check: str, part: str) -> None:
    failed = {
        outcome.check: outcome.text for outcome in examine(kind, name, {"rule": rule}) if outcome.status == "fail"
    }
    assert part in failed[check]
    assert "\n" not in failed[check]


@pytest.mark.parametrize(
    ("kind", "name", "remark"),
    [
        ("victim", "forgetful", "it remembers seen"),
        ("attack", "grudge", "it remembers signs"),
        ("defense", "losing", "it remembers nothing"),
    ],
)
def test_a_memory_in_the_right_place_passes_and_is_named(kind: Kind, name: str, remark: str) -> None:
    outcomes = list(examine(kind, name))
    assert [outcome for outcome in outcomes if outcome.status == "fail"] == []
    assert {outcome.check: outcome.text for outcome in outcomes}["memory"] == remark


def test_a_defence_is_tried_on_a_victim_with_a_memory_of_its_own() -> None:
    outcomes = {outcome.check: outcome for outcome in examine("defense", "losing", victim="forgetful")}
    assert {outcome.status for outcome in outcomes.values()} == {"pass"}
    assert outcomes["memory"].text == "it remembers seen"
