"""Robust scores during a training: Stable-Baselines3 and TorchRL."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import pytest
import torch
from torchrl.record.loggers.csv import CSVLogger

import cavbench
from cavbench.driving.gym import trial

PGD: dict[str, Any] = {"objective": "margin", "steps": 2, "restarts": 1}
NAMES = {f"robust/{attack}/{what}" for attack in ("noise", "clean") for what in ("safe_progress", "crashed")}


def attacks() -> list[Any]:
    return ["noise", cavbench.component("attack", "pgd", **PGD)]


def logged(folder: Path) -> dict[str, str]:
    return {str(path.relative_to(folder)).partition("scalars/")[2]: path.read_text() for path in folder.rglob("*.csv")}


def test_a_training_of_stable_baselines3_logs_robust_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def counted(*given: Any) -> Any:
        asked.append(given)
        return drive(*given)

    drive = trial._drive
    monkeypatch.setattr(trial, "_drive", counted)
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common.logger import configure

    model = sb3.DQN("MlpPolicy", gymnasium.make("CartPole-v1"), learning_starts=20, seed=0, device="cpu")
    model.set_logger(configure(str(tmp_path / "sb3"), ["csv"]))
    world = cavbench.gym.world("CartPole-v1", max_steps=30)
    callback = cavbench.RobustEvalCallback(
        30, attack=attacks(), world=world, episodes=2, best_model_save_path=tmp_path / "best",
        logger=CSVLogger("own", log_dir=str(tmp_path / "csv")),
    )  # fmt: skip
    model.learn(60, callback=callback)
    assert [steps for steps, _ in callback.history] == [30, 60]
    assert len(asked) == 1, "random steps against the declarations of the world, once"
    scores = callback.history[-1][1]
    assert set(scores) > NAMES
    attacked = [value for name, value in scores.items() if name.endswith("safe_progress") and "clean" not in name]
    assert scores["robust/score"] == min(attacked)
    assert "robust/score" in (tmp_path / "sb3" / "progress.csv").read_text()
    assert any("robust" in name for name in logged(tmp_path / "csv"))
    assert sb3.DQN.load(tmp_path / "best" / "best_model.zip").policy is not None


@pytest.mark.slow
def test_a_trainer_of_torchrl_logs_robust_scores(tmp_path: Path) -> None:
    from torchrl.collectors import Collector
    from torchrl.envs import GymEnv
    from torchrl.modules import QValueActor
    from torchrl.objectives import DQNLoss
    from torchrl.trainers import Trainer

    torch.manual_seed(0)
    network = torch.nn.Linear(4, 2)
    env = GymEnv("CartPole-v1")
    actor = QValueActor(network, in_keys=["observation"], spec=env.action_spec)
    loss = DQNLoss(actor, action_space=env.action_spec, delay_value=False)
    logger = CSVLogger("own", log_dir=str(tmp_path))
    trainer = Trainer(
        collector=Collector(env, actor, frames_per_batch=20, total_frames=60), total_frames=60, frame_skip=1,
        optim_steps_per_batch=1, loss_module=loss, optimizer=torch.optim.Adam(loss.parameters()), logger=logger,
        progress_bar=False, save_trainer_file=None,
    )  # fmt: skip
    world = cavbench.gym.world("CartPole-v1", max_steps=30)
    hook = cavbench.RobustEvalHook(network, 2, attack=attacks(), world=world, episodes=2)
    hook.register(trainer)
    trainer.train()
    assert len(hook.history) == 1, "in every second of three batches"
    assert set(hook.history[0]) > NAMES
    assert any("robust" in name for name in logged(tmp_path))
    hook.log(logger, step=99)
    assert any("99" in text for text in logged(tmp_path).values())


@pytest.mark.parametrize(("make", "line"), [
    (lambda: cavbench.RobustEvalCallback(0), "eval_freq must be at least 1"),
    (lambda: cavbench.RobustEvalHook(None, 0), "interval must be at least 1"),
    (lambda: cavbench.RobustEvalHook(None, episodes=0), "episodes must be at least 1"),
])  # fmt: skip
def test_numbers_out_of_range_are_refused(make: Any, line: str) -> None:
    pytest.importorskip("stable_baselines3")
    with pytest.raises(cavbench.UserError, match=line):
        make()
