"""The options of `bench run` and `bench train` that choose neither a component nor a cell. Importing them is quick."""

from __future__ import annotations

from dataclasses import dataclass, field

from cavbench.run.process import machine_bytes

EXECUTORS = ("serial", "processes", "ray")
"""The names of the back ends (`cavbench.run.executors`)."""


def half_of_memory() -> float:
    """Half of the machine's memory in GB; 0 if it cannot be read."""
    return machine_bytes() / 2e9


def _meaning(meaning: str, default: str, path: str = "") -> dict[str, str]:
    """Metadata of a field: its meaning, its default as help shows it, and of a path whether it is a FOLDER or a FILE."""
    return {"meaning": meaning, "default": default} | ({"path": path} if path else {})


@dataclass
class RayOptions:
    """The options of `executor=ray`."""

    address: str = field(
        default="local",
        metadata=_meaning("Ray cluster: local starts one, auto finds the running one, or HOST:PORT.", "local"),
    )


@dataclass
class RunOptions:
    """The options of `bench run`, with types and defaults."""

    grid: str | None = field(default=None, metadata=_meaning("Named list of scenarios.", "the world's"))
    episodes: int | None = field(default=None, metadata=_meaning("Scenarios in each cell.", "the grid's"))
    seeds: list[int] | None = field(
        default=None, metadata=_meaning("Training seeds of the victims (detectors: patch seeds).", "the grid's")
    )
    executor: str = field(
        default="processes",
        metadata=_meaning("Where units run: processes, ray, or serial (this process).", "processes"),
    )
    workers: int | None = field(default=None, metadata=_meaning("Worker processes.", "one per core"))
    ray: RayOptions = field(default_factory=RayOptions)
    device: str = field(default="cpu", metadata=_meaning("Where victims compute: cpu, cuda (a GPU), or auto.", "cpu"))
    out: str = field(default="results", metadata=_meaning("Results folder.", "results", "FOLDER"))
    record: int | None = field(default=None, metadata=_meaning("Episodes to record in each cell.", "1, in the first"))
    reference: bool = field(default=True, metadata=_meaning("Drive the baselines, too.", "true"))
    shard: str = field(default="1/1", metadata=_meaning("PART/PARTS: 3/10 drives the third of ten parts.", "1/1"))
    unit_timeout: float = field(
        default=3600.0, metadata=_meaning("Seconds that a unit may take; 0 for no limit.", "3600.0")
    )
    unit_memory: float = field(
        default_factory=half_of_memory,
        metadata=_meaning("GB that a worker may use; 0 for no limit.", "half of the machine's"),
    )
    until: float | None = field(
        default=None, metadata=_meaning("Drive in rounds until each score is known to +- this.", "off")
    )
    race: bool | None = field(
        default=None, metadata=_meaning("Only the strongest two of a suite drive all scenarios.", "true")
    )
    config: str | None = field(
        default=None, metadata=_meaning("YAML file with these options, or the folder of a run.", "none", "FILE.yaml")
    )
    fail_below: float | None = field(default=None, metadata=_meaning("Exit code 3 if a pair scores below this.", "off"))
    against: str | None = field(
        default=None, metadata=_meaning("Exit code 3 if a pair is significantly worse than there.", "off", "FOLDER")
    )
    junit: str | None = field(default=None, metadata=_meaning("Write JUnit XML with a case a pair.", "none", "FILE"))
    log: str | None = field(
        default=None, metadata=_meaning("Scores to OUT/logs: tensorboard, mlflow, wandb or csv.", "none")
    )


@dataclass
class TrainOptions:
    """The options of `bench train`, with types and defaults."""

    seeds: list[int] = field(default_factory=lambda: [0], metadata=_meaning("Training seeds.", "0"))
    out: str | None = field(default=None, metadata=_meaning("Zoo to save to.", "your own zoo", "FOLDER"))
    log: str | None = field(
        default=None, metadata=_meaning("Curves to the folder logs: tensorboard, mlflow, wandb or csv.", "none")
    )
