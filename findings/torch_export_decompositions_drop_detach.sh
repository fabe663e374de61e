#!/usr/bin/env bash
# One guesses: run_decompositions writes the same program with fewer operations. It has the same answers, so the same gradients.
# What happens: `detach` and blocks of `no_grad` are dropped: the gradient goes through what was held fixed. It is twice as large here.
# Versions: torch 2.13.0. Source: comparing attacks on an exported program before and after it was prepared for another runtime.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch


class Detached(torch.nn.Module):
    def forward(self, x):
        return (x.detach() * x).sum()


class Fixed(torch.nn.Module):
    def forward(self, x):
        with torch.no_grad():
            scale = x * 3
        return (scale * x).sum()


def gradient(function):
    x = torch.full((1,), 2.0, requires_grad=True)
    function(x).backward()
    return x.grad.item()


def gradients(module):
    """Of the module, of its program, and of that after decompositions."""
    program = torch.export.export(module, (torch.ones(1),))
    return [gradient(one) for one in (module, program.module(), program.run_decompositions().module())]


seen = {"detach": gradients(Detached()), "no_grad": gradients(Fixed())}
print(f"torch {torch.__version__}: gradients of the module, of its program, and after run_decompositions: {seen}")
raise SystemExit(seen != {"detach": [2.0, 2.0, 4.0], "no_grad": [6.0, 6.0, 12.0]})
P
