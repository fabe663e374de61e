"""What a run costs is known before it begins, and how long it still takes while it goes on."""

from __future__ import annotations

import random
import runpy
import subprocess
import sys
import time
from copy import deepcopy
from io import StringIO
from pathlib import Path

import pytest

from cavbench.cli.run import permit
from cavbench.core.registry import GROUPS, entries
from cavbench.errors import UserError
from cavbench.run.batches import batches
from cavbench.run.config import plan_of
from cavbench.run.cost import rates, spoken, table
from cavbench.run.forecast import Forecast
from cavbench.run.progress import RunProgress
from cavbench.run.task import Task
from cavbench.terminal import Console
from tests.command import Bench
from tests.tree import ROOT

pytestmark = pytest.mark.usefixtures("toy_folder")
SHORT = ("lanes=3,4", "density=1", "weather=clear", "episodes=2", "seeds=0,1")


def test_the_episodes_are_those_that_are_driven() -> None:
    plan = plan_of(["attack=pgd,zo", *SHORT, "workers=1"])
    units = plan.units({task.unit.networks: ("", "") for task in plan.loadings})
    assert plan.cost.episodes == sum(len(unit.seeds) for unit in units)
    # Two attacks and a control on two cells with two trainings; eight baselines of one run each.
    assert (plan.cost.pairs, plan.cost.controls, plan.cost.baselines) == (2, 8, 32)
    assert plan.cost.episodes == 16 + 8 + 32
    assert sum(seconds for _, seconds in plan.cost.by_pair.values()) == pytest.approx(plan.cost.cpu_s)


def test_the_line_says_pairs_episodes_time_and_disk() -> None:
    line = str(plan_of(["attack=pgd", *SHORT, "workers=1"]).cost)
    assert line.startswith("1 pair, 48 episodes (8 controls and 32 baselines among them): about ")
    assert line.endswith(" MB")
    assert "of CPU" in line
    assert "measured" not in line
    assert "at most about" in str(plan_of(["attack=pgd", *SHORT, "until=0.1"]).cost)


def test_more_effort_costs_more_but_the_world_moves_as_before() -> None:
    usual, twice = (rates(plan_of(["attack=pgd", *words]).pairs[0]) for words in ([], ["attack.steps=20"]))
    assert 1.8 * usual.of(10) < twice.of(10) < 2 * usual.of(10)


def test_a_world_with_fewer_decisions_is_cheaper_to_attack() -> None:
    usual, short = (rates(plan_of(["attack=pgd", f"world={name}"]).pairs[0]) for name in ("highway", "highway-v0"))
    assert short.of(10) < 0.5 * usual.of(10)
    assert short.unknown == ()


def test_a_filter_and_its_gradients_are_dearer() -> None:
    costs = [rates(plan_of(["attack=pgd", f"defense={name}"]).pairs[0]).of(1) for name in ("none", "tracker+shield")]
    assert costs[1] > 5 * costs[0]


@pytest.mark.parametrize("alone", [True, False])
def test_units_that_are_driven_alone_share_nothing(alone: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As those of a victim that draws from the generators of the process; `smoothing` does not."""
    known = deepcopy(table())
    known["driving"]["rows"]["dqn+smoothing"]["pgd"] |= {"alone": 1.0} if alone else {}
    monkeypatch.setattr("cavbench.run.cost.table", lambda: known)
    plan = plan_of(["attack=pgd", "defense=smoothing", "episodes=2", "seeds=0", "workers=1", "reference=false"])
    own, units = rates(plan.pairs[0]), len(plan.grid.cells())
    _, seconds = plan.cost.by_pair[plan.pairs[0].id]
    assert own.alone == alone
    assert (seconds == pytest.approx(units * own.of(2))) == alone
    assert seconds < 1.001 * units * own.of(2)


@pytest.mark.parametrize("alone", [True, False])
def test_a_victim_is_driven_alone_only_where_its_gradients_are_asked_for(
    alone: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If they depend on the batch, and its answers do not; `plan` was not measured behind `atla`."""
    known = deepcopy(table())
    assert not any(costs.get("alone") for costs in known["driving"]["rows"]["dqn+atla"].values())
    known["driving"]["rows"]["dqn+atla"]["pgd"] |= {"alone": 1.0} if alone else {}
    monkeypatch.setattr("cavbench.run.cost.table", lambda: known)
    words = ("defense=atla", "threat.access=dynamics", "reference=false")
    pairs = {name: plan_of([f"attack={name}", *words]).pairs[0] for name in ("noise", "zo", "pgd", "plan")}
    assert {name: rates(pair).alone for name, pair in pairs.items()} == {
        "noise": False,
        "zo": False,
        "pgd": alone,
        "plan": alone,
    }


def test_what_nobody_measured_is_said() -> None:
    assert "a guess, because nobody measured nudge" in str(plan_of(["attack=nudge", *SHORT]).cost)


@pytest.mark.parametrize(
    "words", [("attack=standard", "defense=advtrain"), ("attack=standard", "victim=yolov5", "defense=jpeg")]
)
def test_the_suites_are_measured(words: tuple[str, ...]) -> None:
    assert plan_of([*words]).cost.unknown == ()


def test_the_table_names_components_that_exist() -> None:
    known = {name for kind in ("attack", "defense", "victim") for name in entries(GROUPS[kind])}
    assert set(table()["driving"]["worlds"]) <= set(entries(GROUPS["world"]))
    for track in ("driving", "detection"):
        for row, attacks in table()[track]["rows"].items():
            assert {*row.split("+"), *attacks} <= known
            assert all(cost >= 0 for costs in attacks.values() for cost in costs.values())


def test_what_is_measured_counts_the_processes_that_a_world_started() -> None:
    costs = runpy.run_path(str(ROOT / "benchmarks" / "costs.py"), run_name="costs")
    before, own = costs["cpu"](), time.process_time()
    busy = "import time\nwhile time.process_time() < 0.5: pass"
    subprocess.run([sys.executable, "-S", "-c", busy], check=True)
    assert costs["cpu"]() - before > 0.4
    assert time.process_time() - own < 0.3


def test_a_dry_run_writes_nothing(bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said = bench("run", "attack=pgd", *SHORT, "junit=reports/j.xml", "--dry-run")
    assert (said.code, said.err) == (0, "")
    assert said.out.startswith("1 pair, 48 episodes (8 controls")
    assert "none + none + idm" in said.out
    assert list(tmp_path.iterdir()) == []


def test_times_are_spoken() -> None:
    assert [spoken(one) for one in (0.2, 40, 700, 2 * 3600, 3 * 86_400)] == [
        "1 s",
        "40 s",
        "12 min",
        "2.0 h",
        "3.0 days",
    ]


@pytest.mark.parametrize(("typed", "goes_on"), [("y", True), ("yes", True), ("n", False), ("", False)])
def test_a_terminal_is_asked_before_a_long_run(monkeypatch: pytest.MonkeyPatch, typed: str, goes_on: bool) -> None:
    console = Console(file=StringIO(), force_terminal=True)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda *_: typed)
    permit(console, 3000, yes=False)
    permit(console, 9000, yes=True)
    permit(Console(file=StringIO()), 9000, yes=False)
    if goes_on:
        permit(console, 9000, yes=False)
    else:
        with pytest.raises(UserError, match="nothing was driven"):
            permit(console, 9000, yes=False)


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        return self.time


def tasks_of(*words: str) -> list[Task]:
    plan = plan_of(words)
    units = plan.units({task.unit.networks: ("", "") for task in plan.loadings})
    return [Task(unit=unit) for unit in units]


@pytest.mark.parametrize("slower", [0.4, 3.0])
@pytest.mark.parametrize("workers", [1, 2])
def test_after_a_tenth_of_the_work_the_time_left_is_right_within_a_quarter(slower: float, workers: int) -> None:
    """The machine is slower or faster than the one of the table, and each pair and batch than that says, too."""
    tasks = tasks_of("attack=pgd,zo,noise", "lanes=3,4", "density=1,2", "weather=clear,rain", "episodes=5", "seeds=0,1")
    clock, chance = Clock(), random.Random(7)
    forecast = Forecast(tasks, workers, clock)
    together = [
        Task(unit=first.unit, others=[one.unit for one in others]) for first, *others in batches(tasks, (), workers)
    ]
    of_pair = {task.pair.id: chance.uniform(0.8, 1.25) for task in tasks}
    costs = {id(task): sum(forecast.parts[one.unit.fingerprint].cost for one in task.each) for task in together}
    seconds = {key: cost * slower * chance.uniform(0.7, 1.4) for key, cost in costs.items()}
    seconds = {id(task): seconds[id(task)] * of_pair[task.pair.id] for task in together}
    waiting, busy, told = list(together), [], []
    total = sum(seconds.values())
    done = 0.0
    while waiting or busy:
        while waiting and len(busy) < workers:
            busy.append([waiting.pop(0), 0.0])
        forecast.working([task for task, _ in busy])
        step = min(seconds[id(task)] - spent for task, spent in busy) / 2 + 1e-6
        clock.time += step
        for entry in busy:
            entry[1] += step
            done += step
            episodes = sum(len(unit.seeds) for unit in entry[0].units)
            reach = next(batch.reach for batch in forecast.running.values() if batch.name == str(entry[0]))
            forecast.reached(str(entry[0]), reach * entry[1] / seconds[id(entry[0])], episodes)
        for task, spent in [entry for entry in busy if entry[1] >= seconds[id(entry[0])] - 1e-3]:
            for one in task.each:
                forecast.finished(one, spent / len(task.units))
        busy = [entry for entry in busy if entry[1] < seconds[id(entry[0])] - 1e-3]
        if 0.1 * total < done < 0.95 * total:
            told.append((clock.time, forecast.left))
    assert len(told) > 10
    for now, left in told:
        assert abs(now + left - clock.time) <= 0.25 * clock.time
    assert forecast.left == 0


def test_a_plain_patch_costs_what_a_grey_one_does_and_is_no_guess() -> None:
    grid = ("victim=yolov5", "lanes=3", "density=1", "weather=clear", "seeds=0", "episodes=2")
    grey, plain = (
        next(task.unit.pair for task in tasks_of("attack=grey_patch", *grid) if task.unit.pair.attack.name == name)
        for name in ("grey_patch", "plain_patch")
    )
    assert rates(plain) == rates(grey)
    assert not rates(plain).unknown


def test_a_patch_that_was_to_cost_next_to_nothing_says_nothing_of_its_episodes() -> None:
    grid = ("lanes=3", "density=1", "weather=clear", "seeds=0", "episodes=2")
    drives = tasks_of("attack=grey_patch", "victim=yolov5", *grid, "reference=false")
    (plain,) = [task.unit for task in drives if task.pair.attack.name == "grey_patch"]
    crafts = Task(step="prepare", unit=plain)
    forecast = Forecast([crafts, *drives], 1)
    planned = forecast.left
    forecast.finished(crafts, 0.5)
    assert forecast.left == pytest.approx(planned, rel=0.1)


def test_units_of_one_task_may_be_driven_together_or_one_after_the_other() -> None:
    tasks = [task for task in tasks_of("attack=pgd", *SHORT, "reference=false") if task.pair.attack.name == "pgd"][:2]
    batch = Task(unit=tasks[0].unit, others=[tasks[1].unit])
    for episodes, expected in ((4, 0.5), (2, 0.25)):
        forecast = Forecast(tasks, 1, Clock())
        forecast.working([batch])
        (under_way,) = forecast.running.values()
        forecast.reached(str(batch), 0.5 * under_way.reach, episodes)
        assert under_way.share == pytest.approx(expected)


def test_the_units_of_a_batch_end_together_and_those_of_a_lost_one_begin_again() -> None:
    tasks = [task for task in tasks_of("attack=pgd", *SHORT, "reference=false") if task.pair.attack.name == "pgd"]
    clock = Clock()
    forecast = Forecast(tasks, 1, clock)
    batch = Task(unit=tasks[0].unit, others=[tasks[1].unit])
    forecast.working([batch])
    clock.time = 10.0
    forecast.working([Task(unit=tasks[0].unit)])
    (alone,) = forecast.running.values()
    assert (alone.started, alone.share, len(alone.parts)) == (10.0, 0.0, 1)
    forecast.working([batch])
    forecast.finished(tasks[0], 5.0)
    before = forecast.left
    forecast.finished(tasks[1], 5.0)
    assert forecast.left == pytest.approx(before)


def test_a_batch_whose_episodes_end_early_is_not_taken_for_a_slow_one() -> None:
    (task, *others) = [
        task for task in tasks_of("attack=pgd", *SHORT, "reference=false") if task.pair.attack.name == "pgd"
    ]
    clock = Clock()
    forecast = Forecast([task, *others], 1, clock)
    forecast.working([task])
    (batch,) = forecast.running.values()
    batch.reach = 0.4
    clock.time = batch.cost / 2
    forecast.reached(str(task), 0.2, 2)
    assert forecast._factor_of(batch) == pytest.approx(1.0)
    forecast.reached(str(task), 0.9, 2)
    assert batch.share < 1


def test_a_log_file_has_one_line_a_minute_with_the_time_left() -> None:
    tasks = tasks_of("attack=pgd", *SHORT, "reference=false")
    clock, out = Clock(), StringIO()
    progress = RunProgress(Console(file=out, width=200), now=clock)
    progress.begin(episodes=16, finished=0, forecast=Forecast(tasks, 1, clock))
    for task in tasks:
        progress.working([task])
        for part in range(1, 13):
            clock.time += 5
            progress.preparing(str(task), part / 12, "", 2)
        progress.finished(task, 60.0)
    lines = out.getvalue().splitlines()
    assert len(lines) == len(tasks) + 1
    assert all(" left | " in line for line in lines[:-1])
    assert lines[-1] == f"16/16 episodes | 0:{len(tasks):02d}:00"
