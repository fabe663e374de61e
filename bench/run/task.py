"""Tasks and their outcomes: what one process is asked to do, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import pyarrow as pa

from cavbench.core.pair import Pair
from cavbench.run.unit import Unit
from cavbench.scenarios import Cell

Step = Literal["load", "prepare", "drive"]


class Tell(Protocol):
    """Is told how far a task is.

    Args:
        task: its name.
        share: share done, in [0, 1].
        text: of an attack that is prepared.
        episodes: of the units of the task; 0 while something is prepared.
    """

    def __call__(self, task: str, share: float, text: str, episodes: int = 0) -> None: ...


@dataclass(frozen=True, kw_only=True)
class Task:
    """Something to do, with everything that it needs.

    Args:
        unit: the unit to drive, or the one for which something is loaded or prepared.
        step: `load` loads the networks of its pair once, before anything is driven, to hash and to try them; `prepare` makes its
            artefact; `drive` drives it.
        artefacts: contents of the files of the units' artefacts, by `Unit.artefact`.
        recorded: scenario seeds of the episodes to record.
        entropy: seed of the probes of a replay; None draws one, which nobody can foresee.
        others: units to drive in the same batch (`cavbench.run.batches`).
        cells: of a loading, the cells of the run, whose observations the network is tried on.
        episodes: of a loading, how many each of these cells has.
        asks_world: of a loading, whether to ask the world, too, what it doubts about these cells; one loading of a world does.
    """

    unit: Unit
    step: Step = "drive"
    artefacts: Mapping[str, bytes] = field(default_factory=dict)
    recorded: Sequence[int] = ()
    entropy: int | None = None
    others: Sequence[Unit] = ()
    cells: tuple[Cell, ...] = ()
    episodes: int = 0
    asks_world: bool = False

    @property
    def pair(self) -> Pair:
        """The pair of its units."""
        return self.unit.pair

    @property
    def units(self) -> tuple[Unit, ...]:
        """All its units."""
        return (self.unit, *self.others)

    @property
    def each(self) -> list[Task]:
        """A task for each of its units."""
        return [replace(self, unit=unit, others=()) for unit in self.units] if self.others else [self]

    def __str__(self) -> str:
        pair, seed = self.pair, self.unit.training_seed
        match self.step:
            case "load":
                named = str(pair) if pair.attack.component.learns else pair.defended
                return f"{named}, seed {seed}" if pair.is_seeded else named
            case "prepare":
                noun = self.unit.track.artefact[0] if self.unit.track.artefact else "preparation"
                return f"{pair} | {noun}, seed {seed}"
            case _:
                return str(self.unit)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a task may use.

    Args:
        seconds: wall time; 0 for no limit.
        memory_gb: memory of its process and all that it started in GB, with files in memory and temporary files; 0 for no limit.
    """

    seconds: float = 0.0
    memory_gb: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a task: its results, or why it has none.

    Args:
        wall_s: wall time in seconds; of several units in one batch, each has its share.
        records: of a unit that was driven, its records with their provenance; otherwise None.
        artefact: of a preparation, the content of its file; otherwise None.
        weights: of a loading, the hashes of the networks; otherwise None.
        recordings: contents of the `.rrd` files of a unit, by scenario seed.
        warnings: problems that do not affect the records.
        others: the outcomes of the task's other units, in their order; empty if these have none of their own.
        last: whether the settings of its process were changed, which must do no other task.
        why: of a task that failed, one line, which continues its name: "failed: …" or "is refused: …"; otherwise empty.
        lost: whether it hung, ended its process, or used up its memory: a few of these and its pair is given up.
        died: whether it ended its process.
        bad_input: whether it failed because of the options or the files of the user.
        tampered: whether it changed its process, which must do no other task.
        trace: the traceback of what failed, for --debug.
    """

    wall_s: float = 0.0
    records: pa.Table | None = None
    artefact: bytes | None = None
    weights: tuple[str, str] | None = None
    recordings: Mapping[int, bytes] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    others: Sequence[Outcome] = ()
    last: bool = False
    why: str = ""
    lost: bool = False
    died: bool = False
    bad_input: bool = False
    tampered: bool = False
    trace: str = ""

    @property
    def failed(self) -> bool:
        """Whether it has no results."""
        return bool(self.why)

    def __getstate__(self) -> dict[str, Any]:
        """Records travel in Arrow's own format: unpickling a table takes eight times as long, column by column."""
        if self.records is None:
            return vars(self)
        sink = pa.BufferOutputStream()
        with pa.ipc.new_stream(sink, self.records.schema) as stream:
            stream.write_table(self.records)
        return vars(self) | {"records": sink.getvalue().to_pybytes()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        if (sent := state["records"]) is not None:
            with pa.ipc.open_stream(sent) as stream:
                state = state | {"records": stream.read_all()}
        vars(self).update(state)
