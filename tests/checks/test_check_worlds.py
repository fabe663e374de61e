"""`bench check` of worlds: any axes and any number of actions pass; worlds that a run cannot use fail."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from torch import Tensor

from cavbench.checks import examine
from cavbench.checks.check import BrokenRuleError, NotApplicableError, Subject
from cavbench.core.track import track
from cavbench.detection import Decoy, Scenes
from cavbench.detection.checks.camera import CameraSuite
from tests.command import Bench
from tests.plugins.distributions import install
from tests.plugins.toy_camera import GREEN, RedScenes, RedStreet
from tests.run.test_third_track import POINTS as LISTENING
from tests.tree import PLUGINS

BAD = (
    *(
        "nameless",
        "taken",
        "silent",
        "defaulted",
        "gridless",
        "borrowing",
        "otheraxes",
        "lying",
        "general",
        "unwritten",
    ),
    *("timeless", "miscounted", "driverless", "choosy", "refusing"),
)
POINTS = {
    "cavbench.worlds": {name: f"bad_worlds_plugin:{name.capitalize()}" for name in BAD},
    "cavbench.grids": {
        f"{name}-v1": f"bad_worlds_plugin:{name.upper()}_V1" for name in BAD if name not in ("gridless", "borrowing")
    },
}
RULES = {
    "nameless": ("axes", "the axis 'the gap' cannot be written as NAME=VALUE"),
    "taken": ("axes", "the axis 'seeds' has the name of an option of `bench run`: rename it"),
    "silent": ("axes", "the axis 'gap' has no meaning: add a short description"),
    "defaulted": ("axes", "the axis 'gap' does not allow its own value"),
    "gridless": ("grids", "register its grid as an entry point in cavbench.grids"),
    "borrowing": ("grids", "the grid 'standard-v2' belongs to the world 'highway'"),
    "otheraxes": ("grids", "use the same Axes object for both"),
    "lying": ("facts", "facts.axes differ from the world's axes"),
    "general": ("features", "facts is a Facts, not a cavbench.driving.DrivingFacts"),
    "unwritten": ("facts", "facts.written() must contain plain JSON values"),
    "timeless": ("decisions", "decision_hz must be above 0, got 0.0"),
    "miscounted": ("decisions", "the environment's action_spec has 5 actions, but facts.actions has 3"),
    "driverless": ("drivers", "KeyError: 'idm'"),
    "choosy": ("cells", "ValueError: the gap is too large"),
}


@pytest.fixture
def bad_worlds(plugins: Path, toy_folder: Path) -> None:
    source = (PLUGINS / "bad_worlds.py").read_text()
    install(plugins, "bad-worlds", POINTS, {"bad_worlds_plugin": source})


@pytest.mark.usefixtures("bad_worlds")
@pytest.mark.parametrize("world", RULES)
def test_a_broken_rule_is_reported_with_its_fix(world: str) -> None:
    check, part = RULES[world]
    failed = {outcome.check: outcome.text for outcome in examine("world", world) if outcome.status == "fail"}
    assert part in failed[check]
    assert "\n" not in failed[check]


@pytest.mark.usefixtures("bad_worlds")
def test_a_world_may_refuse_continuous_actions() -> None:
    outcomes = {outcome.check: outcome for outcome in examine("world", "refusing")}
    assert {outcome.status for outcome in outcomes.values()} == {"pass"}
    assert outcomes["actions"].text == "continuous actions are refused: this world has no steering"


@pytest.mark.usefixtures("toy_folder")
@pytest.mark.parametrize("world", ["toy", "bend", "red_street"])
def test_a_world_with_axes_and_actions_of_its_own_passes(world: str) -> None:
    assert {outcome.check: outcome.text for outcome in examine("world", world) if outcome.status != "pass"} == {}


@pytest.mark.usefixtures("toy_folder")
def test_a_victim_is_checked_in_the_given_world(bench: Bench) -> None:
    assert bench("check", "toy", "world=bend").code == 0
    blind = {outcome.check: outcome for outcome in examine("victim", "blind", {"policy": "straight"}, world="bend")}
    assert blind["shape and type"].status == "pass"
    assert (
        "unknown victim.policy 'straight'"
        in {o.check: o.text for o in examine("victim", "blind", {"policy": "straight"})}["behaviour"]
    )


def test_a_track_without_checks_of_its_own_has_those_of_every_component(plugins: Path) -> None:
    source = (PLUGINS / "toy_track.py").read_text()
    install(plugins, "cavbench-listening", LISTENING, {"listening_plugin": source})
    track.cache_clear()
    for kind, name in (("attack", "down"), ("victim", "ear"), ("world", "booth")):
        outcomes = {outcome.check: outcome for outcome in examine(kind, name)}  # type: ignore[arg-type]
        assert outcomes["docs"].status == "pass"
        assert outcomes["behaviour"].status == "skip"
        assert "the track 'listening' has no checks for this kind of component" in outcomes["behaviour"].text
    assert outcomes["grids"].text == "melodies-v1; melodies-v1 has 2 cells"
    track.cache_clear()


@pytest.mark.parametrize(
    ("decoys", "shown", "complaint"),
    [
        ((GREEN,), None, "there are 1 decoys for 12 frames"),
        ((GREEN,) * 12, "sign", "a decoy's image is that of the stop sign"),
        ((GREEN,) * 12, "noise", "the decoys of a frame change from call to call"),
        ((), None, "it has no decoys"),
    ],
)
def test_decoys_are_checked(decoys: tuple[Decoy, ...], shown: str | None, complaint: str) -> None:
    class Odd(RedScenes):
        def render_decoys(self, frames: Tensor) -> Tensor:
            if shown == "noise":
                return torch.rand(len(frames), 3, *self.size)
            return self.render(frames, None, 0.5) if shown else super().render_decoys(frames)

    @dataclass(frozen=True, kw_only=True)
    class OddStreet(RedStreet):
        def training_scenes(self) -> Scenes:
            scenes = Odd(torch.linspace(8, 30, 12))
            scenes.decoys = decoys
            return scenes

    suite = CameraSuite(Subject(kind="world", name="odd", component=OddStreet()))
    with pytest.raises((BrokenRuleError, NotApplicableError), match=complaint):
        suite.decoys()
