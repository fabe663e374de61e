"""Plug-ins that misbehave, drawn at random: each in a package of its own, when it is imported or when it attacks.

All are in one sweep with two honest attacks. Whatever they do, the sweep must end, name each that failed with its package, and
leave the records of the honest ones as they are without them.
"""

from __future__ import annotations

import random
import re
import time
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc

from cavbench.core.track import track
from cavbench.records import reading
from tests.command import ran
from tests.plugins.distributions import install, install_toy

HONEST = ("noise", "nudge")
WORDS = ("victim=toy", "world=toy", "lanes=3", "density=1", "weather=clear", "episodes=2", "seeds=0", "record=0")
LIMITS = ("reference=false", "workers=2", "unit_timeout=20", "unit_memory=1.5")
TIMES = ("created_at", "wall_s", "attack_ms")
MODULES = (
    *(
        "torch",
        "torch.nn.functional",
        "torch.autograd",
        "numpy",
        "numpy.random",
        "random",
        "json",
        "math",
        "time",
        "os",
    ),
    *("hashlib", "pathlib", "pyarrow", "tensordict", "torchrl.envs.utils", "scipy.stats", "builtins", "threading"),
    *("cavbench.driving.rollout", "cavbench.driving.meter", "cavbench.driving.metrics", "cavbench.records.store"),
    *("cavbench.identity.fingerprint", "cavbench.files", "cavbench.core.registry", "cavbench.run.unit"),
)
"""A deed replaces or deletes a function of one of these."""
SETTINGS = (
    *("sys.setrecursionlimit(len(inspect.stack()) + {small})", "gc.disable()", "os.umask(0o777)", "os.chdir('/')"),
    *("torch.set_default_dtype(torch.float64)", "torch.manual_seed({small})", "torch.set_grad_enabled(False)"),
    *("np.seterr(all='raise')", "np.random.seed({small})", "random.seed({small})", "warnings.simplefilter('error')"),
    *("signal.signal(signal.SIGTERM, signal.SIG_IGN)", "signal.alarm({small} + 1)", "os.nice(5)", "sys.path.clear()"),
    *("os.environ.clear()", "sys.stdout.close()", "sys.stderr.close()", "os.closerange({small}, 4096)"),
    *("sys.settrace(lambda *_: None)", "sys.setswitchinterval(1)", "sys.meta_path.clear()", "sys.modules.clear()"),
    "resource.setrlimit(resource.RLIMIT_NOFILE, ({small}, {small}))",
    "torch.set_num_threads({small} + 1)",
)
ENDS = (
    *("sys.exit({small})", "os._exit({small})", "os.abort()", "os.kill(os.getpid(), signal.SIGKILL)"),
    *(
        "raise KeyboardInterrupt",
        "raise StopIteration",
        "raise RecursionError",
        "raise MemoryError",
        "raise GeneratorExit",
    ),
    *("raise type('Odd', (BaseException,), {{}})()", "time.sleep(600)", "ctypes.string_at({small})"),
)
LEFT = (
    "threading.Thread(target=time.sleep, args=(600,)).start()",
    "threading.Thread(target=time.sleep, args=(600,), daemon=True).start()",
    "atexit.register(time.sleep, 600)",
    "subprocess.Popen(['sleep', '600'])",
    "subprocess.Popen(['sleep', '600'], start_new_session=True)",
    "pathlib.Path('left').write_text('x')",
    "os.fork() or time.sleep(600)",
    "print('x' * 100_000)",
    "os.write(1, b'x' * 100_000)",
)
PLUGIN = """
import atexit, ctypes, gc, importlib, inspect, os, pathlib, random, resource, signal, subprocess, sys, threading, time, warnings
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
import torch
from cavbench.driving import DrivingAttack


def deed():
    {deed}


{at_import}


@dataclass(frozen=True, kw_only=True)
class Attack(DrivingAttack):
    \"\"\"Moves nothing, after its deed.\"\"\"

    access: ClassVar[str] = "oblivious"

    def perturb(self, observation, oracle):
        {at_attack}
        return observation
"""
REPLACED = (
    "there = importlib.import_module({module!r}); names = sorted(n for n in dir(there) if callable(getattr(there, n))"
    " and not n.startswith('_')); setattr(there, names[{place} % len(names)], lambda *_, **__: None)"
)
DELETED = (
    "there = importlib.import_module({module!r}); names = sorted(n for n in dir(there) if callable(getattr(there, n))"
    " and not n.startswith('_')); delattr(there, names[{place} % len(names)])"
)


def plugin(draw: random.Random) -> str:
    """The source of an attack with a random deed."""
    made = draw.choice([draw.choice(SETTINGS), draw.choice(ENDS), draw.choice(LEFT), REPLACED, REPLACED, DELETED])
    deed = made.format(small=draw.randrange(20), module=draw.choice(MODULES), place=draw.randrange(1000))
    at_import, at_attack = draw.choice([("deed()", "pass"), ("", "deed()")])
    return PLUGIN.format(deed=deed, at_import=at_import, at_attack=at_attack)


def sweep(place: Path, count: int, seed: int) -> str:
    """Drive so many plug-ins that misbehave in one sweep, and say what came out of it."""
    site, draw = place / "site", random.Random(seed)
    site.mkdir(parents=True)
    install_toy(site)
    names = [f"rogue_{number}" for number in range(count)]
    deeds = {}
    for name in names:
        deeds[name] = plugin(draw)
        install(site, f"cavbench-{name}", {"cavbench.attacks": {name: f"{name}:Attack"}}, {name: deeds[name]})
    began = time.monotonic()
    attacks = ",".join([HONEST[0], *names, HONEST[1]])
    said = ran(site, "run", f"attack={attacks}", *WORDS, *LIMITS, f"out={place / 'all'}", timeout=60.0 * count)
    seconds = time.monotonic() - began
    alone = ran(site, "run", f"attack={','.join(HONEST)}", *WORDS, *LIMITS, f"out={place / 'alone'}")
    records = reading.read(place / "all", track=track("driving"))
    finished = set(records["attack"].to_pylist())
    errors = [line for line in said.err.splitlines() if line.startswith("error: ")]
    named = {name for name in names if any(f"cavbench-{name} 1.0" in line for line in errors)}
    silent = [name for name in names if name not in finished | named]
    same = _honest(records).equals(_honest(reading.read(place / "alone", track=track("driving"))))
    wrong = [
        f"{name} said nothing: {deeds[name].partition('def deed():')[2].strip().splitlines()[0]}" for name in silent
    ]
    wrong += [] if same else ["the records of the honest attacks differ"]
    wrong += ["a traceback"] if re.search("^Traceback", said.err, re.MULTILINE) else []
    wrong += [] if alone.code == 0 else [alone.err]
    left = _left(place)
    wrong += [f"{len(left)} processes outlived the command: {', '.join(left)}"] if left else []
    return (
        f"{count} plug-ins in {seconds:.0f} s: {len(finished & set(names))} driven, {len(named)} named; "
        f"{'nothing wrong' if not wrong else '; '.join(wrong)}"
    )


def _left(place: Path) -> list[str]:
    """The programs that still run of what plug-ins started, or as copies of the command."""
    found = []
    for listed in Path("/proc").glob("[0-9]*/cmdline"):
        # It may have ended meanwhile.
        with suppress(OSError):
            words = listed.read_text(errors="replace").split("\0")
            if words[:2] == ["sleep", "600"] or any(word.endswith(str(place / "all")) for word in words):
                found.append(words[0])
    return found


def _honest(records: pa.Table) -> pa.Table:
    own = records.filter(pc.is_in(records["attack"], pa.array(HONEST)))
    # What is probed is drawn anew in every run.
    dropped = {*TIMES, *(probe.name for probe in track("driving").probes)}
    return own.select([name for name in own.column_names if name not in dropped])
