"""Components are found by entry points only; a broken plug-in is reported and breaks no other."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from cavbench.core import registry
from cavbench.core.contracts import Attack, Defense, Victim, World
from cavbench.core.registry import GROUPS, KINDS
from cavbench.errors import UserError
from cavbench.run.config import plan_of
from tests.command import BENCH
from tests.plugins.distributions import TOY_POINTS, install, install_toy

BASES = {"attack": Attack, "defense": Defense, "victim": Victim, "world": World}


@pytest.mark.parametrize("kind", KINDS)
def test_every_built_in_component_loads_by_its_name(kind: registry.Kind) -> None:
    own = [name for name, claims in registry.entries(GROUPS[kind]).items() if claims[0].distribution == "cavbench"]
    assert own
    for name in own:
        assert issubclass(registry.declared(kind, name), BASES[kind])


def test_a_plugin_is_found_like_a_built_in(plugins: Path) -> None:
    install_toy(plugins)
    for kind in KINDS:
        for name in TOY_POINTS[GROUPS[kind]]:
            assert name in registry.names(kind)
            assert registry.find(GROUPS[kind], name, kind).shipped_by == "cavbench-toy 1.0"
            assert issubclass(registry.load(kind, name), BASES[kind])


def test_an_unknown_name_is_reported_with_the_nearest_and_all_known_names() -> None:
    with pytest.raises(UserError, match=r"unknown attack 'nois'; did you mean 'noise'\? known: .*noise.*pgd"):
        registry.load("attack", "nois")


BROKEN = {
    "cannot be imported: ZeroDivisionError": "1 / 0\n",
    "is not a subclass of cavbench.core.contracts.Attack": "class Plugin: ...\n",
    "cannot be imported: AttributeError": "class Other: ...\n",
    "belongs to no track: derive it from a base class of": (
        "from dataclasses import dataclass\nfrom cavbench.core.contracts import Attack\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Plugin(Attack): ...\n"
    ),
    "does not implement perturb or step": (
        "from dataclasses import dataclass\nfrom cavbench.driving.contracts import DrivingAttack\n"
        "@dataclass(frozen=True, kw_only=True)\nclass Plugin(DrivingAttack): ...\n"
    ),
    "is not a frozen dataclass": (
        "from cavbench.driving.contracts import DrivingAttack\n"
        "class Plugin(DrivingAttack):\n    def perturb(self, observation, oracle): ...\n"
    ),
    "has the positional parameters steps": (
        "from dataclasses import dataclass\nfrom cavbench.driving.contracts import DrivingAttack\n"
        "@dataclass(frozen=True)\nclass Plugin(DrivingAttack):\n    steps: int = 1\n    def perturb(self, o, oracle): ...\n"
    ),
}


@pytest.mark.parametrize("complaint", BROKEN)
def test_a_broken_plugin_is_named_in_one_line_and_breaks_no_other(complaint: str, plugins: Path) -> None:
    module = f"broken_{abs(hash(complaint))}"
    install(plugins, "broken-pack", {"cavbench.attacks": {"wrong": f"{module}:Plugin"}}, {module: BROKEN[complaint]})
    with pytest.raises(UserError) as raised:
        registry.load("attack", "wrong")
    message = str(raised.value)
    assert complaint in message
    assert "broken-pack 1.0" in message
    assert "\n" not in message
    assert "wrong" in registry.names("attack")
    registry.load("attack", "noise")


def test_a_broken_grid_is_reported_when_it_is_used_and_breaks_no_other(plugins: Path) -> None:
    points = {
        "cavbench.grids": {"rough-v1": "rough:GRID"},
        "cavbench.worlds": {"rough": "cavbench.envs.highway.world:HighwayWorld"},
    }
    install(plugins, "rough-pack", points, {"rough": "1 / 0\n"})
    assert plan_of(["victim=blind"]).grid.name == "standard-v2"
    with pytest.raises(UserError, match=r"grid 'rough-v1' .* cannot be imported: ZeroDivisionError"):
        plan_of(["victim=blind", "world=rough", "grid=rough-v1"])


def test_a_name_that_two_packages_ship_is_refused_with_both_packages(plugins: Path) -> None:
    install(plugins, "rival", {"cavbench.attacks": {"noise": "rival:Noise"}}, {"rival": ""})
    with pytest.raises(UserError, match=r"'noise' is shipped by cavbench .* and by rival 1.0; uninstall one"):
        registry.load("attack", "noise")
    registry.load("attack", "none")


def test_listing_names_imports_no_torch() -> None:
    code = (
        "import sys; from cavbench.cli import main as cli; sys.argv = ['bench', 'list']\n"
        "try: cli.main()\nexcept SystemExit: pass\n"
        "heavy = {'torch', 'hydra', 'numpy', 'duckdb', 'cavbench.attacks.driving.noise'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    for name in ("noise", "none", "dqn", "idm", "highway"):
        assert name in ended.stdout


def test_listing_names_costs_little_more_than_a_command_line_that_does_nothing() -> None:
    """Listing takes about 0.5 s; compared with a command of the same library, because machines are not idle."""

    def cpu_seconds(*command: str) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    imports = "import importlib.metadata, rich.console, rich.table, typer"
    does_nothing = f"{imports}\ndef nothing(name: str = ''): pass\ntyper.run(nothing)"
    nothing = (sys.executable, "-c", does_nothing)
    pairs = [(cpu_seconds(*BENCH, "list"), cpu_seconds(*nothing)) for _ in range(4)]
    listing, idle = (min(seconds) for seconds in zip(*pairs, strict=True))
    assert listing < 3 * idle, f"{listing:.2f} s against {idle:.2f} s"
