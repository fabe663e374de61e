#!/usr/bin/env bash
# One guesses: relu6(x), hardtanh(x, 0, 6) and clamp(x, 0, 6) compute the same, so they have the same gradient.
# What happens: at exactly 0 and 6 clamp has 1, relu6 and hardtanh have 0, and minimum and maximum 0.5. Values at the ends are common: black and
# white pixels, saturated sensors, absent cars. There a gradient attack is blind or not by the way in which a clamp is spelled.
# Versions: torch 2.13.0. Source: gradients at the kinks of torch's activations.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch
from torch.nn import functional

SPELLED = {
    "clamp": lambda x: x.clamp(0, 6),
    "relu6": functional.relu6,
    "hardtanh": lambda x: functional.hardtanh(x, 0, 6),
    "minimum(maximum)": lambda x: torch.minimum(torch.maximum(x, torch.tensor(0.0)), torch.tensor(6.0)),
}


def gradient(clamped):
    x = torch.tensor([0.0, 6.0], requires_grad=True)
    clamped(x).sum().backward()
    return x.grad.tolist()


seen = {name: gradient(clamped) for name, clamped in SPELLED.items()}
print(f"torch {torch.__version__}: gradients at 0 and 6 {seen}")
raise SystemExit(list(seen.values()) != [[1, 1], [0, 0], [0, 0], [0.5, 0.5]])
P
