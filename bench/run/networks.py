"""The networks of a unit: the hashes of their weights, and whether they are what a score relies on."""

from __future__ import annotations

from collections.abc import Mapping

from cavbench.core.pair import weights_of
from cavbench.core.track import track_of
from cavbench.errors import RefusedNetworkError, UserError, message, reason
from cavbench.isolation.foreign import contained
from cavbench.run.task import Task
from cavbench.run.unit import Unit

Weights = Mapping[str, tuple[str, str]]
"""The hashes of the weights of networks, of the defended victim and of an attack that learns, by `Unit.networks`."""


def hashes(unit: Unit) -> tuple[str, str]:
    """The hashes of the weights of the defended victim, and of an attack that learns (otherwise empty).

    Raises:
        UserError: if a network cannot be loaded.
    """
    return unit.pair.weights_sha256(unit.training_seed), unit.pair.adversary_sha256(unit.training_seed)


def tried(task: Task) -> tuple[tuple[str, str], tuple[str, ...]]:
    """As `hashes`, with what makes the scores doubtful, and the warnings about the network (`Track.try_network`).

    Args:
        task: a loading.

    Raises:
        UserError: if a network cannot be loaded.
        RefusedNetworkError: if its score would be wrong.
        TamperError: if a plug-in did what it may not do.
    """
    # It needs torch, and a plan is made without.
    from cavbench.isolation.watch import TamperError

    pair, seed, doubts = task.pair, task.unit.training_seed, _doubts(task)
    network = pair.network(seed)
    weights = weights_of(network)
    try:
        with contained():
            warnings = track_of(pair).try_network(network, pair, task.cells)
    # Its message has a subject: "it wrote …".
    except TamperError:
        raise
    except UserError as error:
        raise RefusedNetworkError(f"it {message(error)}") from error
    # The network of a stranger may raise anything.
    except Exception as error:
        raise RefusedNetworkError(f"it fails when it is tried: {reason(error)} (--debug shows why)") from error
    lines = (*doubts, *(f"{pair.defended} {line}" for line in warnings))
    return (weights, pair.adversary_sha256(seed)), lines


def _check_scenarios(task: Task) -> None:
    """Raise UserError if a cell has fewer scenarios than episodes: its interval would count some of them several times."""
    world = task.pair.world
    for cell in task.cells:
        there = world.component.scenarios(cell)
        if there is not None and there < task.episodes:
            raise UserError(
                f"world {world} has {there} scenario{'s' if there > 1 else ''} in the cell {cell}, and more episodes would "
                f"repeat them as if they were others: episodes={there}, not {task.episodes}"
            )


def _doubts(task: Task) -> tuple[str, ...]:
    """What makes the scores doubtful, one line each.

    Raises:
        UserError: if the world cannot be driven in its cells.
    """
    world = task.pair.world
    of_world = world.component.doubts(task.cells) if task.asks_world else ()
    if task.asks_world:
        _check_scenarios(task)
    return (*(f"world {world}: {line}" for line in of_world), *track_of(task.pair).doubts(task.pair))
