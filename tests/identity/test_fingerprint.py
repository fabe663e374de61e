"""The fingerprint of a unit changes with everything that determines its result, and with nothing else."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path

import pytest

from cavbench.identity import fingerprint
from cavbench.run.config import plan_of
from cavbench.run.unit import Unit

pytestmark = pytest.mark.usefixtures("toy_folder")

LINE = "attack=nudge victim=toy world=toy lanes=3 density=1 weather=clear episodes=4 seeds=0"


def first(*more: str) -> Unit:
    words = dict(word.split("=", 1) for word in [*LINE.split(), *more])
    return plan_of([f"{key}={value}" for key, value in words.items()]).units()[0]


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
    changed = plan_of(LINE.replace(word, other).split()).units()[0]
    assert changed.fingerprint != first().fingerprint


@pytest.mark.parametrize("more", ["workers=7", "out=elsewhere", "record=2", "reference=false"])
def test_options_that_cannot_change_a_result_keep_the_fingerprint(more: str) -> None:
    assert first(more).fingerprint == first().fingerprint


def test_other_weights_or_another_training_seed_are_another_unit() -> None:
    unit = first()
    assert replace(unit, weights_sha256="0" * 64).fingerprint != unit.fingerprint
    assert replace(unit, training_seed=1).fingerprint != unit.fingerprint
    assert unit.weights_sha256


def test_other_library_versions_are_another_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    before = first().fingerprint
    monkeypatch.setattr("cavbench.run.unit.libraries", lambda more: {"torch": "0.0"})
    assert first().fingerprint != before


def test_the_digest_covers_a_component_and_its_imports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "some_plugin"
    package.mkdir()
    files = {
        "__init__": "",
        "attack": "import json\nfrom some_plugin.loss import hinge\ndef f():\n    from . import late\n",
        "loss": "from .deep import a, b\n",
        "deep": "a = b = 1\n",
        "late": "",
        "unrelated": "",
    }
    for name, text in files.items():
        (package / f"{name}.py").write_text(text)

    def digest() -> str:
        fingerprint.code_digest.cache_clear()
        fingerprint._parsed.cache_clear()
        fingerprint._imports.cache_clear()
        return fingerprint.code_digest(("some_plugin.attack",))

    before = digest()
    assert digest() == before
    for name, text in files.items():
        (package / f"{name}.py").write_text(text + "changed = 1\n")
        assert (digest() == before) == (name == "unrelated"), name
        (package / f"{name}.py").write_text(text)
    assert digest() == before


def test_comments_docstrings_and_layout_outdate_no_record(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    module = tmp_path / "lone_plugin.py"

    def digest(text: str) -> str:
        module.write_text(text)
        fingerprint.code_digest.cache_clear()
        fingerprint._parsed.cache_clear()
        fingerprint._imports.cache_clear()
        return fingerprint.code_digest(("lone_plugin",))

    before = digest("def f(x):\n    return x + 1\n")
    assert (
        digest('"""A module."""\n\n\ndef f(x):\n    """One more."""\n    # why\n    return (x\n            + 1)\n')
        == before
    )
    assert digest("def f(x):\n    return x + 2\n") != before


def test_another_track_outdates_no_record() -> None:
    clean = first("attack=none", "victim=dqn", "world=highway")
    assert not [name for name in fingerprint.sources(clean.modules) if "detect" in name or "yolo" in name]


def test_the_code_digest_covers_only_the_code_that_computes_a_unit() -> None:
    counted = set(fingerprint.sources(first("world=highway", "attack=pgd", "victim=ddpg").modules))
    assert counted >= {
        *(
            f"cavbench.driving.{name}"
            for name in ("access", "contracts", "drive", "attacker", "meter", "metrics", "policy", "rollout", "threat")
        ),
        *(
            "cavbench.attacks.driving.pgd",
            "cavbench.attacks.driving.objectives",
            "cavbench.defenses.none",
            "cavbench.driving.victims.ddpg",
        ),
        *(
            "cavbench.envs.highway.world",
            "cavbench.envs.highway.batched",
            "cavbench.envs.highway.engine",
            "cavbench.envs.highway.sensor",
        ),
    }
    assert not counted & {
        "cavbench.attacks.driving.zo",
        "cavbench.driving.victims.dqn",
        "cavbench.records.store",
        "cavbench.cli.main",
        "cavbench.detection.approach",
        "cavbench.detection.crafting",
        "leaderboard",
    }


def test_every_module_excluded_from_the_digest_exists() -> None:
    for name in fingerprint.BESIDE_THE_RESULT:
        assert importlib.util.find_spec(f"cavbench.{name}"), f"{name} is gone: take it off the list"


def test_canonical_json_does_not_depend_on_the_order_of_keys() -> None:
    assert fingerprint.canonical({"b": (1, 2.0), "a": None}) == '{"a":null,"b":[1,2.0]}'
    assert fingerprint.digest({"b": 1, "a": 2}) == fingerprint.digest({"a": 2, "b": 1})
