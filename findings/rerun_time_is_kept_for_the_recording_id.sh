#!/usr/bin/env bash
# One guesses: a new RecordingStream has no time yet, and `rerun rrd compare` finds a file equal to itself.
# What happens: times belong to the thread and the recording_id. A second stream with the id of an earlier one, as one gives it to get equal
# files, logs at the last time of the first. And a file with a NaN differs from itself.
# Versions: rerun-sdk 0.41.0. Source: recordings of several episodes that one process wrote, compared to the last byte.
source "$(dirname "$0")/fresh.sh"
fresh rerun-sdk==0.41.0
see <<'P'
import subprocess
import sys
from pathlib import Path

import rerun as rr

TOOL = str(Path(sys.executable).with_name("rerun"))


def written(name, recording, value, at=None):
    """A file with one scalar, at a time if one is given."""
    stream = rr.RecordingStream("demo", recording_id=recording)
    stream.save(name)
    if at is not None:
        stream.set_time("step", sequence=at)
    stream.log("speed", rr.Scalars(value))
    stream.flush()
    stream.disconnect()


def run(*words):
    return subprocess.run([TOOL, "rrd", *words], capture_output=True, text=True)


written("first.rrd", "one", 1.0, at=7)
written("same.rrd", "one", 2.0)
written("other.rrd", "two", 2.0)
written("nan.rrd", "three", float("nan"))
timed = {name: "index_name: step" in run("print", "-vvv", name).stdout for name in ("first.rrd", "same.rrd", "other.rrd")}
differ = {name: run("compare", name, name).returncode for name in ("first.rrd", "nan.rrd")}
print(f"rerun {rr.__version__}: has a step: {timed}; status of `rrd compare` of a file with itself: {differ}")
raise SystemExit(not (timed == {"first.rrd": True, "same.rrd": True, "other.rrd": False} and differ == {"first.rrd": 0, "nan.rrd": 1}))
P
