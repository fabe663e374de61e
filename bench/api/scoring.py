"""`score` drives pairs and returns their scores as a DataFrame; `load` returns a policy of the zoo."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch

from cavbench.api.choosing import checked_for_workers, chosen, grid_with, pairs_of, victim_of, world_of
from cavbench.api.table import Scores, scores_of
from cavbench.core.contracts import Attack, Defense, ThreatModel, Victim, World
from cavbench.core.pair import Pair
from cavbench.errors import UserError
from cavbench.isolation.modes import usual
from cavbench.records import reading
from cavbench.run import runner
from cavbench.run.plan import Plan
from cavbench.run.progress import RunProgress
from cavbench.scenarios import Grid, Value
from cavbench.terminal import Console

if TYPE_CHECKING:
    from torch import nn

    from cavbench.driving import Policy

By = Literal["pair", "cell"]


@usual()
def score(
    victim: str | Victim | nn.Module | Any = "dqn",
    attack: str | Attack | Sequence[str | Attack] = "standard",
    defense: str | Defense | Sequence[str | Defense] = "none",
    *,
    world: str | World | None = None,
    threat: ThreatModel | Mapping[str, Any] | None = None,
    grid: str | Grid | None = None,
    episodes: int | None = None,
    seeds: Sequence[int] | None = None,
    by: By = "pair",
    baselines: bool = True,
    race: bool = True,
    record: int = 0,
    out: str | Path = "results",
    workers: int = 1,
    device: Literal["auto", "cpu", "cuda"] = "cpu",
    progress: bool | None = None,
    name: str | None = None,
    actions: Literal["discrete", "continuous"] | None = None,
    trained_in: str | None = None,
    **axes: Value | Sequence[Value],
) -> Scores:
    """Score attacks on a defended victim, as `bench run` does: the same scenarios, threat model, records and resuming.

        cavbench.score("dqn", attack=["noise", "pgd"], defense="advtrain", lanes=3, episodes=20)
        cavbench.score(my_network, lanes=[3, 4], density=1, weather="clear")

    Args:
        victim: a name, as on the command line; or an object: a `cavbench.driving.Policy`, a `torch.nn.Module` that maps
            observations [N, V, F] or [N, V * F] to values [N, A] of the discrete actions or to actions [N, 2] in [-1, 1], an
            actor of TorchRL, or a model of Stable-Baselines3. A list of objects holds the trainings of one policy, one for each
            training seed. In a camera world: a `cavbench.detection.Detector`, or a `torch.nn.Module` that maps images to boxes
            and scores (`cavbench.detector` takes it with parameters).
        attack: an attack or a suite, or a list of them: names, or objects such as `component("attack", "pgd", steps=50)`.
        defense: a defence, or a list of them; a name or an object each.
        world: name or object; by default that of the victim's track.
        threat: the threat model, or a mapping of its parameters: {"norm": "linf", "budget": 0.2}.
        grid: a grid or its name; by default the world's.
        episodes: scenarios in each cell; by default the grid's.
        seeds: training seeds; by default those of the grid, or one for each object of `victim`.
        by: `pair` for one row for each pair, `cell` for one row for each pair and cell.
        baselines: whether to drive the baselines, too.
        race: whether only the strongest two attacks of a suite drive all scenarios; the others drive a pilot.
        record: episodes to record in each cell.
        out: results folder. What is there is not driven again.
        workers: worker processes. 1 drives in this process. More need a script with `if __name__ == "__main__":`, and objects
            that can be pickled. Results do not depend on it.
        device: where victims compute: `cpu`, `cuda` (a GPU), or `auto` (a GPU if there is one).
        progress: whether to show a progress bar; by default on a terminal.
        name: how records call a victim that is an object; by default its class and the first digits of its weights' hash.
        actions: type of actions of a torch network whose output fits both.
        trained_in: the world in which a victim that is an object was trained, as tables print it: "highway". By default what its
            environment says, if it has one, otherwise `unknown`, on which tables remark.
        axes: values on the axes of the world, for instance lanes=3 or weather=["clear", "fog"].

    Returns:
        A DataFrame (`cavbench.api.table.scores_of` explains the columns); its `records` are the records, one row an episode.

    Raises:
        UserError: in one line, if an argument is not allowed or a component fails.
    """
    if by not in ("pair", "cell"):
        raise UserError(f"by must be 'pair' or 'cell', got {by!r}")
    in_world = world_of(world, victim)
    asked = grid_with(in_world, grid, episodes, axes)
    attacked = victim_of(victim, in_world, asked, name=name, actions=actions, trained_in=trained_in)
    pairs, skipped, racing = pairs_of(attack, defense, attacked, in_world, threat)
    checked_for_workers(pairs, workers)
    policies = getattr(attacked.component, "policies", ())
    count = len(policies) if len(policies) > 1 else asked.training_seeds
    try:
        plan = Plan(
            pairs=tuple(pairs),
            grid=asked,
            seeds=tuple(range(count) if seeds is None else seeds),
            executor="serial" if workers == 1 else "processes",
            workers=workers,
            device=device,
            out=Path(out).expanduser(),
            record=record,
            reference=baselines,
            racing=racing if race else frozenset(),
            skipped=tuple(skipped),
        )
    except ValueError as error:
        raise UserError(str(error)) from error
    return scores_of(plan, _driven(plan, progress), by)


def _driven(plan: Plan, progress: bool | None) -> Any:
    """The records of a run, as a pyarrow.Table."""
    shown = sys.stderr.isatty() if progress is None else progress
    # A run computes with one thread; the caller's torch goes on as before.
    threads = torch.get_num_threads()
    try:
        with RunProgress(Console(stderr=True)) if shown else nullcontext(_Silent()) as watcher:
            for line in plan.skipped:
                watcher.warn(line)
            units = runner.run(plan, watcher)
    finally:
        torch.set_num_threads(threads)
    return reading.read(plan.out, units, track=plan.track)


class _Silent:
    """Watches a run (`cavbench.run.runner.RunWatcher`) and shows its warnings only."""

    def begin(self, *, episodes: int, finished: int, forecast: object) -> None:
        pass

    def working(self, tasks: object) -> None:
        pass

    def preparing(self, task: str, share: float, text: str, episodes: int = 0) -> None:
        pass

    def finished(self, task: object, wall_s: float) -> None:
        pass

    def printed(self, task: object, lines: Sequence[str]) -> None:
        sys.stdout.write("".join(f"{line}\n" for line in lines))

    def failed(self, line: str) -> None:
        warnings.warn(line, stacklevel=4)

    def warn(self, line: str) -> None:
        warnings.warn(line, stacklevel=4)


def load(name: str = "dqn", *, seed: int = 0, world: str | World | None = None) -> Policy | Any:
    """A trained policy, or detector, of the zoo: `load("dqn")`, or with its defence `load("dqn+advtrain")`.

    Args:
        name: the name of a victim, possibly with `+` and the name of a defence.
        seed: training seed.
        world: the world that it will be used in; by default that of the victim's track.

    Returns:
        The network, in eval mode: of the driving track a `cavbench.driving.Policy`, which maps observations [B, V, F] to scores.

    Raises:
        UserError: if there is no such component, or the zoo has no such policy; the message has the command that trains it.
    """
    victim_name, _, defense_name = name.partition("+")
    victim = chosen("victim", victim_name)
    own_track = victim.component.tracks()[0]
    pair = Pair(
        attack=chosen("attack", "none"),
        defense=chosen("defense", defense_name or "none", own_track),
        victim=victim,
        world=world_of(world, victim_name),
        threat=victim.component.threat.of_nobody(),
    )
    return pair.load(seed)
