#!/usr/bin/env bash
# One guesses: randn(16) begins with the numbers of randn(8), as rand(16) does with those of rand(8). Or, eight draws of randn(3) are randn(8, 3).
# What happens: tensors of 16 and more elements are filled by another method, which takes the uniform numbers in another order. So noise for a
# batch is not the noise of its rows, and a batch of five rows of three features begins otherwise than one of six.
# Versions: torch 2.13.0, on the processor. Source: a comparison of sizes; rand, and numpy's standard_normal, do not depend on the size.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch


def drawn(draw, *size):
    torch.manual_seed(0)
    return draw(*size).flatten()


def begins(draw):
    """The sizes whose first number is not that of 64."""
    return [size for size in range(1, 64) if drawn(draw, size)[0] != drawn(draw, 64)[0]]


torch.manual_seed(0)
rows = torch.cat([torch.randn(3) for _ in range(8)])
equal = torch.equal(rows, drawn(torch.randn, 8, 3))
print(f"torch {torch.__version__}: randn begins otherwise for sizes {begins(torch.randn)[0]} to {begins(torch.randn)[-1]}, rand for "
      f"{begins(torch.rand)}; eight draws of randn(3) are randn(8, 3): {equal}")
raise SystemExit(begins(torch.randn) != list(range(1, 16)) or begins(torch.rand) != [] or equal)
P
