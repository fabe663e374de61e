#!/usr/bin/env bash
# One guesses: DiscreteActor and DiscreteActorPolicy of Tianshou 2 fit each other as they come.
# What happens: by default the actor returns probabilities and the policy takes them for logits, so the softmax is taken twice. With five
# actions the likeliest one has at most e / (e + 4) = 0.405, however sure the network is, and the policy samples in eval mode: a policy that
# knows its action takes another one in six of ten steps. softmax_output=False is needed.
# Versions: tianshou 2.0.1, torch 2.13.0. Source: met while training policies in a driving environment.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 tianshou==2.0.1 numpy
see <<'P'
from importlib.metadata import version

import gymnasium
import numpy as np
import torch
from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
from tianshou.data import Batch
from tianshou.utils.net.common import Net
from tianshou.utils.net.discrete import DiscreteActor

torch.manual_seed(0)
seen = {}
for options in ({}, {"softmax_output": False}):
    net = Net(state_shape=(3,), hidden_sizes=[8])
    actor = DiscreteActor(preprocess_net=net, action_shape=5, **options)
    with torch.no_grad():
        for weight in actor.parameters():
            weight.zero_()
        last = [layer for layer in actor.last.modules() if isinstance(layer, torch.nn.Linear)][-1]
        last.bias[2] = 50.0
    policy = DiscreteActorPolicy(actor=actor, action_space=gymnasium.spaces.Discrete(5)).eval()
    found = policy(Batch(obs=np.zeros((2000, 3), np.float32), info={}))
    seen[str(options or "defaults")] = found.dist.probs.max().item(), float((found.act == 2).float().mean())
print(f"tianshou {version('tianshou')}, one logit 50 above the others: probability and share of that action in eval mode", seen)
(likeliest, share), (sure, always) = seen.values()
raise SystemExit(not (abs(likeliest - 0.40461) < 1e-3 and share < 0.5 and sure > 0.999 and always == 1))
P
