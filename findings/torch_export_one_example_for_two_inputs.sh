#!/usr/bin/env bash
# One guesses: a program of torch.export keeps two inputs apart, whatever the example tensors hold.
# What happens: if both examples are one tensor object, as in `h = c = torch.zeros(...)`, the program reads the second input twice and the
# first one never. It is exported and called without a word, and a recurrent network forgets. torch.jit.trace keeps them apart.
# Versions: torch 2.13.0. Source: met while exporting an LSTM policy whose two states were one tensor of zeros.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch


class Both(torch.nn.Module):
    def forward(self, h, c):
        return h + 10 * c


one, other = torch.ones(2), torch.ones(2)
h, c = torch.tensor([1.0, 1.0]), torch.tensor([2.0, 2.0])
right = Both()(h, c)
program = torch.export.export(Both(), (one, one)).module()
apart = torch.export.export(Both(), (one, other)).module()
traced = torch.jit.trace(Both(), (one, one))
print(
    f"torch {torch.__version__}: h + 10 c is {right[0]:g}; exported with one example {program(h, c)[0]:g}, "
    f"with two {apart(h, c)[0]:g}; traced with one {traced(h, c)[0]:g}"
)
raise SystemExit(not (right[0] == 21 and program(h, c)[0] == 22 and apart(h, c)[0] == 21 == traced(h, c)[0]))
P
