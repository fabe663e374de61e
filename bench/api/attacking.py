"""`attack`: one observation, one call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from cavbench.api.choosing import chosen, grid_with, threat_of, victim_of, world_of
from cavbench.core.contracts import Attack, Defense, ThreatModel, World
from cavbench.core.pair import Pair
from cavbench.driving import DrivingWorld
from cavbench.driving.one_step import Attacked, Form, Session
from cavbench.errors import UserError
from cavbench.isolation.modes import usual
from cavbench.scenarios import Value


@usual()
def attack(
    attack: str | Attack,
    policy: Any,
    observation: Any,
    *,
    world: str | World | Any = None,
    defense: str | Defense = "none",
    threat: ThreatModel | Mapping[str, Any] | None = None,
    actions: Literal["discrete", "continuous"] | None = None,
    seed: int = 0,
    **axes: Value,
) -> Attacked:
    """Attack single observations of a driving policy, within a threat model, as in the first step of an episode.

        found = cavbench.attack("pgd", model, observation, world="merge-v0")
        found.observation, found.queries, found.changed

    Args:
        attack: a name, or an object such as `component("attack", "pgd", steps=50)`.
        policy: the victim, as in `cavbench.score`.
        observation: an array or a tensor: as policies get it in a run, [V, F], or as the world's own gymnasium environment
            gives it; with another dimension in front, [B, ...], for several.
        world: as in `cavbench.score`; by default `highway`.
        defense: a defence of the policy.
        threat: the threat model, or a mapping of its parameters.
        actions: type of actions of a torch network whose output fits both.
        seed: of the attack's random numbers.
        axes: the cell in which it was observed, for attacks that know how the world moves: lanes=4. The others do not need it.

    Returns:
        The perturbed observation in the form of the given one, and what it cost.

    Raises:
        UserError: in one line, if something does not fit, or is not allowed.
    """
    in_world = world_of(world, policy)
    if not isinstance(in_world.component, DrivingWorld):
        raise UserError(
            "cavbench.attack is for driving policies; a patch on a sign is crafted and scored by cavbench.score"
        )
    grid = grid_with(in_world, None, None, axes)
    victim = victim_of(policy, in_world, grid, name=None, actions=actions)
    given = chosen("attack", attack, "driving")
    allowed = threat_of(threat, victim, ())
    if threat is None and not allowed.allows(given.component.access):
        allowed = replace(allowed, access=given.component.access)
    pair = Pair(
        attack=given, defense=chosen("defense", defense, "driving"), victim=victim, world=in_world, threat=allowed
    )
    form = Form(in_world.component.facts, observation)
    truth = form.shown()
    session = Session(pair, pair.network(0), [grid.cells()[0]] * len(truth), seed)
    shown, clean, taken = session.show(truth)
    size = (shown.observation - truth).abs().flatten(1).amax(1)
    return Attacked(
        observation=form.back(shown.observation, truth),
        queries=form.each(shown.queries),
        gradients=form.each(shown.gradients),
        size=form.each(size),
        excess=form.each(shown.excess),
        clean=form.each(clean),
        taken=form.each(taken),
        milliseconds=shown.milliseconds,
    )
