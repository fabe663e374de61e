#!/usr/bin/env bash
# One guesses: a program of torch.export has the gradient of its module: a straight-through estimator passes it on, and a hook counts.
# What happens: the backward of a torch.autograd.Function and hooks on tensors are not exported. A policy with rounding, made to have a
# gradient, has none in its file, so attacks by gradients fail; the answers are the same.
# Versions: torch 2.13.0. Source: an attack on a quantised policy that worked on the object and not on its file.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch


class Straight(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x.round()

    @staticmethod
    def backward(ctx, gradient):
        return gradient


class Rounded(torch.nn.Module):
    def forward(self, x):
        return Straight.apply(x).sum()


class Hooked(torch.nn.Module):
    def forward(self, x):
        y = x * 1
        if y.requires_grad:
            y.register_hook(lambda gradient: -gradient)
        return y.sum()


def gradients(module):
    """Of the module, and of its program."""
    found = []
    for one in (module, torch.export.export(module, (torch.ones(2, requires_grad=True),)).module()):
        x = torch.full((2,), 0.3, requires_grad=True)
        one(x).backward()
        found.append(x.grad.tolist())
    return found


seen = {"straight through": gradients(Rounded()), "hook": gradients(Hooked())}
print(f"torch {torch.__version__}: gradients of the module and of its program: {seen}")
raise SystemExit(seen != {"straight through": [[1.0, 1.0], [0.0, 0.0]], "hook": [[-1.0, -1.0], [1.0, 1.0]]})
P
