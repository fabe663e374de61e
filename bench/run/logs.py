"""Curves of trainings and scores of runs, for TensorBoard, MLflow, Weights & Biases or as CSV, by TorchRL's own loggers."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cavbench.core import registry
from cavbench.errors import UserError

NEEDS = {"tensorboard": "tensorboard", "mlflow": "mlflow", "wandb": "wandb", "csv": ""}
"""The kinds of log, each with the package that it needs."""
FOLDER = "logs"
STEPS = 1000
"""Steps of a whole training: its share is the only time that all trainings have."""
VALUE = re.compile(r"([A-Za-z_][A-Za-z_ ]*?)\s+(-?\d+(?:\.\d+)?(?:e-?\d+)?)(?![\w.%])")
"""A name and its number in what a training says of its progress: `safe_progress 0.52`, `loss 0.031`."""


def check(kind: str) -> None:
    """Refuse a kind of log that does not exist, or whose package is not installed.

    Raises:
        UserError: says what to choose or to install.
    """
    if kind not in NEEDS:
        raise UserError(registry.unknown(f"log {kind!r}", kind, list(NEEDS)))
    if NEEDS[kind] and find_spec(NEEDS[kind]) is None:
        raise UserError(f"log={kind} needs the package {NEEDS[kind]}: pip install {NEEDS[kind]}, or choose log=csv")


class Log:
    """A log of one training or run: numbers with their steps, and what they are of.

    Args:
        kind: a key of `NEEDS`.
        folder: the folder of logs.
        name: of this training or run.
        settings: what it is of, as text by name.
    """

    def __init__(self, kind: str, folder: Path, name: str, settings: Mapping[str, object]) -> None:
        from torchrl.record.loggers import get_logger

        check(kind)
        self._started = time.perf_counter()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            options = {"wandb_kwargs": {"save_dir": str(folder)}}
            self._logger: Any = get_logger(kind, str(folder), name, **options)
            self._logger.log_hparams({key: str(value) for key, value in settings.items()})
        # What a service of others raises is of any kind.
        except Exception as error:
            raise UserError(f"log={kind} cannot be written to {folder}: {str(error).splitlines()[0]}") from error

    def numbers(self, values: Mapping[str, float | None], step: int = 0) -> None:
        """Log some numbers; those that are not known are left out."""
        for name, value in values.items():
            if value is not None:
                self._logger.log_scalar(name, float(value), step=step)

    def progress(self, share: float, text: str) -> None:
        """Log the numbers in what a training says of its progress (`cavbench.core.contracts.Progress`), and the time."""
        said = {name.strip().replace(" ", "_"): float(value) for name, value in VALUE.findall(text)}
        self.numbers({"seconds": time.perf_counter() - self._started, **said}, round(STEPS * share))

    def close(self) -> None:
        """Write what is not written yet."""
        writer = getattr(self._logger, "experiment", None)
        for name in ("flush", "finish"):
            if callable(end := getattr(writer, name, None)):
                end()


def log_card(log: Log, card: Mapping[str, Any]) -> None:
    """Log the checkpoints of a training, and what it cost, from its card."""
    for share, score in card.get("selection_history", ()):
        log.numbers({"checkpoint/score": score}, round(STEPS * share))
    log.numbers({name: value for name, value in card.items() if isinstance(value, int | float)}, STEPS)


def log_pairs(kind: str, folder: Path, pairs: Iterable[Mapping[str, Any]]) -> None:
    """Log the scores of the pairs of a document `run` (`cavbench.documents`): one log a pair, a step a cell.

    Args:
        kind: a key of `NEEDS`.
        folder: the results folder.
        pairs: its `pairs`.
    """
    for one in pairs:
        settings = {name: one[name]["label"] for name in ("attack", "defense", "victim")}
        settings |= {f"threat_{name}": value for name, value in one["threat"].items()} | {"role": one["role"]}
        log = Log(kind, folder / FOLDER, one["card"]["pair"], settings)
        for name in ("score", "clean", "failed", "lead"):
            found = one[name] or {}
            log.numbers(
                {f"{name}{end}": found.get(key) for end, key in (("", "estimate"), ("_low", "low"), ("_high", "high"))}
            )
        log.numbers({"kept": one["kept"], "queries": one["queries"], "wall_s": one["card"]["wall_s"]})
        for step, cell in enumerate(one["cells"]):
            log.numbers({"cells/score": cell["estimate"], "cells/failed": cell.get("failed")}, step)
        log.close()
