#!/usr/bin/env bash
# One guesses: a seed gives the same randn on every x86 processor.
# What happens: with AVX2 the logarithm and the cosine are other ones than without. The numbers are equal only to about 1e-7, in float32 alone.
# ATEN_CPU_CAPABILITY=default shows what a processor without AVX2 does. rand, and randn in float64, are equal.
# Versions: torch 2.13.0, on a processor with AVX2. Source: digests of the numbers under both settings.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 numpy
see <<'P'
import os
import subprocess
import sys

import torch

DRAWS = {"rand": "torch.rand(1000)", "randn": "torch.randn(1000)", "randn, float64": "torch.randn(1000, dtype=torch.float64)"}


def drawn(draw, capability):
    code = f"import torch; torch.manual_seed(0); print({draw}.double().tolist())"
    told = os.environ | {"ATEN_CPU_CAPABILITY": capability}
    return eval(subprocess.run([sys.executable, "-W", "ignore", "-c", code], env=told, check=True, capture_output=True, text=True).stdout)


far = {name: max(abs(a - b) for a, b in zip(*(drawn(draw, one) for one in ("default", "avx2")))) for name, draw in DRAWS.items()}
print(f"torch {torch.__version__}: largest difference with and without AVX2 {far}")
raise SystemExit(not (far["rand"] == far["randn, float64"] == 0 < far["randn"] < 1e-5))
P
