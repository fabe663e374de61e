"""`config=study.yaml`: a file stands for the words of a run, and a results folder has the file that repeats it."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.errors import UserError
from cavbench.run import config_file
from cavbench.run.config import plan_of
from cavbench.run.config_file import expanded, read, write
from tests.command import Bench

pytestmark = pytest.mark.usefixtures("toy_folder")


def made(folder: Path, **texts: str) -> Path:
    """The files of a composition; the path of the last."""
    for name, text in texts.items():
        path = folder / f"{name.replace('__', '/')}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return path


def test_a_file_is_the_words_that_it_says(tmp_path: Path) -> None:
    text = "attack: [zo, noise]\nattack.steps: 20\nthreat: {budget: 0.2}\nlanes: [3, 4]\nreference: false\nseeds: 0,1\n"
    words = ["attack=zo,noise", "attack.steps=20", "threat.budget=0.2", "lanes=3,4", "reference=false", "seeds=0,1"]
    plan = plan_of([f"config={made(tmp_path, study=text)}"])
    same = plan_of(words)
    assert [pair.id for pair in plan.pairs] == [pair.id for pair in same.pairs]
    assert (plan.grid, plan.seeds, plan.reference) == (same.grid, same.seeds, same.reference)


def test_hydra_composes_the_defaults_and_typed_words_come_last(tmp_path: Path) -> None:
    path = made(
        tmp_path,
        base="attack: zo\nlanes: [3, 4]\nthreat.access: scores\n",
        threat__strong="budget: 0.3\n",
        study="defaults:\n  - base\n  - threat: strong\n  - _self_\nlanes: 5\n",
    )
    assert read(path) == {"attack": "zo", "lanes": "5", "threat.access": "scores", "threat.budget": "0.3"}
    assert sorted(expanded([f"config={path}", "attack=pgd"])) == [
        "attack=pgd",
        "lanes=5",
        "threat.access=scores",
        "threat.budget=0.3",
    ]


def test_a_path_with_spaces_and_signs_is_read(tmp_path: Path) -> None:
    assert read(made(tmp_path / "a b=c", **{"my study.v2": "attack: zo\n"})) == {"attack": "zo"}


@pytest.mark.parametrize(
    ("written", "read_as"),
    [
        ("010", "8"),
        ("0x10", "16"),
        ("0b11", "3"),
        ("1:30", "90"),
        ("1:30.5", "90.5"),
        ("0_.", "0.0"),
        ("no", "false"),
        ("On", "true"),
    ],
)
def test_a_value_that_yaml_takes_for_another_is_refused(tmp_path: Path, written: str, read_as: str) -> None:
    path = made(tmp_path, study=f"attack: noise\nepisodes: {written}\n")
    with pytest.raises(
        UserError,
        match=f"YAML reads {re.escape(written)} as {re.escape(read_as)}; write that, or '{re.escape(written)}'",
    ):
        expanded([f"config={path}"])
    quoted = made(tmp_path, study=f"attack: noise\nepisodes: '{written}'\n")
    assert read(quoted)["episodes"] == written, "what stands in quotes is what is typed"


@given(
    st.one_of(
        st.integers(), st.floats(allow_nan=False), st.booleans(), st.from_regex(r"[0-9_:.+xob-]{1,6}", fullmatch=True)
    )
)
@settings(max_examples=200, deadline=None)
def test_a_value_of_a_file_is_the_number_that_is_typed(value: object) -> None:
    text = str(value)
    try:
        config_file._check_events(f"episodes: {text}\n", Path("study.yaml"))
        found = yaml.safe_load(f"episodes: {text}\n")["episodes"]
    except (UserError, yaml.YAMLError, TypeError, ValueError):
        return
    if isinstance(found, (int, float)) and not isinstance(found, bool):
        assert float(text) == float(found)


BOMB = "a: &a [x, x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (BOMB, "anchors or aliases"),
        ("attack: !!python/object/apply:os.system [true]\n", "tag"),
        ("attack: ${oc.env:HOME}\n", "plain text"),
        ("a: " + "[" * 50 + "]" * 50, "deeper than 8"),
        ("a: [" + "x," * 6000 + "x]", "more than 5000"),
        ("# " + "x" * 60_000, "at most 50.0 kB"),
        ("attack: zo\n---\nattack: pgd\n", "more than one document"),
        ("attack: zo\nattack: pgd\n", "duplicate key"),
        ("attack: zo\nthreat.budget: 0.1\nthreat: {budget: 0.2}\n", "threat.budget twice"),
        ("defaults: [../other]\n", "defaults list takes"),
        ("defaults: [/etc/passwd]\n", "defaults list takes"),
        ("defaults: [gone]\n", "gone.yaml cannot be read"),
        ("defaults: [study]\nattack: zo\n", "names itself"),
        ("attack:\n", "has no value"),
        ("world.target_speeds: [[20, 25]]\n", "in quotes"),
        ("config: other.yaml\n", "defaults list"),
        ("hydra: {run: {dir: /tmp}}\nattack: zo\n", "key hydra"),
        ("just text", "has no keys"),
        ("a: [", "no YAML"),
        ("\x00", "no YAML"),
        ("attak: zo\n", "did you mean 'attack'"),
        ("attack.stepz: 3\nattack: zo\n", "did you mean 'steps'"),
    ],
)
def test_a_file_that_is_none_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(UserError, match=said) as refused:
        plan_of([f"config={made(tmp_path, study=text)}"])
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("named", ["", "gone.yaml", "study.txt", "."])
def test_what_is_no_file_of_a_run_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str) -> None:
    monkeypatch.chdir(tmp_path)
    Path("study.txt").write_text("attack: zo\n")
    with pytest.raises(UserError):
        plan_of([f"config={named}"])


def test_a_pipe_does_not_hold_the_command(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "study.yaml")
    with pytest.raises(UserError, match="a pipe"):
        read(tmp_path / "study.yaml")


VALUES = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1, max_size=20).filter(
    lambda text: "${" not in text
)


@settings(max_examples=15, deadline=None)
@given(
    words=st.dictionaries(st.from_regex(r"[a-z]{1,8}(\.[a-z]{1,8})?", fullmatch=True), VALUES, min_size=1, max_size=5)
)
def test_what_is_written_is_read_again(words: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> None:
    heads = [key.partition(".")[0] for key in words]
    if "config" in words or {"hydra", "defaults"} & set(heads):
        return
    assert read(write(tmp_path_factory.mktemp("out"), words)) == words


def test_a_folder_alone_repeats_its_run(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    short = (
        "attack=noise",
        "lanes=3",
        "density=1",
        "weather=clear",
        "episodes=1",
        "reference=false",
        "executor=serial",
    )
    first = bench("run", *short, "seeds=0", "attack.scale=0.5", "out=first")
    (file,) = Path("first/runs").iterdir()
    assert 'grid: "standard-v2"' in file.read_text()
    again = bench("run", "config=first", "out=second")
    assert (first.code, again.code) == (0, 0)
    # All but the times.
    assert [line.split()[:4] for line in again.out.splitlines()[:6]] == [
        line.split()[:4] for line in first.out.splitlines()[:6]
    ]
    units = [sorted(path.name for path in Path(folder, "episodes").iterdir()) for folder in ("first", "second")]
    assert units[0] == units[1]


def test_the_same_words_have_one_file_and_a_folder_of_two_runs_asks_for_one(tmp_path: Path) -> None:
    words = {"attack": "zo", "victim": "dqn"}
    assert write(tmp_path, words) == write(tmp_path, dict(reversed(words.items())))
    other = write(tmp_path, words | {"episodes": "3"})
    with pytest.raises(UserError, match=f"has 2 runs: .*{other.name}"):
        plan_of([f"config={tmp_path}"])


def test_how_a_run_is_carried_out_is_not_in_its_file() -> None:
    words = ["attack=noise", "lanes=3", "episodes=1"]
    plans = [
        plan_of([*words, *how]) for how in ([], ["executor=serial"], ["workers=1", "unit_timeout=60", "junit=x.xml"])
    ]
    assert plans[0].words == plans[1].words == plans[2].words
    assert plan_of([*words, "device=cpu"]).words["device"] == "cpu"


def test_the_limits_are_what_the_page_says() -> None:
    assert (config_file.MOST_BYTES, config_file.DEEPEST, config_file.MOST_FILES) == (50_000, 8, 20)
