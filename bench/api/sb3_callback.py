"""Robust scores during a training with Stable-Baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

try:
    from stable_baselines3.common.callbacks import BaseCallback
except ImportError as error:
    raise ImportError("RobustEvalCallback needs Stable-Baselines3: pip install stable-baselines3") from error

from cavbench.api.robust_eval import PREFIX, RobustEval
from cavbench.errors import UserError

if TYPE_CHECKING:
    from torchrl.record.loggers.common import Logger


class RobustEvalCallback(BaseCallback):
    """Scores the model under attacks every `eval_freq` steps, and logs it: `model.learn(100_000, callback=RobustEvalCallback())`.

    The scores go to the model's own logger (TensorBoard with `tensorboard_log=`), as `robust/ATTACK/safe_progress` and
    `robust/score`, the lowest one.

    Args:
        eval_freq: calls of `env.step` between two evaluations.
        best_model_save_path: folder for `best_model.zip`, the model with the highest `robust/score`; None saves none.
        logger: another logger of `torchrl.record.loggers` that gets the scores, such as MLflow's or W&B's.
        options: arguments of `cavbench.api.robust_eval.RobustEval`: `attack`, `world`, `threat`, `episodes`, axes.
    """

    def __init__(
        self,
        eval_freq: int = 10_000,
        *,
        best_model_save_path: str | Path | None = None,
        logger: Logger | None = None,
        **options: Any,
    ) -> None:
        super().__init__()
        if eval_freq < 1:
            raise UserError(f"eval_freq must be at least 1, got {eval_freq}")
        self.eval_freq, self.eval = eval_freq, RobustEval(**options)
        self.folder = None if best_model_save_path is None else Path(best_model_save_path)
        self.other = logger
        self.history: list[tuple[int, dict[str, float]]] = []
        """The scores of each evaluation, with the number of steps before it."""
        self.best = -1.0

    def _on_step(self) -> bool:
        if self.n_calls % self.eval_freq:
            return True
        scores = self.eval.scores(self.model)
        self.history.append((self.num_timesteps, scores))
        for name, value in scores.items():
            self.logger.record(name, value)
            if self.other is not None:
                self.other.log_scalar(name, value, step=self.num_timesteps)
        self.logger.dump(self.num_timesteps)
        if (own := scores.get(f"{PREFIX}/score", -1.0)) > self.best:
            self.best = own
            if self.folder is not None:
                self.folder.mkdir(parents=True, exist_ok=True)
                self.model.save(self.folder / "best_model.zip")
        return True
