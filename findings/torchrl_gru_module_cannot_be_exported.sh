#!/usr/bin/env bash
# One guesses: what can be exported with an LSTMModule can be exported with a GRUModule, which is the simpler of the two.
# What happens: the LSTMModule is exported with a dynamic batch. The GRUModule raises, strict or not: its code asks whether any episode begins,
# where the LSTMModule uses torch.where.
# Versions: torch 2.13.0, torchrl 0.14.1, tensordict 0.14.3. Source: met while exporting recurrent policies.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy
see <<'P'
import torch
import torchrl
from tensordict import TensorDict
from torchrl.modules import GRUModule, LSTMModule

batch = {0: torch.export.Dim("batch")}


class Called(torch.nn.Module):
    def __init__(self, kind):
        super().__init__()
        self.module = kind(input_size=4, hidden_size=3, in_key="observation", out_key="hidden", python_based=True)
        self.states = self.module.in_keys[1:-1]

    def forward(self, observation, first, *states):
        entries = {"observation": observation, "is_init": first, **dict(zip(self.states, states))}
        return self.module(TensorDict(entries, batch_size=observation.shape[:1]))["hidden"]


found = {}
for kind, states in ((LSTMModule, 2), (GRUModule, 1)):
    given = (torch.rand(2, 4), torch.zeros(2, 1, dtype=torch.bool), *[torch.rand(2, 1, 3) for _ in range(states)])
    shapes = {"observation": batch, "first": batch, "states": tuple(batch for _ in range(states))}
    for strict in (True, False):
        try:
            torch.export.export(Called(kind), given, dynamic_shapes=shapes if strict else None, strict=strict)
            found[kind.__name__, strict] = "exported"
        except Exception as error:
            found[kind.__name__, strict] = type(error).__name__
print(f"torchrl {torchrl.__version__}, torch {torch.__version__}:", {f"{k}, strict={s}": v for (k, s), v in found.items()})
gru = [value for (kind, _), value in found.items() if kind == "GRUModule"]
raise SystemExit(not (found["LSTMModule", True] == "exported" and "exported" not in gru))
P
