"""`bench train`: trains a victim, a defence of it or an attack on it, and saves every training seed to the zoo."""

from __future__ import annotations

import logging
import shlex
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from rich.text import Text

from cavbench import zoo
from cavbench.cli.progress import TrainingProgress
from cavbench.core.chain import Chain
from cavbench.core.contracts import Trained, World
from cavbench.core.pair import Chosen, choose
from cavbench.core.track import track
from cavbench.errors import UserError
from cavbench.files import check_folder
from cavbench.run.config import TrainConfig
from cavbench.run.logs import FOLDER, Log, log_card
from cavbench.run.process import settle
from cavbench.terminal import Console


def train(asked: TrainConfig, console: Console) -> None:
    """Train every requested training seed, and print where it is saved and how to use it.

    Raises:
        UserError: if there is nothing to train, or the zoo cannot be written.
    """
    settle()
    # Its notes on storages would stand between the lines of the progress.
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    config = _behind(asked)
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
        name = f"{recipe.name}, seed {seed}"
        log = (
            None
            if config.log is None
            else Log(config.log, Path(FOLDER), f"{recipe.key}-seed{seed}", _settings(config, seed))
        )
        with TrainingProgress(Console(stderr=True), name, log.progress if log else None) as progress:
            made = _trained(config, component, seed, progress)
        if log:
            log_card(log, made.card)
            log.close()
        path = zoo.save(
            made.network,
            recipe,
            seed=seed,
            world=config.world.component,
            card=made.card,
            start=made.start,
            root=config.out,
        )
        seconds = time.perf_counter() - start
        line = f"{recipe.name}, seed {seed}: trained in {seconds:.0f} s, saved as {path}"
        console.print(Text(line), soft_wrap=True)
    use = recipe.use if config is asked else _use(config, component, asked.defense)
    for word in getattr(component, "forges", ())[:1]:
        use += f" threat.{word}"
    console.print(Text(f"To use it: {use}"), soft_wrap=True)


def _settings(config: TrainConfig, seed: int) -> dict[str, object]:
    """What a log is of: the components with their parameters, and the seed."""
    parts = {part.kind: f"{part.name} {part.params}" for part in _parts(config)}
    return parts | {"world": f"{config.world.name} {config.world.params}", "seed": seed}


def _behind(config: TrainConfig) -> TrainConfig:
    """To train a defence that works at run time is to train the victim behind it; the same holds for such links of a chain.

    Raises:
        UserError: if the victim is to be trained behind another defence.
    """
    chosen, victim = config.defense, config.victim.component
    if config.trained is not chosen or "behind" not in {field.name for field in fields(victim)}:
        return config
    first, rest = None, None if chosen.component.hardens else (chosen.name, chosen.component)
    if isinstance(chosen.component, Chain):
        first, rest = chosen.component.parted
    if rest is None or chosen.name == "none":
        return config
    text = zoo.written(*rest)
    if victim.behind not in ("", text):
        raise UserError(f"victim.behind={victim.behind} is not the defence of this training, {text}: leave it out")
    return replace(
        config,
        victim=replace(config.victim, component=replace(victim, behind=text)),
        defense=choose("defense", "none")
        if first is None
        else Chosen(kind="defense", name=first[0], component=first[1]),
    )


def _use(config: TrainConfig, component: Any, defense: Chosen[Any]) -> str:
    """The command that drives behind `defense` with the `component` that was trained for it."""
    trained, whole = config.trained, defense.component
    victim = config.victim.component if trained.kind == "defense" else component
    if trained.kind == "defense":
        whole = replace(whole, **{trained.name: component})
    words = ["bench", "run"]
    for kind, name, part in (("victim", config.victim.name, victim), ("defense", defense.name, whole)):
        _, *options = shlex.split(zoo.written(name, part))
        words += [f"{kind}={name}", *(f"{kind}.{option}" for option in options)]
    return shlex.join(words)


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
