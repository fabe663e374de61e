"""Loads the networks of a run before anything is driven. What makes the scores doubtful is said here."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from itertools import chain
from threading import Thread
from typing import Protocol

from cavbench.errors import RefusedNetworkError, UserError, message
from cavbench.run import networks
from cavbench.run.executor import Executor, Watcher
from cavbench.run.failures import Failures
from cavbench.run.networks import Weights
from cavbench.run.plan import Plan
from cavbench.run.task import Task
from cavbench.run.unit import is_foreign


class LoadWatcher(Watcher, Protocol):
    """Receives what is found when networks are loaded."""

    def failed(self, line: str) -> None:
        """A task failed; the run goes on."""

    def warn(self, line: str) -> None:
        """Something went wrong that does not affect the records."""


def load(plan: Plan, back_end: Executor, watcher: LoadWatcher, failures: Failures) -> Weights:
    """The hashes of the networks. Plug-ins are loaded where they are driven, and built-in components if that is this machine.

    Args:
        plan: the run.
        back_end: the executor.
        watcher: is told what makes the scores doubtful.
        failures: collects what failed.

    Raises:
        UserError: if a network is missing.
        UnfinishedError: if no requested pair can be driven.
    """
    weights: dict[str, tuple[str, str]] = {}
    doubts: dict[str, None] = {}
    elsewhere = []
    for task in plan.loadings:
        if (back_end.beside and task.unit.track.tries_beside) or any(is_foreign(part) for part in task.pair.parts):
            elsewhere.append(task)
            continue
        try:
            weights[task.unit.networks], found = networks.tried(task)
        except RefusedNetworkError as error:
            raise UserError(f"{task} is refused: {message(error)}") from error
        doubts |= dict.fromkeys(found)
    with _digesting(plan, elsewhere), closing(back_end.map(elsewhere, watcher)) as finished:
        for task, outcome in chain.from_iterable(finished):
            if outcome.weights is not None:
                weights[task.unit.networks] = outcome.weights
                doubts |= dict.fromkeys(outcome.warnings)
            elif outcome.bad_input:
                raise UserError(f"{task} {outcome.why}")
            elif line := failures.add(task, outcome):
                watcher.failed(line)
    for line in doubts:
        watcher.warn(line)
    if not plan.can_drive(weights):
        raise failures.error((), 0)
    return weights


@contextmanager
def _digesting(plan: Plan, elsewhere: Sequence[Task]) -> Iterator[None]:
    """Hash the code of the units, which the next step needs, while this process waits for networks that load elsewhere."""

    def digest() -> None:
        # What is wrong with a source is said when its units are made.
        with suppress(Exception):
            for unit in plan.first_units():
                _ = unit.code_digest

    hashing = Thread(target=digest)
    if elsewhere:
        hashing.start()
    try:
        yield
    finally:
        if elsewhere:
            hashing.join()
