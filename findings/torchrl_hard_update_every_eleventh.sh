#!/usr/bin/env bash
# One guesses: HardUpdate(loss, value_network_update_interval=10) copies the weights at every tenth call of step().
# What happens: at every eleventh.
# Versions: torch 2.13.0, torchrl 0.14.1. Source: a training that did not match a hand-written one.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy
see <<'P'
import torch
import torchrl
from tensordict.nn import TensorDictModule
from torchrl.data import OneHot
from torchrl.objectives import DQNLoss, HardUpdate

network = torch.nn.Linear(1, 2)
loss = DQNLoss(TensorDictModule(network, in_keys=["observation"], out_keys=["action_value"]), action_space=OneHot(2), delay_value=True)
updater = HardUpdate(loss, value_network_update_interval=10)
copied = []
for call in range(1, 45):
    with torch.no_grad():
        network.bias.fill_(float(call))
        loss.value_network_params["module", "bias"].data.fill_(float(call))
    updater.step()
    if loss.target_value_network_params["module", "bias"][0] == call:
        copied.append(call)
print(f"torchrl {torchrl.__version__}: interval 10, copied at the calls {copied}")
raise SystemExit(copied != [11, 22, 33, 44])
P
