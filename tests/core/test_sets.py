"""The sets of a threat model: empty by default, checked in one line, and the same after a record."""

from __future__ import annotations

from typing import Any

import pytest

from cavbench.core import sets
from cavbench.core.options import Options
from cavbench.detection.threat import PatchThreat
from cavbench.driving.threat import ObservationThreat
from cavbench.errors import UserError
from cavbench.identity.fingerprint import canonical
from cavbench.run.options import RunOptions

EVERY: dict[str, dict[str, Any]] = {
    "presence": {"hidden": 2, "invented": 1, "share": 0.01},
    "latency": {"frames": 4},
    "held": {"share": 0.1, "longest": 15},
    "actuator": {"delay": 1, "offset": 0.1, "noise": 0.05, "replaced": 1e-07},
    "traffic": {"cars": 1, "gap": 2.5},
    "dynamics": {"time_gap": 0.5},
}


def test_without_sets_a_threat_model_is_written_as_before_there_were_any() -> None:
    assert canonical(ObservationThreat().written) == (
        '{"access":"gradients","budget":0.1,"norm":"relative","queries":1000,"share":1.0}'
    )
    assert ObservationThreat().columns == {
        "threat_norm": "relative",
        "threat_budget": 0.1,
        "threat_access": "gradients",
        "threat_queries": 1000,
        "threat_share": 1.0,
    }


@pytest.mark.parametrize("names", [["presence"], ["latency", "held"], list(EVERY)])
def test_a_record_gives_the_same_sets_back(names: list[str]) -> None:
    threat = ObservationThreat(norm="linf", **{name: EVERY[name] for name in names})  # type: ignore[arg-type]
    columns = threat.columns
    assert columns.keys() == ObservationThreat().columns.keys()
    assert sets.split(columns["threat_norm"])[0] == "linf"
    assert ObservationThreat.recorded(columns) == threat
    assert canonical(threat.written) != canonical(ObservationThreat(norm="linf").written)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"presence": {"hiden": 1}}, "threat.presence.hiden is unknown: presence has hidden, invented, share"),
        ({"presence": {"share": 0.5}}, "threat.presence.share alone allows nothing: give hidden or invented, too"),
        ({"latency": {"frames": 1.5}}, "threat.latency.frames must be a whole number, got 1.5"),
        ({"latency": {"frames": -1}}, "threat.latency.frames must be between 0 and 450, got -1"),
        ({"held": {"share": 0.1}}, "threat.held.longest is 0, so nothing may be held: give both share and longest"),
        ({"actuator": {"replaced": 2.0}}, "threat.actuator.replaced must be between 0 and 1, got 2.0"),
        ({"traffic": {"gap": 4.0}}, "threat.traffic.cars is 0, so the attacker drives nobody: give cars, too"),
        ({"held": 3}, "threat.held takes held.share, held.longest, got 3"),
    ],
)
def test_a_set_that_makes_no_sense_is_refused_in_one_line(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError) as refused:
        ObservationThreat(**given)
    assert str(refused.value) == line


def test_the_command_line_sweeps_fields_of_sets() -> None:
    words = ["attack=noise", "threat.latency.frames=1,2", "threat.presence.hidden=1"]
    found: Any = Options(
        words, kinds=("attack", "defense", "victim", "world"), settings=RunOptions, axes=("lanes",)
    ).threats()
    assert [one.latency.frames for one in found] == [1, 2]
    assert {one.presence.hidden for one in found} == {1}


@pytest.mark.parametrize("word", ["threat.presence.hiden=1", "threat.presence=1", "threat.latency.frames=some"])
def test_the_command_line_refuses_what_no_set_has(word: str) -> None:
    with pytest.raises(UserError) as refused:
        Options([word], kinds=("attack", "defense", "victim", "world"), settings=RunOptions, axes=("lanes",)).threats()
    assert len(str(refused.value).splitlines()) == 1


def test_a_mark_is_recorded_where_it_is_off_its_default_and_only_there() -> None:
    usual, known = PatchThreat(), PatchThreat(knows="site")
    assert usual.columns["threat_norm"] == "patch"
    assert canonical(usual.written) == canonical(
        {"norm": "patch", "budget": 0.5, "access": "gradients", "queries": 20_000}
    )
    assert known.columns.keys() == usual.columns.keys()
    assert known.columns["threat_norm"] == "patch+knows=site"
    assert sets.split("patch+knows=site")[0] == "patch"
    for threat in (usual, known):
        assert PatchThreat.recorded(threat.columns) == threat
    assert sets.allows(known, "knows=site")
    assert not sets.allows(usual, "knows=site")


@pytest.mark.parametrize("text", ["patch+knows=everything", "patch+nose=long", "patch+knows=site+knows"])
def test_a_record_with_a_mark_that_is_not_allowed_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        PatchThreat.recorded(PatchThreat().columns | {"threat_norm": text})


@pytest.mark.parametrize("text", ["relative+", "relative+presence", "relative+presence.hidden=<b>", "rel ative", ""])
def test_a_text_that_is_no_set_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no perturbation set"):
        sets.split(text)
