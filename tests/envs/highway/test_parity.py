"""The engine equals highway-env: bit for bit where numpy rounds like scalar code, and closely everywhere."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from numpy._core._multiarray_umath import __cpu_dispatch__ as numpy_kernels  # type: ignore[attr-defined]

from cavbench.envs.highway.axes import AXES
from tests.envs.highway.side_by_side import Case, compare, differences, discrete
from tests.tree import ROOT


def run_exactly(marker: str) -> None:
    """Run `exact_parity.py` in a process whose numpy and BLAS have no AVX-512 kernels."""
    wide = [name for name in numpy_kernels if "AVX512" in name or name == "X86_V4"]
    environment = os.environ | {"NPY_DISABLE_CPU_FEATURES": " ".join(wide), "OPENBLAS_CORETYPE": "Haswell"}
    command = [sys.executable, "-W", "ignore", "-m", "pytest", "-p", "no:cacheprovider", "-m", marker]
    done = subprocess.run(
        [*command, "tests/envs/highway/exact_parity.py"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]


def test_engine_equals_highway_env_bit_for_bit() -> None:
    run_exactly("not slow")


@pytest.mark.slow
def test_engine_equals_highway_env_bit_for_bit_in_long_drives() -> None:
    run_exactly("slow")


def test_engine_is_close_to_highway_env_whatever_numpy_was_built_for() -> None:
    drive = Case(cell=AXES.cell(lanes=4, density=1.0), seeds=(1,), choose=discrete(0, 1, 2, 4), steps=40)
    assert not differences(compare(drive, tolerance=1e-9))
