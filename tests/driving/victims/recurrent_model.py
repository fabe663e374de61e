"""Writes recurrent_ppo.zip and recurrent_ppo.json, a model of sb3-contrib and what its `predict` answers.

    pip install torch==2.13.0 stable-baselines3==2.9.2 sb3-contrib==2.9.2 && python tests/driving/victims/recurrent_model.py

The tests read the file without sb3-contrib. It was trained for a few steps on random observations of the highway's shape.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

HERE = Path(__file__).parent
STEPS, EPISODES = 12, 8


class Random(gymnasium.Env[Any, Any]):
    """Random observations of the highway's shape; the actions earn what is random, too."""

    observation_space = gymnasium.spaces.Box(-1, 1, (10, 5), np.float32)
    action_space = gymnasium.spaces.Discrete(5)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action: Any) -> Any:
        self.steps += 1
        return self._seen(), float(self.np_random.random()), False, self.steps > 20, {}

    def _seen(self) -> Any:
        seen = self.np_random.uniform(-1, 1, (10, 5)).astype(np.float32)
        seen[:, 0] = 1
        return seen


def main() -> None:
    from sb3_contrib import RecurrentPPO

    torch.set_num_threads(1)
    policy = {"lstm_hidden_size": 6, "n_lstm_layers": 2, "net_arch": [8]}
    model = RecurrentPPO("MlpLstmPolicy", Random(), n_steps=16, batch_size=16, seed=0, policy_kwargs=policy).learn(32)
    torch.manual_seed(0)
    with torch.no_grad():
        for name, weight in model.policy.named_parameters():
            weight.copy_(torch.zeros_like(weight) if "bias" in name else 0.5 * torch.randn(weight.shape))
    model.save(HERE / "recurrent_ppo.zip")
    shown = np.random.default_rng(0).uniform(-1, 1, (STEPS, EPISODES, 10, 5)).astype(np.float32)
    state, actions, start = None, [], np.ones(EPISODES, bool)
    for one in shown:
        action, state = model.predict(one, state, start, deterministic=True)
        actions.append(action.tolist())
        start = np.zeros(EPISODES, bool)
    (HERE / "recurrent_ppo.json").write_text(json.dumps({"actions": actions}) + "\n")


if __name__ == "__main__":
    main()
