"""Plug-ins that bend the rules unseen: what they are given is their own, and what they remember ends with the unit."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import Said, ran
from tests.plugins.distributions import install, install_toy
from tests.tree import PLUGINS

CELL = ("world=toy", "lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0", "record=0", "reference=false")
PACKAGE = "of cavbench-bends 2.0"
OWN_COPY = ("none", "features", "threat", "observation", "parts", "harmless files")
"""Deeds that reach nothing but the attack's own copies: it scores as one that does nothing."""
FORGOTTEN = {
    "global": "bending.MEMORY.here",
    "list": "bending.SEEN",
    "tensor": "bending.COUNT",
    "environment": "the environment variable BENDS",
    "attribute": "bending.attributed.attribute here",
    "default": "bending.attributed.defaults.0",
}
"""Memories that end with the unit, and what the line about them names."""
REFUSED = {
    "self": "Bends._memo changed while it was measured",
    "own class": "bending.Bends.visits.here changed while it was measured",
    "world class": "features.low",
    "constant": "cavbench.driving.probes.EVERY was replaced",
}
"""Deeds that a unit is refused for."""
FILES = {
    "npz": "it wrote memo.npz while it was measured: a plug-in may keep no memory across units",
    "torch file": "it wrote memo.pt while",
    "temporary": "it wrote /tmp/bends-memo while",
    "package": "memo.txt while",
    "caught": "it wrote memo while",
    "shared": "it shared memory with other processes while",
    "reads": "it read kept.txt while",
}
"""Memories on disk that a unit is refused for."""
SILENT = ("cache", "itself once")
"""Caches of functions and properties are emptied without a word: honest plug-ins have them."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    install_toy(folder)
    points = {
        "cavbench.attacks": {"bends": "bending:Bends"},
        "cavbench.defenses": {"shrinks": "bending:Shrinks", "scribbles": "bending:Scribbles"},
    }
    install(folder, "cavbench-bends", points, {"bending": (PLUGINS / "bending.py").read_text()}, "2.0")
    return folder


@pytest.fixture(scope="module", params=["processes", "serial"])
def swept(request: pytest.FixtureRequest, site: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Said, Path]:
    """Every deed, two draws each, by one worker, and an honest attack after them."""
    out = tmp_path_factory.mktemp(f"swept_{request.param}_")
    deeds = [*OWN_COPY, *FORGOTTEN, *SILENT] if request.param == "serial" else ["none", "global", *REFUSED]
    listed = ",".join(f"'{deed}'" for deed in deeds)
    words = ("attack=bends,noise", f"attack.deed={listed}", "attack.draw=0,1", "victim=toy", "workers=1", *CELL)
    return ran(site, "run", *words, f"executor={request.param}", f"out={out}"), out


@pytest.mark.slow
def test_a_memory_on_disk_is_refused_and_not_written(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kept.txt").write_text("here")
    listed = ",".join(f"'{deed}'" for deed in FILES)
    words = ("attack=bends,noise", f"attack.deed={listed}", "victim=toy", *CELL, "executor=serial")
    said = ran(site, "run", *words, f"out={tmp_path / 'out'}")
    assert said.code == 2
    for deed, why in FILES.items():
        (line,) = {
            line for line in said.err.splitlines() if line.startswith("error: ") and f"bends(deed={deed})" in line
        }
        assert "is refused: " in line
        assert why in line
        assert PACKAGE in line
    assert {path.name for path in tmp_path.iterdir()} == {"kept.txt", "out"}
    assert not Path("/tmp/bends-memo").exists()
    assert set(reading.read(tmp_path / "out", track=track("driving"))["attack"].to_pylist()) == {"noise", "none"}


@pytest.mark.slow
def test_a_defence_that_writes_a_file_when_it_is_tried_is_refused_in_plain_words(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("attack=noise", "defense=scribbles", "victim=toy", *CELL, "executor=serial")
    said = ran(site, "run", *words, f"out={tmp_path / 'out'}")
    assert said.code == 2
    assert " is refused: it wrote memo while it was measured" in said.err
    assert PACKAGE in said.err
    assert not (tmp_path / "memo").exists()


def scores(out: Path) -> dict[tuple[str, str], list[float]]:
    """The scores of each attack with its parameters."""
    records = reading.read(out, track=track("driving"))
    found: dict[tuple[str, str], list[float]] = {}
    for row in records.select(["attack", "attack_params", "safe_progress", "linf_max"]).to_pylist():
        found.setdefault((row["attack"], row["attack_params"]), []).append(row["safe_progress"] + row["linf_max"])
    return found


@pytest.mark.slow
def test_nothing_that_a_deed_changes_or_remembers_reaches_a_score(swept: tuple[Said, Path]) -> None:
    said, out = swept
    of_deeds = {key[1]: values for key, values in scores(out).items() if key[0] == "bends"}
    assert len(of_deeds) == (4 if "processes" in str(out) else 2 * len({*OWN_COPY, *FORGOTTEN, *SILENT})), said.err
    draws = {draw: {tuple(values) for name, values in of_deeds.items() if f'"draw":{draw}' in name} for draw in (0, 1)}
    assert len(draws[0] | draws[1]) == 1


@pytest.mark.slow
def test_what_a_plugin_keeps_is_named(swept: tuple[Said, Path]) -> None:
    said, _ = swept
    for deed, what in FORGOTTEN.items():
        if f"deed={deed}" in said.err:
            assert f" kept {what} after a unit: it was put back, so that no unit depends on another" in said.err
    assert "cached" not in said.err


@pytest.mark.slow
def test_what_changes_a_component_or_the_framework_is_refused_and_named(swept: tuple[Said, Path]) -> None:
    said, out = swept
    if "serial" in str(out):
        assert said.code == 0
        return
    for deed, why in REFUSED.items():
        lines = [line for line in said.err.splitlines() if line.startswith("error: ") and f"deed={deed}" in line]
        assert lines, deed
        assert all("is refused: " in line and why in line and "cavbench-bends 2.0" in line for line in lines), lines


@pytest.fixture(scope="module")
def alone(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Records of the honest attack without the others."""
    out = tmp_path_factory.mktemp("alone")
    said = ran(site, "run", "attack=noise", "victim=toy", *CELL, "executor=serial", f"out={out}")
    assert said.code == 0, said.err
    return out


@pytest.mark.slow
def test_the_honest_unit_after_them_is_unharmed(alone: Path, swept: tuple[Said, Path]) -> None:
    expected, found = (
        {key: value for key, value in scores(folder).items() if key[0] in ("noise", "none")}
        for folder in (alone, swept[1])
    )
    assert all(found[key] == value for key, value in expected.items())


@pytest.mark.slow
def test_a_defence_that_changes_what_it_is_given_changes_nothing(site: Path, tmp_path: Path) -> None:
    deeds = "none,floors,ranges,axes,victim,kinematics"
    words = ("attack=nudge", "defense=shrinks", f"defense.deed={deeds}", "victim=toy", *CELL)
    said = ran(site, "run", *words, "executor=serial", f"out={tmp_path}")
    assert said.code == 0, said.err
    records = reading.read(tmp_path, track=track("driving"))
    for attack in ("nudge", "none"):
        own = records.filter(pc.equal(records["attack"], attack))
        by_deed = {
            name: measured(own.filter(pc.equal(own["defense_params"], name)))
            for name in set(own["defense_params"].to_pylist())
        }
        assert len(by_deed) == 6
        assert all(table.equals(next(iter(by_deed.values()))) for table in by_deed.values())


def measured(records: pa.Table) -> pa.Table:
    return records.select(["seed", "safe_progress", "return", "steps", "linf_max", "linf_m", "world_facts"])
