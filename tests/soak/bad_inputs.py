"""Generates bad command lines: each must end with one line of ours and a code other than 0, whatever the seed.

    argvs = bad_inputs(1000, seed=0, folder=tmp_path)      # what follows `bench`

None of them starts a run: each is wrong in a way that is seen before any work.
"""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator
from pathlib import Path

LONG = "x" * 20_000
HOSTILE = (
    "=cmd|' /C calc'!A0",
    "\x1b[2J\x1b]0;owned\x07",
    "\u202egnp.exe",
    "a\nb",
    "\x9b31m",
    "../../etc/passwd",
    "$(id)",
    "`id`",
)
NUMBERS = (
    "-1",
    "nan",
    "inf",
    "-inf",
    "1e999",
    "0x10",
    "1_0",
    "ten",
    "--1",
    "1.5.2",
    "٣",
    "9" * 400,
    "1e-400x",
    "true",
    "null",
)
NESTED = (
    "[[3]]",
    "{a:1}",
    "[",
    "]",
    "[1,[2]]",
    "[1,2",
    "(3)",
    "a:b:c",
    "${oc.env:HOME}",
    "${now:}",
    "${x",
    "range(1,10**9)",
)
KEYS = ("lanes", "density", "episodes", "seeds", "workers", "record", "threat.budget", "threat.queries", "threat.share")
KEYS_OF_PARTS = (
    "attack.steps",
    "attack.scale",
    "attack.restarts",
    "world.max_steps",
    "world.vehicles",
    "victim.hidden",
)
NAMES = ("zo2", "", "None", "dqn ", "torch", "../dqn", "zo:", ":", "art:", "art:nothing", LONG, *HOSTILE)
COMMANDS = ("run", "train", "audit")


def bad_inputs(count: int, *, seed: int, folder: Path) -> Iterator[list[str]]:
    """Yield `count` bad command lines.

    Args:
        count: how many.
        seed: of the generator.
        folder: an existing, empty folder, to which some broken files are written.
    """
    draw = random.Random(seed)
    files = _broken_files(folder, draw)
    makers: list[Callable[[random.Random, list[Path]], list[str]]] = [
        _value,
        _value,
        _name,
        _key,
        _twice,
        _file,
        _file,
        _place,
        _other_command,
        _no_option,
        _submission,
    ]
    for number in range(count):
        yield makers[number % len(makers)](draw, files)


def _value(draw: random.Random, files: list[Path]) -> list[str]:
    """A value that its option does not take."""
    key = draw.choice(KEYS)
    values = [
        value for value in (*NUMBERS, *NESTED, *HOSTILE, LONG) if not (key in ("density", "record") and value == "null")
    ]
    return [draw.choice(("run", "audit")), "attack=noise", f"{key}={draw.choice(values)}x,]"]


def _name(draw: random.Random, files: list[Path]) -> list[str]:
    """A component that there is not."""
    kind = draw.choice(("attack", "defense", "victim", "world", "grid", "executor"))
    return ["run", f"{kind}={draw.choice(NAMES)}?"]


def _key(draw: random.Random, files: list[Path]) -> list[str]:
    """An option that there is not."""
    key = draw.choice(
        (LONG, *HOSTILE, "lane", "attak", "attack.", ".", "a.b.c", "threat.norms", "victim.nothing", "--lanes", "-x")
    )
    return [draw.choice(COMMANDS), f"{key}={draw.choice(('1', 'a', LONG))}"]


def _twice(draw: random.Random, files: list[Path]) -> list[str]:
    """An option or a value given twice."""
    return draw.choice(
        [
            ["run", "out=a", "out=b"],
            ["run", "attack=noise", "attack=pgd"],
            ["run", "seeds=0,0"],
            ["run", "lanes=3,3"],
            ["run", "lanes=[4,4]"],
            ["run", "attack=noise", "ray.address=auto"],
            ["train", "victim=dqn", "seeds=1,1"],
            ["train", "seed=1", "seeds=2", "victim=dqn"],
            ["train", "out=a", "out=a", "victim=dqn"],
            ["report", "out=a", "out=b"],
            ["show", "out=a", "out=b"],
            ["view", "results", "seed=1", "seed=2"],
            ["new", "attack", "mine", "out=a", "out=b"],
        ]
    )


def _file(draw: random.Random, files: list[Path]) -> list[str]:
    """A policy or a detector from a broken file."""
    path = draw.choice(files)
    victims = ["torch"], ["onnx"], ["sb3", "victim.algo=dqn"], ["yolov5"], ["detector"]
    victim, *more = draw.choice(victims)
    return ["run", f"victim={victim}", *more, f"victim.path={path}", "reference=false"]


def _place(draw: random.Random, files: list[Path]) -> list[str]:
    """A file where a folder is needed, or a folder that is not there."""
    file = files[0]
    return draw.choice(
        [
            ["run", "victim=blind", "victim.policy=idle", "reference=false", f"out={file}"],
            ["train", "victim=dqn", f"out={file}"],
            ["render", f"out={file}"],
            ["report", f"html={file}/page.html"],
            ["report", f"html={file.parent}/none/..{'/x' * 200}/{'y' * 300}.html"],
            ["report", f"out={file.parent}/none"],
            ["show", f"out={file.parent}/none"],
            ["show", f"{file.parent}/none"],
            ["view", f"{file.parent}/none", "seed=1"],
            ["view", str(file)],
            ["new", "attack", "mine", f"out={file}"],
        ]
    )


def _submission(draw: random.Random, files: list[Path]) -> list[str]:
    """A submission whose description is no file, has no end, or is no description."""
    folder = files[0].parent / f"submission{draw.randrange(10**9)}"
    folder.mkdir()
    path = folder / "submission.json"
    match draw.randrange(6):
        case 0:
            os.mkfifo(path)
        case 1:
            path.symlink_to(draw.choice(("/dev/zero", "/etc/passwd", "submission.json")))
        case 2:
            path.mkdir()
        case 3:
            with path.open("wb") as file:
                file.truncate(20 * 2**30)
        case 4:
            path.write_text(draw.choice(("[", '{"files":', '{"a":[')) * draw.choice((100, 10**5)))
        case _:
            path.write_bytes(draw.choice(files[:-2]).read_bytes())
    return [
        "verify",
        str(folder),
        *draw.choice(([], ["sample=0"], [f"out={files[0]}"], ["sample=2", f"out={folder}/x"])),
    ]


def _other_command(draw: random.Random, files: list[Path]) -> list[str]:
    """Words that another command takes."""
    word = draw.choice((*HOSTILE, LONG, "nothing"))
    return draw.choice(
        [
            ["list", word],
            ["new", word, "mine"],
            ["new", "attack", word + "?"],
            ["new", "attack", "mine", f"track={word}"],
            ["check", word],
            ["check", "noise", word],
            ["fetch", word],
            ["report", word],
            ["report", "run", word],
            ["show", word + "/none"],
            ["view", word + "/none"],
            ["render", f"world={word}"],
            ["render", word],
            [word],
            ["run", "--" + word.replace("\n", "")],
        ]
    )


def _no_option(draw: random.Random, files: list[Path]) -> list[str]:
    """Words that are no key=value."""
    return [
        draw.choice(COMMANDS),
        draw.choice((*HOSTILE, LONG, "=", "==", "=1", "zo", "+attack=zo", "~attack", "a=b=c", "lanes:3")),
    ]


def _broken_files(folder: Path, draw: random.Random) -> list[Path]:
    """Files of noise, cut archives and texts."""
    contents = [
        b"text",
        b"",
        b"PK\x05\x06" + bytes(18),
        b"PK\x03\x04" + draw.randbytes(200),
        draw.randbytes(1000),
        b"\x80\x04\x95" + draw.randbytes(50) + b".",
        b"\x08\x09" + draw.randbytes(100),
        (2**40).to_bytes(8, "little") + b"{}",
    ]
    names = [
        f"broken{number}{end}"
        for number, end in enumerate((".pt2", ".pt", ".zip", ".onnx", "", ".pkl", ".onnx", ".safetensors"))
    ]
    paths = []
    for name, content in zip(names, contents, strict=True):
        (folder / name).write_bytes(content)
        paths.append(folder / name)
    return [*paths, folder / "none.pt2", folder]
