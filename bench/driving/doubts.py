"""What makes the scores of a pair doubtful in a world, before anything is driven, and what all its baselines say afterwards."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from cavbench import zoo
from cavbench.core.chain import Chain
from cavbench.core.names import MARK
from cavbench.core.options import configured
from cavbench.core.pair import Pair
from cavbench.driving.contracts import DrivingWorld
from cavbench.driving.features import DrivingFacts, Features
from cavbench.errors import UserError

SHOWN = 6
"""So many features are named in a sentence."""


def doubts(pair: Pair, default_world: str) -> Iterator[str]:
    """The doubts about a pair, one line each.

    Args:
        pair: a pair of the driving track.
        default_world: name of the world that drivers are trained in if nothing else is said.
    """
    world: Any = pair.world.component
    for name, part in _named(pair):
        yield from _too_fast(name, part, pair, world)
        if _in_zoo(part, pair):
            yield from _trained_elsewhere(name, part, pair, default_world)


def other_features(pair: Pair, default_world: str) -> str:
    """The end of a sentence on a network of the zoo that has learned other features than those of the world; empty for none."""
    here: Any = pair.world.component.facts
    for name, part in _named(pair):
        home = _home(part, default_world) if _in_zoo(part, pair) else None
        if home is not None and home.features.names != here.features.names:
            listed = ", ".join(here.features.names[:SHOWN]) + (", …" if len(here.features.names) > SHOWN else "")
            return (
                f"was trained on {', '.join(home.features.names)}, this world measures {listed}: give a "
                f"policy that was trained here, victim=sb3 (or torch, onnx) with victim.path=…, in place of {name}"
            )
    return ""


def hopeless(baselines: pa.Table) -> str:
    """What to say if every baseline fails in every episode of these records; empty otherwise."""
    failed = pc.or_(baselines["crashed"], baselines["offroad"])
    if not len(baselines) or not pc.all(failed).as_py():
        return ""
    pairs = set(zip(baselines["victim"].to_pylist(), baselines["victim_params"].to_pylist(), strict=True))
    drivers = sorted({str(json.loads(params).get("policy", name)) for name, params in pairs})
    return (
        f"every baseline fails in every episode ({', '.join(drivers)}; {len(baselines)} episodes): the task may be too hard for "
        "them, or arriving counts as a failure (`GymWorld.failed` says what one is)"
    )


def _named(pair: Pair) -> list[tuple[str, Any]]:
    """The victim, and the defence or its links, with their names."""
    defense = pair.defense.component
    links = defense.links if isinstance(defense, Chain) else (defense,)
    return [(pair.victim.name, pair.victim.component), *zip(pair.defense.name.split(MARK), links, strict=False)]


def _too_fast(name: str, part: Any, pair: Pair, world: DrivingWorld) -> Iterator[str]:
    """Drivers and filters that brake by SLOWER need a target speed that is low enough."""
    victim: Any = pair.victim.component
    facts = world.facts
    needed = getattr(part, "brakes_to", None)
    if needed is None or facts.kinematics is None or victim.action_type != "discrete":
        return
    if (slowest := facts.kinematics.target_speeds[0]) > needed:
        yield (
            f"{name} brakes by SLOWER, which ends at {slowest:g} m/s in this world; it was made for {needed:g} m/s and can "
            f"crash into slower traffic without any attack: {world.brakes_by}"
        )


def _in_zoo(part: Any, pair: Pair) -> bool:
    """Whether a victim or a defence has networks in the zoo; others may take their networks from anywhere."""
    if not hasattr(part, "trained_in"):
        return False
    try:
        return bool(zoo.seeds(_recipe(part, pair)))
    except NotImplementedError:
        return False


def _trained_elsewhere(name: str, part: Any, pair: Pair, default_world: str) -> Iterator[str]:
    """A network of the zoo is at home in the world that its recipe names."""
    world: Any = pair.world.component
    home = _home(part, default_world)
    if home is None or not (differs := _difference(home, world.facts)):
        return
    recipe = _recipe(part, pair)
    found = zoo.trained_there(recipe, where) if (where := zoo.trained_in(world, default=default_world)) else []
    own = f"choose its own: {found[0]}" if found else "train it in this one (bench train), or choose its own"
    yield f"{name} was trained in another world: {differs}; {own}"


def _recipe(part: Any, pair: Pair) -> zoo.Recipe:
    victim: Any = pair.victim.component
    return zoo.Recipe.of(victim, None if part is victim else part)


def _home(part: Any, default_world: str) -> DrivingFacts | None:
    """The facts of the world that a network was trained in; None if it can no longer be made, which does not matter here."""
    first, *others = [*shlex.split(part.trained_in), ""]
    values = [word for word in (first, *others) if "=" in word]
    world = first if first and "=" not in first else default_world
    try:
        facts = configured("world", world, dict(word.split("=", 1) for word in values)).component.facts
    except UserError:
        return None
    return facts if isinstance(facts, DrivingFacts) else None


def _difference(home: DrivingFacts, here: DrivingFacts) -> str:
    """The first difference between two worlds that changes what a driver sees or what its actions do; empty for none."""
    if home.features.names != here.features.names:
        return f"it saw {', '.join(home.features.names)}"
    for place, name in enumerate(home.features.names):
        ranges = [_range(facts.features, place) for facts in (home, here)]
        if ranges[0] != ranges[1]:
            return f"it saw {name} from {ranges[0]}, here {name} is {ranges[1]}"
    if home.decision_hz != here.decision_hz:
        return f"it decided {home.decision_hz:g} times a second, here it does {here.decision_hz:g} times"
    speeds = [None if facts.kinematics is None else facts.kinematics.target_speeds for facts in (home, here)]
    if speeds[0] != speeds[1]:
        before, now = (each and f"{', '.join(f'{speed:g}' for speed in each)} m/s" for each in speeds)
        return f"its target speeds were {before or 'not declared'}, here they are {now or 'not declared'}"
    return ""


def _range(features: Features, place: int) -> str:
    return f"{features.low[place]:g} to {features.high[place]:g} {features.units[place]}"
