"""Outlines say of built-in components what the components say, without importing them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from cavbench.core import registry
from cavbench.core.outline import outline
from cavbench.core.parameters import description, flattened
from cavbench.core.registry import GROUPS, KINDS, OWN

BUILT_IN = [
    (kind, name)
    for kind in KINDS
    for name, claims in registry.entries(GROUPS[kind]).items()
    if claims[0].distribution == OWN and name != "art"
]
WRONG = (
    "attack=zo attack.stepz=3",
    "attack=zo attack.steps=abc",
    "attack=zo attack.steps=0",
    "attack=pgd attack.objective=hit",
    "attack=zo threat.budget=2",
    "attack=zo threat.norm=l2",
    "world.target_speeds=20,25,30",
    "victim=sac victim.hiden=3",
    "attack=eot victim=yolov5 defense=advtrain defense.skip=2",
)


@pytest.mark.parametrize(("kind", "name"), BUILT_IN)
def test_an_outline_is_what_the_component_declares(kind: registry.Kind, name: str) -> None:
    found, real = outline(kind, name), registry.load(kind, name)
    assert found is not None
    assert found is not real
    said = [
        {
            # A class within a hint is an outline itself.
            own: (one.type_name, one.default_text, one.required, one.allowed, one.meaning)
            for own, one in flattened(component).items()
        }
        for component in (found, real)
    ]
    assert list(said[0].items()) == list(said[1].items()), "the order of the parameters, too"
    assert description(found) == description(real)
    assert found.tracks() == real.tracks()
    for declared in ("access", "answers", "action_types", "grid"):
        assert getattr(found, declared, None) == getattr(real, declared, None)
    if kind == "victim":
        assert flattened(found.threat).keys() == flattened(real.threat).keys()


@pytest.mark.usefixtures("toy_folder")
def test_plug_ins_chains_and_adapters_have_none() -> None:
    assert outline("attack", "nudge") is None
    assert outline("defense", "tracker+shield") is None
    assert outline("attack", "art") is None
    assert outline("attack", "nothing") is None


def test_what_is_wrong_is_refused_and_described_without_torch() -> None:
    """One process for all: each line is refused before torch is imported, as it is after that."""
    command = (
        "import sys\nfrom cavbench.cli.main import main\n"
        f"for line in {WRONG!r}:\n"
        "    sys.argv = ['bench', 'run', *line.split()]\n"
        "    try:\n        main()\n    except SystemExit as ended:\n        print(line, ended.code, 'torch' in sys.modules)\n"
        "sys.argv = ['bench', 'list', 'zo']\n"
        "try:\n    main()\nexcept SystemExit:\n    print('listed', 'torch' in sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True)
    assert [line for line in done.stdout.splitlines() if line.startswith(("attack=", "world.", "victim="))] == [
        f"{line} 2 False" for line in WRONG
    ]
    assert done.stdout.splitlines()[-1] == "listed False"
    assert len(done.stderr.splitlines()) == len(WRONG)


@pytest.mark.parametrize("line", WRONG)
def test_the_early_refusal_is_the_one_of_the_component(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from cavbench.core.options import Options
    from cavbench.errors import UserError
    from cavbench.run.config import plan_of

    with pytest.raises(UserError) as early:
        plan_of(line.split())
    monkeypatch.setattr(Options, "check_outlines", lambda _: None)
    with pytest.raises(UserError) as late:
        plan_of(line.split())
    assert str(early.value) == str(late.value)


def test_a_source_that_is_more_than_declarations_is_imported_instead(tmp_path: Path) -> None:
    from cavbench.core.outline import UnclearError, _resolved

    (tmp_path / "cleverly.py").write_text("class A:\n    x: int = open('/etc/passwd').read()\n")
    sys.path.insert(0, str(tmp_path))
    try:
        with pytest.raises(UnclearError):
            _resolved("cleverly", "B")
    finally:
        sys.path.remove(str(tmp_path))
