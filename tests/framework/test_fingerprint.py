"""The fingerprint of a unit changes with everything that decides its result, and with nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench import fingerprint
from bench.config import run_config
from bench.plan import plan
from bench.unit import Unit

pytestmark = pytest.mark.usefixtures("toy_folder")

LINE = "attack=nudge victim=toy world=toy lanes=3 density=1 weather=clear episodes=4 seeds=0"


def first(*more: str) -> Unit:
    return plan(run_config([*LINE.split(), *more]))[0]


@pytest.mark.parametrize(
    "more",
    ["attack.scale=0.5", "victim.actions=continuous", "world.max_steps=9", "threat.budget=0.2", "threat.queries=5"],
)
def test_a_changed_parameter_is_another_unit(more: str) -> None:
    assert first(more).fingerprint != first().fingerprint


@pytest.mark.parametrize(
    ("word", "other"),
    [
        ("lanes=3", "lanes=4"),
        ("density=1", "density=2"),
        ("weather=clear", "weather=fog"),
        ("episodes=4", "episodes=5"),
    ],
)
def test_a_changed_scenario_is_another_unit(word: str, other: str) -> None:
    changed = plan(run_config(LINE.replace(word, other).split()))[0]
    assert changed.fingerprint != first().fingerprint


@pytest.mark.parametrize("more", ["workers=7", "out=elsewhere", "record=2", "reference=false"])
def test_what_cannot_change_a_result_is_the_same_unit(more: str) -> None:
    assert first(more).fingerprint == first().fingerprint


def test_other_weights_or_another_training_seed_are_another_unit() -> None:
    unit = first()
    assert replace(unit, weights_sha256="0" * 64).fingerprint != unit.fingerprint
    assert replace(unit, training_seed=1).fingerprint != unit.fingerprint
    assert unit.weights_sha256


def test_other_library_versions_are_another_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    unit = first()
    before = unit.fingerprint
    monkeypatch.setattr("bench.unit.libraries", lambda: {"torch": "0.0"})
    assert unit.fingerprint != before


def test_the_source_of_a_plugin_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "some_plugin"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "attack.py").write_text("a = 1\n")
    before = fingerprint.source_digest("some_plugin")
    fingerprint.source_digest.cache_clear()
    assert fingerprint.source_digest("some_plugin") == before
    fingerprint.source_digest.cache_clear()
    (package / "attack.py").write_text("a = 2\n")
    assert fingerprint.source_digest("some_plugin") != before
    fingerprint.source_digest.cache_clear()


def test_every_file_of_the_framework_either_counts_or_is_named_as_beside_the_result() -> None:
    root = Path(fingerprint.__file__).parent
    counted = {path.name for path in root.glob("*.py") if not path.name.startswith(fingerprint.BESIDE_THE_RESULT)}
    assert counted >= {"contracts.py", "pipeline.py", "rollout.py", "scenario.py", "threat.py", "unit.py"}
    for prefix in fingerprint.BESIDE_THE_RESULT:
        assert any(path.name.startswith(prefix) for path in root.iterdir()), f"{prefix} is gone: take it off the list"


def test_canonical_json_does_not_depend_on_the_order_of_keys() -> None:
    assert fingerprint.canonical({"b": (1, 2.0), "a": None}) == '{"a":null,"b":[1,2.0]}'
    assert fingerprint.digest({"b": 1, "a": 2}) == fingerprint.digest({"a": 2, "b": 1})
