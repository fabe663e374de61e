"""Suites of attacks: versioned data that expands to ordinary pairs."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavbench.core import suites
from cavbench.core.suites import Suite
from cavbench.errors import UserError
from cavbench.run.config import plan_of

SMALL = ["lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0"]


def test_the_newest_version_is_meant_by_the_plain_name() -> None:
    assert suites.suite("standard") is suites.suite("standard-2")
    assert {"standard", "standard-2"} <= set(suites.names())
    with pytest.raises(UserError, match="unknown suite 'standard-9'"):
        suites.suite("standard-9")


@pytest.mark.parametrize(("victim", "actions"), [("dqn", "discrete"), ("ddpg", "continuous")])
def test_a_suite_expands_to_the_members_meant_for_the_victim(victim: str, actions: str) -> None:
    config = plan_of(["attack=standard", f"victim={victim}", *SMALL])
    meant = [m for m in suites.suite("standard").members if m.victims.get("action_type", actions) == actions]
    assert [pair.attack for pair in config.pairs] == [member.chosen for member in meant]
    assert len({pair.id for pair in config.pairs}) == len(meant) >= 11
    assert {pair.threat.access for pair in config.pairs} == {"dynamics"}
    assert not config.skipped


def test_each_track_has_its_standard() -> None:
    config = plan_of(["attack=standard", "victim=yolov5", "weather=clear", "lanes=3", "density=1", "seeds=0"])
    assert [pair.attack for pair in config.pairs] == [
        one.chosen for one in suites.suite("standard-detection-3").members
    ]
    assert {pair.threat.access for pair in config.pairs} == {"gradients"}


def test_a_member_is_the_pair_that_its_own_options_make() -> None:
    words = ["attack=pgd", "attack.objective=target", "attack.target_action=4", "threat.access=dynamics", *SMALL]
    (alone,) = plan_of(words).pairs
    assert alone.id in {pair.id for pair in plan_of(["attack=standard-2", *SMALL]).pairs}


def test_members_above_the_threat_model_are_skipped_with_a_line() -> None:
    config = plan_of(["attack=standard", "threat.access=scores", *SMALL])
    assert [pair.attack.name for pair in config.pairs] == ["pessimist", "zo", "noise"]
    assert len(config.skipped) == 9
    assert any(line.startswith("standard-2 skips plan: attack 'plan' needs access") for line in config.skipped)
    # The same attack chosen by its name is refused.
    with pytest.raises(UserError, match="attack 'plan' needs access 'dynamics'"):
        plan_of(["attack=plan", "threat.access=scores", *SMALL])


def test_a_suite_and_attacks_by_name_can_be_mixed() -> None:
    config = plan_of(["attack=bias,standard,zo", "attack.scale=0.5", *SMALL])
    assert [pair.attack.name for pair in config.pairs].count("zo") == 1
    assert config.pairs[0].attack.component.scale == 0.5  # type: ignore[attr-defined]


def test_what_cannot_be_is_refused_in_one_line() -> None:
    with pytest.raises(UserError, match=r"suite standard-2 have fixed parameters, got attack\.steps"):
        plan_of(["attack=standard", "attack.steps=3", *SMALL])
    with pytest.raises(UserError, match="suite 'standard-2' is for the driving track; suites for the detection track"):
        plan_of(["attack=standard-2", "victim=yolov5"])


def test_a_file_that_is_no_suite_is_refused_in_one_line(tmp_path: Path) -> None:
    head = 'track = "driving"\nmeaning = "m"\naccess = "scores"\n'
    for name, text, why in (
        ("a-1.toml", "track = ", "is not a suite"),
        ("a-1.toml", head, "and members"),
        ("a.toml", head + '[[member]]\nattack = "zo"\n', "a name that ends in -VERSION"),
        ("a-1.toml", head + '[[member]]\nattak = "zo"\n', "attak"),
    ):
        path = tmp_path / name
        path.write_text(text)
        with pytest.raises(ValueError, match=why) as error:
            Suite.read(path)
        assert "\n" not in str(error.value)


def test_another_draw_is_the_same_attack_with_other_random_numbers() -> None:

    config = plan_of(["attack=noise", "attack.draw=0,1", "reference=false", *SMALL])
    seeds = {unit.pair.attack.component.draw: unit.attack_seed for unit in config.units() if not unit.pair.is_clean}  # type: ignore[attr-defined]
    assert len(set(seeds.values())) == 2


def test_the_command_line_lists_and_helps_with_suites(capsys: pytest.CaptureFixture[str]) -> None:
    from typer.testing import CliRunner

    from cavbench.cli.main import app

    listed, page, helped = (
        CliRunner().invoke(app, words).output for words in (["list"], ["list", "standard"], ["run", "--help"])
    )
    assert "standard-2" in listed
    assert "suite standard-2" in page
    assert "oblivious and" in page
    assert "standard-2" in helped


@pytest.mark.slow
def test_a_suite_runs_end_to_end(tmp_path: Path) -> None:
    """Members are recorded as ordinary pairs, skipped ones are named, and `bench show` counts them."""
    from rich.console import Console

    from cavbench.cli.run import run
    from cavbench.cli.show import print_run
    from cavbench.records import reading

    words = [
        "attack=standard",
        "threat.access=oblivious",
        "threat.share=0.1",
        "reference=false",
        "executor=serial",
        *SMALL,
    ]
    console = Console(record=True, width=120)
    run(plan_of([*words, f"out={tmp_path}", "world.max_steps=20"]), console, lambda track, table: None)
    records = reading.read_all(tmp_path)["driving"]
    assert set(records["attack"].to_pylist()) == {"none", "pessimist", "noise"}
    shares = {(row["attack"], row["threat_share"]) for row in records.to_pylist()}
    assert shares == {("none", 1.0), ("pessimist", 0.1), ("noise", 0.1)}
    print_run(str(tmp_path), tmp_path, console, lambda track, table: None)
    text = console.export_text()
    assert "standard-2: 2 of 17 members" in text
    assert "10 % of the frames" in text
