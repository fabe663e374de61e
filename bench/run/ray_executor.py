"""Carries out tasks on the machines of a Ray cluster. Nothing is shared but the cluster: no disk.

On every core a Ray actor keeps one worker process (`cavbench.run.worker`), so that time and memory limits, what components print,
and plug-ins that end their process are treated as on one machine. cavbench and the plug-ins must be installed on every machine.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import socket
import time
from collections.abc import Generator, Iterable
from dataclasses import dataclass
from typing import Any

from cavbench.errors import UserError, short
from cavbench.isolation import tree
from cavbench.run.executor import NEWS_S, Finished, Retries, Watcher
from cavbench.run.process import cores
from cavbench.run.task import Limits, Outcome, Task
from cavbench.run.worker import Worker, packed

NO_CORES_S = 120.0
"""Seconds to wait for a core of the cluster before the run is given up."""
ANSWER_S = 20.0
"""Seconds that the head of a cluster may take to answer."""
LOST = 5
"""A task whose machine was lost this often has failed."""


class Host:
    """In an actor: keeps a worker process, and gives it one task after the other.

    Args:
        limits: of each task.
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.worker: Worker | None = None
        self.told: list[tuple[str, float, str, int]] = []

    def ready(self) -> bool:
        """Answers when the actor has a core."""
        return True

    def progress(self) -> list[tuple[str, float, str, int]]:
        """The progress of a preparation since the last call."""
        told, self.told = self.told, []
        return told

    def carry_out(self, content: bytes) -> tuple[bytes, list[str]]:
        """The outcome of a task from `packed`, pickled, and what it printed."""
        worker = self.worker or Worker(self.limits)
        self.worker = worker
        worker.give(content)
        while True:
            worker.wait(NEWS_S)
            for item in worker.news():
                if not isinstance(item, Outcome):
                    self.told.append(item)
                    continue
                lines = worker.lines()
                if worker.spent:
                    worker.close()
                    self.worker = None
                return pickle.dumps(item, pickle.HIGHEST_PROTOCOL), lines


def _check_answers(address: str) -> None:
    """Raise UserError if nothing answers at HOST:PORT: Ray itself tries for minutes."""
    if address in ("local", "auto"):
        return
    host, colon, port = address.rpartition(":")
    if not (host and colon and port.isascii() and port.isdecimal()):
        raise UserError(f"ray.address must be local, auto or HOST:PORT, got {short(address)}")
    try:
        socket.create_connection((host.rpartition("/")[2], int(port)), ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"there is no Ray cluster at ray.address={address}: {error}") from None


@dataclass(eq=False)
class _Actor:
    """An actor as the driver sees it: `pending` is the answer that it owes."""

    handle: Any
    pending: Any
    task: Task | None = None
    progress: Any = None


class RayExecutor:
    """Carries out the tasks on a Ray cluster, one worker a core; machines may join and leave.

    Args:
        workers: most workers; None for all cores of the cluster.
        limits: of each task.
        address: `local` starts a cluster on this machine, `auto` finds the running one; else HOST:PORT of its head.

    Raises:
        UserError: if Ray is not installed, or there is no cluster at that address.
    """

    beside = False

    def __init__(self, workers: int | None, limits: Limits, address: str) -> None:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        try:
            import ray
        except ImportError:
            raise UserError("executor=ray needs Ray: pip install 'cavbench[ray]'") from None
        self.ray, self.limits, self.most = ray, limits, workers
        self.actors: list[_Actor] = []
        self.looked = -math.inf
        own = {"num_cpus": workers or cores(), "include_dashboard": False} if address == "local" else {}
        self.started = not ray.is_initialized()
        if self.started:
            _check_answers(address)
            try:
                with tree.ours():
                    ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **own)
            # Ray has many ways of saying that nothing answers.
            except Exception as error:
                line = str(error).strip().splitlines()[0]
                raise UserError(f"there is no Ray cluster at ray.address={address}: {line}") from error
        self.size = self._cores()
        self.make = ray.remote(num_cpus=1, max_concurrency=2, max_restarts=0)(Host)

    def map(self, tasks: Iterable[Task], watcher: Watcher) -> Generator[list[Finished], None, None]:
        waiting, retries = iter(tasks), Retries()
        lost: dict[int, int] = {}
        alive = time.monotonic()
        following: Task | None = retries.next(waiting)
        try:
            while following is not None or any(actor.task for actor in self.actors):
                ended: list[Finished] = []
                self._grow()
                for actor in self._idle():
                    while following is not None and actor.task is None:
                        content = packed(following)
                        if isinstance(content, Outcome):
                            ended.append((following, content))
                        else:
                            actor.task = following
                            actor.pending = actor.handle.carry_out.remote(content)
                        following = retries.next(waiting)
                watcher.working([actor.task for actor in self.actors if actor.task])
                for actor, answer in self._answers(watcher):
                    alive = time.monotonic()
                    task, actor.task = actor.task, None
                    if answer is None:
                        self.actors.remove(actor)
                        if task is not None and lost.setdefault(id(task), 1) >= LOST:
                            why = f"failed: the machine that drove it was lost {LOST} times"
                            ended += retries.ended(task, Outcome(why=why, lost=True), (), watcher)
                        elif task is not None:
                            lost[id(task)] += 1
                            retries.put_back(task)
                    elif task is not None:
                        ended += retries.ended(task, pickle.loads(answer[0]), answer[1], watcher)
                if ended:
                    yield ended
                following = following or retries.next(waiting)
                if any(actor.task for actor in self.actors):
                    alive = time.monotonic()
                elif time.monotonic() - alive > NO_CORES_S:
                    raise UserError(f"the Ray cluster has had no free core for {NO_CORES_S:g} seconds")
        finally:
            # Those still busy were stopped by the caller.
            for actor in [actor for actor in self.actors if actor.task]:
                self._kill(actor)

    def _cores(self) -> int:
        there = int(self.ray.cluster_resources().get("CPU", 0))
        return min(self.most or there, there)

    def _grow(self) -> None:
        """An actor for every core of the cluster; those of new machines, too. Asking the cluster takes as long as a task."""
        if time.monotonic() - self.looked < NEWS_S and self.actors:
            return
        self.looked = time.monotonic()
        while len(self.actors) < self._cores():
            handle = self.make.remote(self.limits)
            self.actors.append(_Actor(handle, handle.ready.remote()))

    def _idle(self) -> list[_Actor]:
        return [actor for actor in self.actors if actor.pending is None]

    def _answers(self, watcher: Watcher) -> list[tuple[_Actor, Any]]:
        """The actors that answered, with their answers; None for those that were lost."""
        owed = {actor.pending: actor for actor in self.actors if actor.pending is not None}
        if not owed:
            time.sleep(NEWS_S)
            return []
        done, others = self.ray.wait(list(owed), num_returns=1, timeout=NEWS_S)
        more = self.ray.wait(others, num_returns=len(others), timeout=0)[0] if done and others else []
        found = []
        for reference in [*done, *more]:
            actor = owed[reference]
            actor.pending = None
            found.append((actor, self._answer(reference)))
        if not found:
            self._ask(watcher)
        return found

    def _answer(self, reference: Any) -> Any:
        try:
            return self.ray.get(reference)
        except (self.ray.exceptions.RayActorError, self.ray.exceptions.ObjectLostError):
            return None

    def _ask(self, watcher: Watcher) -> None:
        """Pass on the progress of the tasks."""
        for actor in self.actors:
            if actor.task is None:
                continue
            if actor.progress is not None and self.ray.wait([actor.progress], timeout=0)[0]:
                for told in self._answer(actor.progress) or ():
                    watcher.preparing(*told)
                actor.progress = None
            actor.progress = actor.progress or actor.handle.progress.remote()

    def _kill(self, actor: _Actor) -> None:
        self.actors.remove(actor)
        self.ray.kill(actor.handle)

    def close(self) -> None:
        for actor in list(self.actors):
            self._kill(actor)
        if self.started:
            # Ray's agents end by themselves, a minute later.
            tree.OURS.update(tree.identities(os.getpid()))
            self.ray.shutdown()
