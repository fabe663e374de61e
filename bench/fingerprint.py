"""What a result depends on, as hashes: configurations, source code, library versions."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import platform
from dataclasses import asdict, is_dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

LIBRARIES = ("torch", "torchrl", "tensordict", "highway-env", "numba", "numpy")

BESIDE_THE_RESULT = (
    "cli.py",
    "cli_",
    "config.py",
    "console.py",
    "errors.py",
    "fingerprint.py",
    "metrics.py",
    "pair.py",
    "parameters.py",
    "plan.py",
    "recording",
    "registry.py",
    "replay.py",
    "results.py",
    "runner.py",
    "statistics.py",
    "words.py",
)
"""Files of `bench`, by how their names begin, that choose, store or show results: editing them outdates no record."""


def canonical(value: Any) -> str:
    """The one JSON text of a value: sorted keys, no spaces; dataclasses by their fields, other objects by str()."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    return json.dumps(value, sort_keys=True, separators=(",", ":"), default=str)


def digest(value: Any) -> str:
    """sha256 of the canonical JSON, in hexadecimal."""
    return hashlib.sha256(canonical(value).encode()).hexdigest()


@cache
def source_digest(package: str) -> str:
    """sha256 over names and contents of a top-level package's Python files; of `bench`, those that make results."""
    spec = importlib.util.find_spec(package)
    roots = [Path(root) for root in (spec.submodule_search_locations or ())] if spec else []
    files = {str(path.relative_to(root)): path for root in roots for path in root.rglob("*.py")}
    if spec and spec.origin and not roots:
        files = {Path(spec.origin).name: Path(spec.origin)}
    if package == __name__.partition(".")[0]:
        files = {name: path for name, path in files.items() if not name.startswith(BESIDE_THE_RESULT)}
    return digest({name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()})


@cache
def code_digest(packages: tuple[str, ...]) -> str:
    """`source_digest` of several packages at once, in any order."""
    return digest({package: source_digest(package) for package in packages})


@cache
def libraries() -> dict[str, str]:
    """Versions of Python and of the libraries that compute results."""
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in LIBRARIES}}


@cache
def machine() -> str:
    """System, processor and cores, as far as Python knows them."""
    return f"{platform.system()} {platform.machine()} {_processor()}, {os.cpu_count()} cores"


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
