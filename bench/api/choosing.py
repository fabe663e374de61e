"""Turns what the caller of a Python function gives, names or objects, into the parts of a run."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Mapping, Sequence
from typing import Any, get_args

import torch
from tensordict import TensorDict

from cavbench.core import budgets, registry, suites
from cavbench.core.contracts import Access, Attack, Component, Defense, ThreatModel, Victim, World
from cavbench.core.pair import Chosen, Pair, choose
from cavbench.core.registry import GROUPS, Kind
from cavbench.core.suites import Suite, combined, racing
from cavbench.core.track import track
from cavbench.detection import CameraWorld, Detector
from cavbench.detection.victims.in_process import DetectorObject, detector
from cavbench.driving import DrivingWorld
from cavbench.driving.victims.in_process import InProcess, code_of_policies, in_process
from cavbench.driving.victims.sb3_environment import training_of
from cavbench.driving.victims.sb3_model import is_model
from cavbench.driving.victims.spaces import UNKNOWN
from cavbench.errors import UserError
from cavbench.identity.bytecode import content_of
from cavbench.run.config import grid_of
from cavbench.scenarios import Grid, SeedBlock, Value

BASES: dict[str, type[Component]] = {"attack": Attack, "defense": Defense, "victim": Victim, "world": World}
TRIED = 4
"""Observations that a network is tried on."""
HASH_DIGITS = 6


def component(kind: Kind, name: str, **params: object) -> Any:
    """A component by its name, with these parameters: `component("attack", "pgd", steps=50)`.

    Args:
        kind: attack, defense, victim or world.
        name: as on the command line; `bench list` prints the names.
        params: parameters; the others keep their defaults.

    Raises:
        UserError: if the name is unknown, or a value is not allowed.
    """
    if kind not in BASES:
        raise UserError(registry.unknown(f"kind of component {kind!r}", kind, BASES))
    return choose(kind, name, **params).component


def several(given: Any) -> list[Any]:
    """A list of what was given, which may be one thing or a sequence."""
    return list(given) if isinstance(given, list | tuple) else [given]


def chosen(kind: Kind, given: object, track_name: str = "") -> Chosen[Any]:
    """A component that was given by its name or as an object.

    Raises:
        UserError: if it is neither.
    """
    if isinstance(given, str):
        return choose(kind, registry.on_track(kind, given, track_name) if track_name else given)
    if not isinstance(given, BASES[kind]):
        raise UserError(
            f"{kind} takes a name or an object of a subclass of {BASES[kind].__name__}, got {type(given).__name__}"
        )
    target = f"{type(given).__module__}:{type(given).__qualname__}"
    for name, claims in registry.entries(GROUPS[kind]).items():
        if claims[0].target == target:
            return Chosen(kind=kind, name=name, component=given)
    if missing := given.missing():
        raise UserError(f"{kind} {type(given).__name__} does not implement {', '.join(missing)}")
    # A world from gymnasium knows its content: looking through an environment, whose parts hold each other, would take hours.
    own = getattr(given, "content", "")
    name = given.id if own else type(given).__name__  # type: ignore[attr-defined]
    return Chosen(kind=kind, name=name, component=given, code=own or content_of(given))


def world_of(given: Any, victim: object) -> Chosen[Any]:
    """The world: the given one, one of a gymnasium environment that was given, or the default of the victim's track.

    Raises:
        UserError: if it is none of these.
    """
    if given is not None:
        return chosen("world", given if isinstance(given, World) or _is_name(given) else _of_gymnasium(given))
    own = choose("victim", victim).component if isinstance(victim, str) else victim
    name = own.tracks()[0] if isinstance(own, Victim) else "detection" if isinstance(own, Detector) else "driving"
    return choose("world", track(name).world)


def _is_name(given: object) -> bool:
    """Whether it is the name of a world, and not the id of a gymnasium environment."""
    return isinstance(given, str) and (given in registry.names("world") or not registry.is_environment(given))


def _of_gymnasium(given: Any) -> World:
    try:
        from cavbench.driving.gym import world
    except ImportError as error:
        raise UserError(str(error)) from error
    return world(given)


def victim_of(
    given: Any,
    world: Chosen[Any],
    grid: Grid,
    *,
    name: str | None,
    actions: str | None,
    trained_in: str | None = None,
) -> Chosen[Any]:
    """The victim: a name, a component, or policies that were given as objects, one for each training seed.

    Raises:
        UserError: if an object is no policy of the world.
    """
    if isinstance(given, DetectorObject):
        return _as_chosen(given, name)
    if isinstance(given, str | Victim):
        if name is not None or actions is not None:
            raise UserError("name= and actions= are for a victim that is an object, such as a torch.nn.Module")
        if trained_in is not None:
            raise UserError(
                "trained_in= is for a victim that is an object; a file has it as a parameter: "
                'cavbench.component("victim", "sb3", path=…, trained_in=…)'
            )
        return chosen("victim", given)
    if isinstance(world.component, CameraWorld):
        if actions is not None or trained_in is not None:
            raise UserError("actions= and trained_in= are for drivers; the victim of a camera world is a detector")
        return _detector(given, name)
    if not isinstance(world.component, DrivingWorld):
        raise UserError(
            f"victims of the {world.component.tracks()[0]} track are given by name, got {type(given).__name__}"
        )
    objects = several(given)
    if not objects:
        raise UserError("an empty list of victims")
    observation = _observations(world.component, grid)
    try:
        victim = in_process(
            objects, world.component.facts, observation, actions, lambda: _trained_in(objects, world, grid, trained_in)
        )
    except ValueError as error:
        raise UserError(str(error)) from error
    _refuse_twice(victim)
    code = code_of_policies(victim)
    label = name or f"{type(objects[0]).__name__}-{victim.policies[0].weights_sha256[:HASH_DIGITS]}"
    return Chosen(kind="victim", name=label, component=victim, code=code)


def _detector(given: Any, name: str | None) -> Chosen[Any]:
    """A detector that was given as an object, alone or as the only one of a list.

    Raises:
        UserError: if it is none, or there are several.
    """
    objects = several(given)
    if len(objects) != 1:
        raise UserError(
            f"the victim of a camera world is one detector, got {len(objects)}; seeds= are those of patches"
        )
    return _as_chosen(detector(objects[0]), name)


def _as_chosen(victim: DetectorObject, name: str | None) -> Chosen[Any]:
    label = name or f"{victim.source.rpartition('.')[2]}-{victim.network_given.weights_sha256[:HASH_DIGITS]}"
    return Chosen(kind="victim", name=label, component=victim, code=victim.code)


def _trained_in(objects: Sequence[object], world: Chosen[Any], grid: Grid, stated: str | None) -> str:
    """The world in which objects were trained: the stated one, or what their environments say if they agree, or `unknown`.

    Raises:
        UserError: if an environment changes observations or actions in a way that the world does not.
    """
    trainings = [training_of(one) if is_model(one) else None for one in objects]
    found = {
        UNKNOWN if training is None else training.world_of(world, grid, lambda own: str(chosen("world", own)))
        for training in trainings
    }
    if stated is not None:
        return stated
    return found.pop() if len(found) == 1 else UNKNOWN


def _refuse_twice(victim: InProcess) -> None:
    """Refuse a network that stands twice in a list: it would count as two trainings.

    Raises:
        UserError: names its places.
    """
    places: dict[str, list[int]] = {}
    for place, policy in enumerate(victim.policies, 1):
        places.setdefault(content_of(policy), []).append(place)
    for same in places.values():
        if len(same) > 1:
            listed = f"{', '.join(map(str, same[:-1]))} and {same[-1]}"
            raise UserError(
                f"the victims {listed} of the list are the same network, which is one training; a list holds different "
                "trainings of one policy: leave out the others"
            )


def pairs_of(
    attack: Any, defense: Any, victim: Chosen[Any], world: Chosen[Any], threat: ThreatModel | Mapping[str, Any] | None
) -> tuple[list[Pair], list[str], frozenset[str]]:
    """Every combination of attacks and defences, as `cavbench.core.suites.combined`, and the pairs that race."""
    own_track = victim.component.tracks()[0]
    names = suites.names()
    chosen_suites = [suites.suite(one, own_track) for one in several(attack) if isinstance(one, str) and one in names]
    attacks = [
        chosen("attack", one, own_track) for one in several(attack) if not isinstance(one, str) or one not in names
    ]
    for suite in chosen_suites:
        if suite.track != own_track:
            raise UserError(
                f"suite {suite.name!r} is for the {suite.track} track, the victim is of the {own_track} track"
            )
    allowed = threat_of(threat, victim, chosen_suites)
    defenses = [chosen("defense", one, own_track) for one in several(defense)]
    others = [{"defense": one, "victim": victim, "world": world, "threat": allowed} for one in defenses]
    pairs, skipped = combined(attacks, chosen_suites, others)
    return pairs, skipped, racing(pairs, attacks, chosen_suites)


def threat_of(
    given: ThreatModel | Mapping[str, Any] | None, victim: Chosen[Any], chosen_suites: Sequence[Suite]
) -> ThreatModel:
    """The threat model; like on the command line, suites get the access of their members unless it is given.

    Raises:
        UserError: if a value is not allowed.
    """
    if isinstance(given, ThreatModel):
        return budgets.checked(given, python=True)
    values = dict(given or {})
    budget, confirmed = budgets.read(values.get("budget"))
    values |= {} if budget is None else {"budget": budget}
    if chosen_suites and "access" not in values:
        values["access"] = max((suite.access for suite in chosen_suites), key=get_args(Access).index)
    model = victim.component.threat
    for name, value in suites.allowed(chosen_suites).items():
        of, _, field = name.rpartition(".")
        (values.setdefault(of, {}) if of else values).setdefault(field, value)
    try:
        return budgets.checked(model(**values), confirmed=confirmed, python=True)
    except UserError:
        raise
    except (ValueError, TypeError) as error:
        raise UserError(f"threat: {str(error).splitlines()[0]}") from error


def grid_with(world: Chosen[Any], given: Grid | str | None, episodes: int | None, cells: Mapping[str, Any]) -> Grid:
    """The grid of the world, with other values on some axes.

    Args:
        world: the world.
        given: a grid or its name; None for the world's default.
        episodes: scenarios in each cell; None for the grid's.
        cells: a value, or a sequence of values, by the name of an axis.

    Raises:
        UserError: if the grid or an axis is unknown, or a value is not allowed.
    """
    grid = given if isinstance(given, Grid) else grid_of(world, given)
    if strange := [name for name in cells if name not in grid.axes]:
        raise UserError(registry.unknown(f"argument or axis {strange[0]!r}", strange[0], grid.axes))
    try:
        values: dict[str, tuple[Value, ...]] = {
            name: tuple(grid.axes[name].checked(value) for value in several(given)) for name, given in cells.items()
        }
        return grid.with_(episodes=episodes, **values)
    except ValueError as error:
        raise UserError(str(error).splitlines()[0]) from error


def _observations(world: DrivingWorld, grid: Grid) -> torch.Tensor:
    """The first observations [B, V, F] of some scenarios, to try a network on: none of a scenario that is reported."""
    env = world.make([grid.cells()[0]] * TRIED, action_type="discrete" if world.actions else "continuous")
    try:
        seeds = torch.arange(TRIED) + SeedBlock.TUNE
        return env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))["observation"]
    finally:
        env.close(raise_if_closed=False)


def checked_for_workers(pairs: Sequence[Pair], workers: int) -> None:
    """Refuse objects that worker processes cannot create again.

    Raises:
        UserError: if one cannot be pickled, or its class is defined in a notebook or an interactive session.
    """
    if workers <= 1:
        return
    interactive = not hasattr(sys.modules["__main__"], "__file__")
    for part in {id(part): part for pair in pairs for part in pair.parts if part.code}.values():
        try:
            content = pickle.dumps(part.component)
        # Pickling calls code of the object, which may raise anything.
        except Exception as error:
            raise UserError(
                f"{part.kind} {part.name!r} cannot be sent to workers ({error}); leave out workers="
            ) from None
        if interactive and b"__main__" in content:
            raise UserError(
                f"{part.kind} {part.name!r} is defined in this session, which worker processes cannot import: "
                "leave out workers=, or move its class to a module"
            )
