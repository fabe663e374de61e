#!/usr/bin/env bash
# One guesses: torch.manual_seed takes 64 bits, so seeds that are different give different numbers.
# What happens: on the processor the upper 32 bits are ignored. Seeds s and s + 2**32 give one stream, and initial_seed() still tells them
# apart. Seeds that are put together by shifts, such as (study << 32) + episode, give one stream to all studies.
# Versions: torch 2.13.0. Source: a comparison of seeds that differ in one bit each.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import torch


def drawn(seed):
    return torch.rand(8, generator=torch.Generator().manual_seed(seed))


ignored = [bit for bit in range(63) if torch.equal(drawn(5), drawn(5 ^ 1 << bit))]
print(f"torch {torch.__version__}: bits of a seed that change nothing: {ignored[0]} to {ignored[-1]}")
raise SystemExit(ignored != list(range(32, 63)))
P
