"""What a run costs is known before it begins, and how long it still takes while it goes on."""

from __future__ import annotations

import random
from io import StringIO
from pathlib import Path

import pytest

from cavbench.cli.run import permit
from cavbench.core.registry import GROUPS, entries
from cavbench.errors import UserError
from cavbench.run.config import plan_of
from cavbench.run.cost import rates, spoken, table
from cavbench.run.forecast import Forecast
from cavbench.run.progress import RunProgress
from cavbench.run.task import Task
from cavbench.terminal import Console
from tests.command import Bench

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


def test_more_effort_costs_more() -> None:
    usual, twice = (rates(plan_of(["attack=pgd", *words]).pairs[0]) for words in ([], ["attack.steps=20"]))
    assert twice.episode == pytest.approx(2 * usual.episode)


def test_a_filter_and_its_gradients_are_dearer() -> None:
    episode = [
        rates(plan_of(["attack=pgd", f"defense={name}"]).pairs[0]).episode for name in ("none", "tracker+shield")
    ]
    assert episode[1] > 5 * episode[0]


def test_what_nobody_measured_is_said() -> None:
    assert "a guess, because nobody measured nudge" in str(plan_of(["attack=nudge", *SHORT]).cost)


@pytest.mark.parametrize(
    "words", [("attack=standard", "defense=advtrain"), ("attack=standard", "victim=yolov5", "defense=jpeg")]
)
def test_the_suites_are_measured(words: tuple[str, ...]) -> None:
    assert plan_of([*words]).cost.unknown == ()


def test_the_table_names_components_that_exist() -> None:
    known = {name for kind in ("attack", "defense", "victim") for name in entries(GROUPS[kind])}
    for track in ("driving", "detection"):
        for row, attacks in table()[track]["rows"].items():
            assert {*row.split("+"), *attacks} <= known
            assert all(cost >= 0 for costs in attacks.values() for cost in costs.values())


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
    """The machine is slower or faster than the one of the table, and each pair and unit than that says, too."""
    tasks = tasks_of("attack=pgd,zo,noise", "lanes=3,4", "density=1,2", "weather=clear,rain", "episodes=5", "seeds=0,1")
    clock, chance = Clock(), random.Random(7)
    forecast = Forecast(tasks, workers, clock)
    of_pair = {task.pair.id: chance.uniform(0.8, 1.25) for task in tasks}
    costs = {task.unit.fingerprint: forecast.parts[task.unit.fingerprint].cost for task in tasks}
    seconds = {
        id(task): costs[task.unit.fingerprint] * slower * of_pair[task.pair.id] * chance.uniform(0.7, 1.4)
        for task in tasks
    }
    waiting, busy, told = list(tasks), [], []
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
            forecast.reached(str(entry[0]), entry[1] / seconds[id(entry[0])])
        for task, spent in [entry for entry in busy if entry[1] >= seconds[id(entry[0])] - 1e-3]:
            forecast.finished(task, spent)
        busy = [entry for entry in busy if entry[1] < seconds[id(entry[0])] - 1e-3]
        if 0.1 * total < done < 0.95 * total:
            told.append((clock.time, forecast.left))
    assert len(told) > 10
    for now, left in told:
        assert abs(now + left - clock.time) <= 0.25 * clock.time
    assert forecast.left == 0


def test_units_of_one_task_may_be_driven_together_or_one_after_the_other() -> None:
    tasks = [task for task in tasks_of("attack=pgd", *SHORT, "reference=false") if task.pair.attack.name == "pgd"][:2]
    for episodes, expected in ((4, [0.5, 0.5]), (2, [0.5, 0.0])):
        forecast = Forecast(tasks, 1, Clock())
        forecast.working(tasks)
        forecast.reached(str(tasks[0]), 0.5, episodes)
        assert [forecast.parts[task.unit.fingerprint].share for task in tasks] == expected


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
