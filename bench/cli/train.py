"""`bench train`: trains a victim, a defence of it or an attack on it, and saves every training seed to the zoo."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from rich.text import Text

from bench.cli.progress import TrainingProgress
from bench.cli.terminal import Console
from bench.errors import UserError
from bench.files import check_folder
from bench.plugins.contracts import Trained, World
from bench.plugins.pair import Chosen
from bench.plugins.track import track
from bench.run.config import TrainConfig, train_config
from bench.run.process import settle
from bench.victims import zoo


def train(words: Sequence[str], console: Console) -> None:
    """Train every requested training seed, and print where it is saved and how to use it.

    Raises:
        UserError: if an option is invalid, there is nothing to train, or the zoo cannot be written.
    """
    settle()
    config = train_config(words)
    trained = config.trained
    if trained.kind != "defense" and not trained.component.learns:
        raise UserError(f"there is nothing to train: {trained.kind} {trained.name!r} does not learn")
    component = _placed(trained, config.world.component)
    try:
        recipe = zoo.Recipe.of(**{part.kind: part.component for part in _parts(config)} | {trained.kind: component})
    except NotImplementedError as error:
        raise UserError(f"there is nothing to train: {error}") from error
    root = config.out or zoo.own()
    for folder in (root, root / recipe.key):
        check_folder(folder, "the zoo")
    for seed in config.seeds:
        start = time.perf_counter()
        with TrainingProgress(Console(stderr=True), f"{recipe.name}, seed {seed}") as progress:
            made = _trained(config, component, seed, progress)
        path = zoo.save(made.network, recipe, seed=seed, world=config.world.component, card=made.card, root=config.out)
        seconds = time.perf_counter() - start
        line = f"{recipe.name}, seed {seed}: trained in {seconds:.0f} s, saved as {path}"
        console.print(Text(line), soft_wrap=True)
    console.print(Text(f"To use it: {recipe.use}"), soft_wrap=True)


def _parts(config: TrainConfig) -> list[Chosen[Any]]:
    """The victim, then the defence and the attack if there are any."""
    return [config.victim, *(part for part in (config.defense, config.attack) if part.name != "none")]


def _trained(config: TrainConfig, component: Any, seed: int, progress: TrainingProgress) -> Trained[Any]:
    victim, world = config.victim.component, config.world.component
    match config.trained.kind:
        case "attack":
            return component.train(victim, config.defense.component, world, seed=seed, progress=progress)
        case "defense":
            made = component.train(victim, world, seed=seed, progress=progress)
            if made is None:
                raise UserError(f"there is nothing to train: defense {config.defense.name!r} works at run time only")
            return made
        case _:
            return component.train(world, seed=seed, progress=progress)


def _placed(trained: Chosen[Any], world: World) -> Any:
    """The component to train, with its parameter `trained_in` set to the world of the training.

    Raises:
        UserError: if `trained_in` is already another world, or the component needs it but does not have it.
    """
    where = zoo.trained_in(world, default=track(world.tracks()[0]).world)
    given = getattr(trained.component, "trained_in", "")
    if given not in ("", where):
        raise UserError(
            f"{trained.kind}.trained_in={given} is not the world of this training, {where or 'the default'}: leave it out; "
            "world=NAME and world.PARAMETER=VALUE set it"
        )
    if "trained_in" in {field.name for field in fields(trained.component)}:
        return replace(trained.component, trained_in=where)
    if where:
        raise UserError(
            f"{trained.kind} {trained.name!r} cannot be trained in {where!r}: it has no parameter trained_in that "
            "would distinguish it from one trained in the default world"
        )
    return trained.component
