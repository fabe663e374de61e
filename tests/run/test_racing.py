"""A race: all attacks of a suite drive a pilot, the strongest two the rest; the report knows it from the records."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from rich.console import Console

from cavbench import documents
from cavbench.core.suites import suite
from cavbench.core.track import track
from cavbench.documents import schema
from cavbench.errors import UserError
from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.page.document import document
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.leaderboard.ranking.worst import Panel
from cavbench.leaderboard.terminal.ranking import print_boards
from cavbench.leaderboard.terminal.text import size
from cavbench.records import reading
from cavbench.run import runner, stops
from cavbench.run.config import plan_of
from cavbench.run.plan import Plan
from cavbench.statistics.racing import hidden
from tests.run.test_runner import Silent

pytestmark = pytest.mark.usefixtures("toy_folder")

SCALES = "0.05,0.1,0.6,1.0"
WORDS = (
    *("attack=nudge", f"attack.scale={SCALES}", "victim=toy", "world=toy", "lanes=3,4", "density=1", "weather=clear"),
    *("seeds=0,1", "episodes=30", "reference=false", "executor=serial", "record=0"),
)


def raced(out: Path, *more: str) -> Plan:
    plan = plan_of([*WORDS, *more, f"out={out}"])
    names = frozenset(pair.id for pair in plan.pairs)
    return replace(plan, grid=replace(plan.grid, block=10), racing=names)


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory, toy_folder: Path) -> tuple[Plan, list[str]]:
    plan = raced(tmp_path_factory.mktemp("race"))
    return plan, runner.run(plan, Silent())


def test_only_the_strongest_two_drive_more_than_the_pilot(driven: tuple[Plan, list[str]]) -> None:
    plan, units = driven
    records = reading.read(plan.out, units, track=track("driving")).to_pandas()
    attacked = records[records.attack == "nudge"]
    scenarios = attacked.groupby("attack_params").seed.nunique()
    first = attacked[attacked.seed < plan.grid.first_seed + 10].groupby("attack_params").safe_progress.mean()
    assert sorted(scenarios) == [10, 10, 30, 30]
    assert set(scenarios.index[scenarios == 30]) == set(first.sort_values().index[:2])
    # The control is whole: what the attacks that went on are compared with.
    assert records[records.attack == "none"].seed.nunique() == 30


def test_what_was_dropped_is_written_with_its_reason(driven: tuple[Plan, list[str]]) -> None:
    plan, _ = driven
    dropped = stops.read(plan.out, [pair.id for pair in plan.pairs])
    assert [stop.why for stop in dropped] == ["raced out"] * 2
    on = {pair.id for pair in plan.pairs} - {stop.pair for stop in dropped}
    for stop in dropped:
        assert set(stop.by) == on
        assert (stop.scenarios, stop.most) == (10, 30)
        assert stop.low <= stop.estimate <= stop.high
        jsonschema.validate(asdict(stop) | {"by": list(stop.by)}, schema()["$defs"]["stop"])
        assert "lowered the score more in all cells together" in str(stop)


def test_a_grid_that_ends_with_the_pilot_drops_nothing(tmp_path: Path) -> None:
    plan = raced(tmp_path)
    plan = replace(plan, grid=replace(plan.grid, episodes=10))
    assert len(runner.run(plan, Silent())) == 20
    assert stops.read(plan.out, plan.racing) == []


def test_the_same_command_drives_nothing_again_and_without_a_race_it_drives_what_is_left(
    driven: tuple[Plan, list[str]], tmp_path: Path
) -> None:
    plan, units = driven
    again = Silent()
    assert set(runner.run(plan, again)) == set(units)
    assert again.done == []
    rest = Silent()
    every = runner.run(replace(plan, racing=frozenset()), rest)
    assert set(units) < set(every)
    assert len(rest.done) == len(every) - len(units)


def test_the_report_knows_a_race_from_its_records_and_makes_the_interval_wider(tmp_path: Path) -> None:
    plan = raced(tmp_path)
    records = reading.read(tmp_path, runner.run(plan, Silent()), track=track("driving"))
    boards, comparisons = read_boards({"driving": records})
    ((row,),) = (board.rows for board in boards)
    panel = row.worst.panel
    assert panel.pilot is not None
    assert (len(panel.attacks), len(panel.seeds)) == (2, 30)
    assert (len(panel.pilot.attacks), len(panel.pilot.seeds)) == (4, 10)
    # On this road the attacks are far apart: nothing is hidden.
    assert panel.hidden == hidden(panel.pilot.scores) == 0
    close = replace(panel.pilot, scores=np.random.default_rng(0).random(panel.pilot.scores.shape))
    doubtful = replace(panel, pilot=close).strongest()
    alone = replace(panel, pilot=None).strongest()
    assert alone is not None
    assert doubtful is not None
    assert row.worst.score == alone.score
    assert doubtful.score.estimate == alone.score.estimate
    assert alone.score.low > doubtful.score.low == pytest.approx(max(alone.score.low - hidden(close.scores), 0))
    assert len(row.attacks) == 4
    assert set(row.marginal) == set(panel.pilot.attacks)
    made = documents.document("leaderboard", document(boards, comparisons, tmp_path, ""))
    jsonschema.validate(json.loads(documents.written(made)), schema())
    console = Console(file=StringIO(), width=200)
    print_boards(boards, console)
    assert isinstance(console.file, StringIO)
    assert "toy" in console.file.getvalue()
    assert size(comparisons).endswith(": 2 cells of 10 to 30 scenarios, 2 training seeds")
    assert [remark.name for remark in row.remarks if remark.name == "raced"] == ["raced"]


def test_attacks_that_went_on_without_being_the_strongest_are_no_race(tmp_path: Path) -> None:
    plan = raced(tmp_path)
    units = runner.run(replace(plan, racing=frozenset()), Silent())
    records = reading.read(tmp_path, units, track=track("driving"))
    attacked = [one for one in read_tracks({"driving": records}) if one.is_attacked]
    weak = sorted(attacked, key=lambda one: -one.score.estimate)[:2]
    cut = [
        one if one in weak else _only(one, range(plan.grid.first_seed, plan.grid.first_seed + 10)) for one in attacked
    ]
    panel = Panel.of(cut)
    assert panel.pilot is None
    strong = [
        one if one not in weak else _only(one, range(plan.grid.first_seed, plan.grid.first_seed + 10))
        for one in attacked
    ]
    assert Panel.of(strong).pilot is not None


def _only(one: object, seeds: range) -> object:
    return replace(one, own=one.own.only(seeds=set(seeds)))  # type: ignore[attr-defined, type-var]


def test_the_suite_races_by_default_but_no_attack_that_is_chosen_by_its_name() -> None:
    words = ["victim=dqn", "defense=none"]
    plan = plan_of(["attack=standard", *words])
    assert plan.racing == {pair.id for pair in plan.pairs}
    both = plan_of(["attack=standard,pgd", *words])
    assert {pair.id for pair in both.pairs} - both.racing == {
        pair.id for pair in both.pairs if str(pair.attack) == "pgd"
    }
    for word in ("race=false", "shard=1/2", "until=0.1"):
        assert not plan_of(["attack=standard", *words, word]).racing
    assert suite("standard", "driving").races
    assert not suite("faults").races
    assert plan.cost.cpu_s < plan_of(["attack=standard", *words, "race=false"]).cost.cpu_s / 2


@pytest.mark.parametrize("word", ["shard=1/2", "until=0.1"])
def test_a_race_that_cannot_be_is_one_line(word: str) -> None:
    with pytest.raises(UserError, match="a race looks at all units of its pilot"):
        plan_of(["attack=standard", "victim=dqn", "race=true", word])
