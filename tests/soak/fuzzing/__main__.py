"""Fuzzes every reader: `python -m tests.soak.fuzzing minutes=10 only=zip+patch seed=1 keep=FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.soak.fuzzing.campaign import fuzz

if __name__ == "__main__":
    given = dict(word.split("=", 1) for word in sys.argv[1:])
    only = given["only"].split("+") if "only" in given else ()
    keep = Path(given["keep"]) if "keep" in given else None
    for line in fuzz(float(given.get("minutes", "60")), only, int(given.get("seed", "0")) * 10**6, keep):
        print(line, flush=True)  # noqa: T201
