"""A command with a bad plug-in ends with one line that names it; other components are not affected."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from cavbench.isolation.foreign import contained
from tests.checks.test_check import CROOKED, POINTS
from tests.cli.test_cli import assert_one_line
from tests.command import Said
from tests.plugins.distributions import install

Bench = Callable[..., Said]
RUN = (
    "lanes=3",
    "density=1",
    "weather=clear",
    "episodes=2",
    "seeds=0",
    "executor=serial",
    "record=0",
    "reference=false",
)
TOY = ("world=toy", *RUN)

HEAD = """
from dataclasses import dataclass
from typing import ClassVar
from cavbench.core.contracts import Access, Attack
from cavbench.driving import DrivingAttack
"""
GOOD = """
@dataclass(frozen=True, kw_only=True)
class Plugin(DrivingAttack):
    access: ClassVar[Access] = "oblivious"
    def perturb(self, observation, oracle):
        return observation
"""
CANNOT_BE_LOADED = {
    "a module that is not there": ("", "cannot be imported: ModuleNotFoundError"),
    "an error while it is imported": ("1 / 0\n", "cannot be imported: ZeroDivisionError: division by zero"),
    "a syntax error": ("def\n", "cannot be imported: SyntaxError"),
    "one that ends the program": ("import sys; sys.exit(3)\n", "cannot be imported: SystemExit: 3"),
    "no such class": ("class Other: ...\n", "cannot be imported: AttributeError"),
    "another base class": ("class Plugin: ...\n", "is not a subclass of cavbench.core.contracts.Attack"),
    "an instance": (f"{HEAD}{GOOD}Plugin = Plugin()\n", "is not a subclass of cavbench.core.contracts.Attack"),
    "another kind": (
        "from cavbench.driving.contracts import DrivingDefense\nclass Plugin(DrivingDefense): ...\n",
        "is not a subclass of cavbench.core.contracts.Attack",
    ),
    "no track": (f"{HEAD}{GOOD}".replace("(DrivingAttack)", "(Attack)"), "belongs to no track"),
    "an abstract method": (f"{HEAD}{GOOD}".replace("def perturb", "def disturb"), "does not implement perturb or step"),
    "no dataclass": (
        f"{HEAD}{GOOD}".replace("@dataclass(frozen=True, kw_only=True)", ""),
        "is not a frozen dataclass",
    ),
    "a mutable dataclass": (f"{HEAD}{GOOD}".replace("frozen=True, ", ""), "is not a frozen dataclass"),
    "no access": (
        f"{HEAD}{GOOD}".replace('    access: ClassVar[Access] = "oblivious"\n', ""),
        "must declare the access it needs: access: ClassVar[Access] = one of oblivious, decisions, scores, gradients",
    ),
    "an access that there is not": (
        f"{HEAD}{GOOD}".replace("oblivious", "everything"),
        "must declare the access it needs",
    ),
    "a type that is not there": (
        f"from __future__ import annotations\n{HEAD}{GOOD}    speed: Metres = 1\n",
        "the parameters of Plugin cannot be read: name 'Metres' is not defined",
    ),
    "a type of no word": (
        f"{HEAD}{GOOD}    shape: complex = 1j\n",
        "the parameters of attack 'wrong' cannot be set on the command line",
    ),
    "a check that fails itself": (
        f"{HEAD}{GOOD}    def __post_init__(self):\n        [][0]\n",
        "attack 'wrong' cannot be created: IndexError: list index out of range",
    ),
    "a default that is refused": (
        f"{HEAD}{GOOD}    def __post_init__(self):\n        raise ValueError('speed must be above 0')\n",
        "attack 'wrong': speed must be above 0",
    ),
}


@pytest.mark.parametrize("what", CANNOT_BE_LOADED)
def test_a_plugin_that_cannot_be_loaded_is_reported_and_breaks_no_other(
    bench: Bench, plugins: Path, tmp_path: Path, what: str
) -> None:
    source, part = CANNOT_BE_LOADED[what]
    module = f"broken_{list(CANNOT_BE_LOADED).index(what)}"
    modules = {module: source} if source else {}
    install(plugins, "broken-pack", {"cavbench.attacks": {"wrong": f"{module}:Plugin"}}, modules)
    words = ("attack.shape=2",) if "shape" in source else ()
    assert_one_line(bench("run", "attack=wrong", *words, "victim=toy", *TOY, f"out={tmp_path / 'out'}"), part)
    assert not (tmp_path / "out").exists()
    assert "wrong" in bench("list").out
    assert bench("list", "noise").code == 0


def test_a_name_shipped_by_two_packages_is_reported_with_both(bench: Bench, plugins: Path, tmp_path: Path) -> None:
    install(plugins, "rival", {"cavbench.attacks": {"noise": "rival:Plugin"}}, {"rival": HEAD + GOOD})
    for command in (
        ("run", "attack=noise", "victim=toy", *TOY, f"out={tmp_path}"),
        ("list", "noise"),
        ("check", "noise"),
    ):
        assert_one_line(bench(*command), "'noise' is shipped by cavbench", "and by rival 1.0; uninstall one")
    listed = bench("list")
    assert listed.code == 0
    assert "and by rival 1.0; uninstall one" in listed.out


FAILS_AT_WORK = {
    (
        "attack=crooked",
        "attack.rule=shape",
    ): "Crooked.perturb returned shape (2, 2, 2), not a torch.Tensor of shape (2, 2, 3)",
    (
        "attack=crooked",
        "attack.rule=nothing",
    ): "Crooked.perturb returned a NoneType, not a torch.Tensor of shape (2, 2, 3)",
    ("attack=crooked", "attack.rule=nan"): "Crooked.perturb returned numbers that are NaN or infinite",
    ("attack=crooked", "attack.rule=raise"): "ZeroDivisionError: at a loss (--debug shows the traceback)",
    ("attack=crooked", "attack.rule=access"): "the attack used access 'gradients', but declares only 'scores'",
    (
        "attack=crooked",
        "attack.rule=greedy",
        "threat.queries=2",
    ): "asked for 3 queries in a step, the threat model allows 2",
    (
        "attack=crooked",
        "threat.access=oblivious",
    ): "attack 'crooked' needs access 'scores', but the threat model allows",
    ("victim=bad", "victim.rule=nothing"): "bad(rule=nothing) loads a NoneType, but a Policy is needed",
    ("victim=bad", "victim.rule=raise"): "bad(rule=raise) cannot be loaded: ZeroDivisionError: at a loss",
}


@pytest.mark.parametrize("words", FAILS_AT_WORK, ids=" ".join)
def test_a_plugin_that_fails_in_a_run_is_reported_and_other_records_are_kept(
    bench: Bench, plugins: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    install(plugins, "crooked-pack", POINTS, {"crooked": CROOKED})
    assert bench("run", "attack=nudge", "victim=toy", *TOY, f"out={tmp_path}").code == 0
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*.parquet")}
    victim = () if any(word.startswith("victim") for word in words) else ("victim=toy",)
    said = bench("run", *words, *victim, *TOY, f"out={tmp_path}")
    assert said.code != 0
    assert said.err.strip().splitlines()[-1].startswith("error: ")
    assert FAILS_AT_WORK[words] in said.err
    assert "Traceback" not in said.err
    assert all(path.read_bytes() == blob for path, blob in kept.items())


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs os.fork")
def test_a_copy_of_the_process_ends_where_foreign_code_ends() -> None:
    with contained():
        copy = os.fork()
    if not copy:
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(copy, 0)[1]) == 1
