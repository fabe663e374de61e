"""`bench train`: train a victim, or harden it with a defence, and save every seed to the zoo."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from bench.cli.progress import TrainingProgress
from bench.errors import UserError
from bench.plugins.contracts import Trained, World
from bench.plugins.pair import Chosen
from bench.plugins.track import track
from bench.run.config import TrainConfig, train_config
from bench.run.process import settle
from bench.victims import zoo


def train(words: Sequence[str], console: Console) -> None:
    """Train what the options ask for, one training seed after the other, and say where it is and how to use it.

    Raises:
        UserError: if an option is wrong, there is nothing to train, or the zoo cannot be written.
    """
    settle()
    config = train_config(words)
    hardens = config.defense.name != "none"
    if not hardens and not config.victim.component.learns:
        raise UserError(f"there is nothing to train: {config.victim.name} does not learn")
    trained = config.defense if hardens else config.victim
    component = _placed(trained, config.world.component)
    parts = (config.victim.component, component) if hardens else (component,)
    try:
        recipe = zoo.Recipe.of(*parts)
    except NotImplementedError as error:
        raise UserError(f"there is nothing to train: {error}") from error
    _check_writable(config.out or zoo.own())
    for seed in config.seeds:
        start = time.perf_counter()
        with TrainingProgress(Console(stderr=True), f"{recipe.name}, seed {seed}") as progress:
            made = _trained(config, component, hardens, seed, progress)
        path = zoo.save(made.network, recipe, seed=seed, world=config.world.component, card=made.card, root=config.out)
        seconds = time.perf_counter() - start
        said = f"{recipe.name}, seed {seed}: trained in {seconds:.0f} s, saved as {path}"
        console.print(Text(said), soft_wrap=True)
    console.print(Text(f"To use it: {recipe.use}"), soft_wrap=True)


def _trained(config: TrainConfig, component: Any, hardens: bool, seed: int, progress: TrainingProgress) -> Trained[Any]:
    victim, world = config.victim.component, config.world.component
    if not hardens:
        return component.train(world, seed=seed, progress=progress)
    made = component.train(victim, world, seed=seed, progress=progress)
    if made is None:
        raise UserError(f"there is nothing to train: defense {config.defense.name!r} works at run time only")
    return made


def _placed(trained: Chosen[Any], world: World) -> Any:
    """The component that is trained, saying the world it is trained in.

    Raises:
        UserError: if it says another one, or has no parameter to say it.
    """
    where = zoo.trained_in(world, default=track(world.tracks()[0]).world)
    said = getattr(trained.component, "trained_in", "")
    if said not in ("", where):
        raise UserError(
            f"{trained.kind}.trained_in={said} does not name the world of this training, "
            f"{where or 'the default'}; leave it out, it is set by world=NAME and world.PARAMETER=VALUE"
        )
    if "trained_in" in {field.name for field in fields(trained.component)}:
        return replace(trained.component, trained_in=where)
    if where:
        raise UserError(
            f"{trained.kind} {trained.name!r} cannot be trained in {where!r}: it has no parameter trained_in, so it could "
            "not be told from one that was trained in the default world"
        )
    return trained.component


def _check_writable(root: Path) -> None:
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"the zoo {root} cannot be written: {error.strerror or error}; out= names another folder"
        ) from None
