#!/usr/bin/env bash
# One guesses: MultiStep(n) looks n steps ahead, so `terminated` of its transitions tells of an end within these n steps.
# What happens: it leaves `terminated` at the first step. DQN's target bootstraps through the end of the episode: the terminal reward is
# summed correctly, and the value of a state that was never reached is added to it.
# Versions: torch 2.13.0, torchrl 0.14.1. Source: a benchmark whose DQN learned that crashes are good.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy
see <<'P'
import torch
import torchrl
from tensordict import TensorDict
from torchrl.data import OneHot
from torchrl.data.postprocs import MultiStep
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

steps, reward = 3, torch.tensor([0.0, 0.0, -1.0])
end = torch.tensor([False, False, True])
td = TensorDict(
    {
        "observation": torch.arange(3.0)[None, :, None],
        "action": torch.tensor([1, 0])[None, None].expand(1, 3, 2).clone(),
        "next": {
            "observation": torch.arange(1.0, 4.0)[None, :, None],
            "reward": reward[None, :, None],
            **{name: end[None, :, None] for name in ("done", "terminated")},
        },
    },
    [1, 3],
)
found = MultiStep(gamma=0.9, n_steps=steps)(td)[:, 0]
values = torch.nn.Linear(1, 2)
with torch.no_grad():
    values.weight.zero_()
    values.bias.copy_(torch.tensor([100.0, 90.0]))
loss = DQNLoss(QValueActor(values, in_keys=["observation"], spec=OneHot(2)), loss_function="l2")
loss.make_value_estimator(gamma=0.9)
target = loss.value_estimator.value_estimate(found, target_params=loss.target_value_network_params).item()
print(
    f"torchrl {torchrl.__version__}: crash at step 3, reward {found['next', 'reward'].item():.2f} of 3 steps, "
    f"terminated {bool(found['next', 'terminated'])}, target {target:.2f} (right: -0.81)"
)
raise SystemExit(not (abs(found["next", "reward"].item() + 0.81) < 1e-5 and abs(target - 72.09) < 0.01))
P
