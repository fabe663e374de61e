"""Robust scores during a training: a callback for Stable-Baselines3, and a hook for TorchRL's trainers."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchrl.trainers.trainers import TrainerHookBase

from cavbench.api.scoring import score
from cavbench.core.contracts import Attack, ThreatModel, World
from cavbench.errors import UserError
from cavbench.scenarios import Value

if TYPE_CHECKING:
    from torchrl.record.loggers.common import Logger

PREFIX = "robust"
"""The scores are logged as `robust/ATTACK/METRIC`; without an attack, ATTACK is `clean`."""


class RobustEval:
    """Scores a policy under attacks, as `cavbench.score` does without baselines.

    Args:
        attack: an attack, or a list of them: names or objects.
        world: as in `cavbench.score`.
        threat: the threat model, or a mapping of its parameters.
        episodes: scenarios in each cell. They are in the block of scenarios that selects checkpoints, never the reported one.
        actions: type of actions of a torch network whose output fits both.
        axes: values on the axes of the world.
    """

    def __init__(
        self,
        attack: str | Attack | Sequence[str | Attack] = ("noise", "pgd"),
        *,
        world: str | World | Any = None,
        threat: ThreatModel | Mapping[str, Any] | None = None,
        episodes: int = 10,
        actions: Any = None,
        **axes: Value | Sequence[Value],
    ) -> None:
        if episodes < 1:
            raise UserError(f"episodes must be at least 1, got {episodes}")
        self.attack, self.world, self.threat = attack, world, threat
        self.episodes, self.actions, self.axes = episodes, actions, axes

    def scores(self, policy: Any) -> dict[str, float]:
        """The scores by the name that is logged, and `robust/score`: the lowest one under an attack.

        Raises:
            UserError: in one line, if the policy does not fit.
        """
        from dataclasses import replace

        from cavbench.api.choosing import grid_with, world_of
        from cavbench.scenarios import SeedBlock

        in_world = world_of(self.world, policy)
        grid = replace(grid_with(in_world, None, self.episodes, self.axes), first_seed=SeedBlock.SELECT, name="custom")
        with tempfile.TemporaryDirectory() as folder:
            found = score(
                policy,
                list(self.attack) if isinstance(self.attack, list | tuple) else self.attack,
                world=in_world.component,
                threat=self.threat,
                grid=grid,
                baselines=False,
                out=folder,
                progress=False,
                actions=self.actions,
            )
        logged: dict[str, float] = {}
        attacked = []
        for row in found.to_dict("records"):
            if row["role"] not in ("attacked", "clean"):
                continue
            name = "clean" if row["role"] == "clean" else row["attack"]
            logged[f"{PREFIX}/{name}/safe_progress"] = float(row["safe_progress"])
            logged[f"{PREFIX}/{name}/crashed"] = float(row["crashed"])
            attacked += [float(row["safe_progress"])] if name != "clean" else []
        return logged | ({f"{PREFIX}/score": min(attacked)} if attacked else {})


class RobustEvalHook(TrainerHookBase):
    """Logs robust scores in a training of TorchRL: `RobustEvalHook(policy, 50, attack="pgd").register(trainer)`.

    The trainer's logger gets them: TensorBoard, CSV, MLflow, W&B, whichever of `torchrl.record.loggers` it has. In a loop of
    your own, `hook.log(logger, step)` does the same.

    Args:
        policy: the actor, as in `cavbench.score`; it is scored as it is at that moment.
        interval: batches between two evaluations.
        options: arguments of `RobustEval`.
    """

    def __init__(self, policy: Any, interval: int = 10, **options: Any) -> None:
        if interval < 1:
            raise UserError(f"interval must be at least 1, got {interval}")
        self.policy, self.interval, self.eval = policy, interval, RobustEval(**options)
        self.batches = 0
        self.trainer: Any = None
        self.history: list[dict[str, float]] = []
        """The scores of each evaluation."""

    def __call__(self, batch: Any = None) -> dict[str, float]:
        """The scores in every `interval`-th batch, if no trainer with a logger has them already; otherwise nothing."""
        self.batches += 1
        if self.batches % self.interval:
            return {}
        if self.trainer is not None and self.trainer.logger is not None:
            # Not returned to the trainer, which drops what comes within its `log_interval`.
            self.log(self.trainer.logger, self.trainer.collected_frames)
            return {}
        self.history.append(self.eval.scores(self.policy))
        return dict(self.history[-1])

    def log(self, logger: Logger, step: int | None = None) -> dict[str, float]:
        """Score now, and write to a logger of `torchrl.record.loggers`."""
        self.history.append(self.eval.scores(self.policy))
        for name, value in self.history[-1].items():
            logger.log_scalar(name, value, step=step)
        return dict(self.history[-1])

    def register(self, trainer: Any, name: str = "robust_eval") -> None:
        """Add it to a trainer."""
        self.trainer = trainer
        trainer.register_op("post_steps_log", self)
        trainer.register_module(name, self)

    def state_dict(self) -> dict[str, Any]:
        return {"batches": self.batches}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.batches = state_dict["batches"]
