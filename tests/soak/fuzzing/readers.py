"""Every reader of files that others wrote, with a valid file to start from and what changes it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import pickle
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from hypothesis import strategies as st
from torch import Tensor, nn

from cavbench import attacks, bounded, leaderboard, zoo
from cavbench.archive import Archive
from cavbench.core.pair import choose
from cavbench.core.suites import Suite
from cavbench.core.track import tracks
from cavbench.detection.patch import Evolution, Patch
from cavbench.detection.victims import yolov5_file
from cavbench.detection.victims.from_file import _check
from cavbench.detection.victims.yolov5 import YOLOv5Network
from cavbench.driving.victims.dqn import DQN
from cavbench.driving.victims.networks import QPolicy
from cavbench.envs.camera.world import StopSignApproach
from cavbench.envs.highway.world import HighwayWorld
from cavbench.errors import UserError
from cavbench.formats.onnx_file import whole
from cavbench.formats.pickled import floats
from cavbench.records import reading
from cavbench.records.store import FOLDER
from cavbench.records.table import plain
from cavbench.run import received
from cavbench.run.config import plan_of, training_of
from cavbench.run.submission import DESCRIPTION, FORMAT
from tests.detection.victims import test_from_file as detectors
from tests.driving.victims import policy_files as drivers
from tests.formats import test_onnx_files as models
from tests.soak.fuzzing.changes import (
    changed,
    changed_json,
    changed_onnx,
    changed_safetensors,
    changed_table,
    changed_words,
    damaged,
)

Files = Mapping[str, bytes]
FACTS, CAMERA = HighwayWorld().facts, StopSignApproach().facts
DATA = Path(leaderboard.__file__).parent / "data"
ATTACKS = Path(attacks.__file__).parent / "driving"
TINY = DQN(hidden=8)
SEED = 3


@dataclass(frozen=True, kw_only=True)
class Reader:
    """A reader of foreign files.

    Args:
        name: what the table calls it.
        make: the valid files, by their paths in a folder.
        change: what changes one of them, by the ending of its name.
        read: reads the files in a folder, and uses what it found as the program does.
        refusals: what it may raise.
        guarded: whether the program reads such a file in a copy of its process first.
        mend: makes what states the hash of a changed file fit again.
    """

    name: str
    make: Callable[[], Files]
    change: Mapping[str, Callable[[bytes], st.SearchStrategy[bytes]]]
    read: Callable[[Path], object]
    refusals: tuple[type[Exception], ...] = (UserError,)
    guarded: bool = False
    mend: Callable[[Files], Files] | None = None

    def valid(self) -> Files:
        """The valid files; made once."""
        return _made(self.name)

    @property
    def files(self) -> st.SearchStrategy[Files]:
        """The valid files with one of them changed."""
        return _changed(self)


@cache
def _made(name: str) -> Files:
    return READERS[name].make()


@st.composite
def _changed(draw: Any, reader: Reader) -> Files:
    valid = reader.valid()
    name = draw(st.sampled_from(sorted(one for one in valid if one.endswith(tuple(reader.change)))))
    structure = next(change for end, change in reader.change.items() if name.endswith(end))
    content = draw(st.one_of(structure(valid[name]), structure(valid[name]), damaged(valid[name])))
    files = {**valid, name: content}
    return reader.mend(files) if reader.mend and draw(st.integers(0, 3)) else files


def _written(write: Callable[[Path], object], name: str) -> Files:
    with TemporaryDirectory() as folder:
        write(Path(folder) / name)
        return {
            path.relative_to(folder).as_posix(): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()
        }


def _unit(data: str, rows: int) -> tuple[str, pa.Table]:
    """The records of a unit that ships with the project."""
    table = pq.read_table(DATA / data)
    unit = table["unit"][0].as_py()
    return unit, plain(reading.read_file(DATA / data)).filter(pa.compute.equal(table["unit"], unit)).slice(0, rows)


def _records(data: str) -> Files:
    unit, table = _unit(data, 3)
    return _written(lambda path: (path.parent.mkdir(), pq.write_table(table, path)), f"{FOLDER}/{unit}.parquet")


def _read_records(folder: Path) -> None:
    """Read records as tables do, and as leaderboards do: what the latter refuses, the former refuses, too.

    Not the other way round: a leaderboard does not read lists.
    """
    numbers = {field.name for track in tracks() for field in track.measurements if not pa.types.is_list(field.type)}
    said = []
    for reads in (reading.read_all, lambda out: reading.read_all(out, numbers)):
        try:
            said.append({name: table.num_rows for name, table in reads(folder).items()})
        except UserError as error:
            said.append(str(error))
    if isinstance(said[0], dict) and isinstance(said[1], str):
        raise AssertionError(f"one reader says {said[0]}, the other {said[1]}")
    if isinstance(said[0], str):
        raise UserError(said[0])


def _submission() -> Files:
    unit, table = _unit("standard-v2/ddpg.parquet", 3)
    files = _written(lambda path: (path.parent.mkdir(), pq.write_table(table, path)), f"{FOLDER}/{unit}.parquet")
    about = {
        "format": FORMAT,
        "pair": table["pair"][0].as_py(),
        "track": "driving",
        "packages": ["cavbench 0.1.0"],
        "training_seeds": [0],
        "commands": {"install": "pip install cavbench==0.1.0", "run": "bench run", "verify": "bench verify FOLDER"},
        "environment": {"machines": ["x"], "libraries": [{"torch": "2.13.0"}]},
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }
    return {**files, DESCRIPTION: json.dumps(about).encode()}


def _rehashed(files: Files) -> Files:
    """The description with the hashes of the files, if it can be read."""
    try:
        about = json.loads(files[DESCRIPTION])
        about["files"] = {
            name: hashlib.sha256(content).hexdigest() for name, content in files.items() if name != DESCRIPTION
        }
        return {**files, DESCRIPTION: json.dumps(about).encode()}
    except (ValueError, TypeError, KeyError, RecursionError):
        return files


def _read_submission(folder: Path) -> None:
    with received.received(folder) as found:
        received.installed(found)


def _drives(name: str, file: str, **values: object) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        path = str(folder / file)
        victim = choose("victim", name, path=path, **values).component
        policy = victim._loaded(FACTS, bounded.sha256(Path(path), most=bounded.WEIGHTS))
        if policy.scores(torch.zeros(3, 10, 5)).shape[0] != 3:
            raise AssertionError("it does not answer for three observations")

    return read


def _detects(file: str) -> Callable[[Path], object]:
    def read(folder: Path) -> None:
        path = folder / file
        victim = choose("victim", "detector", path=str(path), names=str(folder / "names.txt")).component
        names, sha256 = victim.class_names(), bounded.sha256(path, most=bounded.WEIGHTS)
        _check(victim, names, sha256)
        victim.read(names, sha256)

    return read


class Linear(nn.Module):
    """A small policy."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(50, 5)

    def forward(self, observation: Tensor) -> Tensor:
        answer: Tensor = self.linear(observation.flatten(1))
        return answer


def _onnx_policy() -> Files:
    tensor = models.helper.make_tensor("w", 1, [50, 5], np.linspace(-1, 1, 250, dtype=np.float32))
    return {"policy.onnx": models.model(tensor).SerializeToString()}


def _onnx_beside() -> Files:
    """A model with its matrix in another file."""
    weights = np.linspace(-1, 1, 250, dtype=np.float32).tobytes()
    return {"policy.onnx": models.model(models.beside(dims=(50, 5))).SerializeToString(), "weights": weights}


def _read_whole(folder: Path) -> None:
    """The bytes that are run must be the same when they are read again."""
    content = whole(folder / "policy.onnx", "policy.onnx")
    again = folder / "again.onnx"
    again.write_bytes(content)
    if whole(again, "again.onnx") != content:
        raise AssertionError("the bytes that are hashed are read otherwise")


def _yolov5() -> Files:
    torch.manual_seed(0)
    network = YOLOv5Network("n", ("stop sign", "car")).eval()
    return _written(lambda path: yolov5_file.save(network, path), "own.safetensors")


def _yolov5_pickled() -> Files:
    """A checkpoint with the classes of the original code, which are not there when it is read."""
    package, module = ModuleType("models"), ModuleType("models.yolo")
    module.DetectionModel = type("DetectionModel", (nn.Module,), {"__module__": "models.yolo"})  # type: ignore[attr-defined]
    sys.modules |= {"models": package, "models.yolo": module}
    try:
        model = module.DetectionModel()
        model.model = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4))
        model.names = {0: "stop sign", 1: "car"}
        return _written(lambda path: torch.save({"epoch": -1, "model": model, "ema": None}, path), "own.pt")
    finally:
        del sys.modules["models"], sys.modules["models.yolo"]


def _read_yolov5(folder: Path) -> None:
    path = next(folder.iterdir())
    if path.suffix == ".pt":
        yolov5_file.read(path)
    else:
        choose("victim", "yolov5", path=str(path)).component.load(0, CAMERA)


def _patch() -> Files:
    steps = torch.arange(2)
    evolution = Evolution(steps, torch.zeros(2, 3, 8, 8, dtype=torch.uint8), {"stop": torch.zeros(2)})
    return {"patch.safetensors": Patch(torch.rand(3, 8, 8), queries=5, seconds=1.5, evolution=evolution).written("{}")}


def _read_patch(folder: Path) -> None:
    patch = Patch.read((folder / "patch.safetensors").read_bytes())
    if Patch.read(patch.written("{}")).sha256 != patch.sha256:
        raise AssertionError("it is another patch when it is written and read again")


def _zoo() -> Files:
    recipe = zoo.Recipe.of(TINY)
    torch.manual_seed(SEED)
    with TemporaryDirectory() as folder:
        zoo.save(QPolicy(5, 5, TINY.hidden), recipe, seed=SEED, world=HighwayWorld(), card={}, root=Path(folder))
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in Path(folder).rglob("*.*")}


def _carded(files: Files) -> Files:
    """The card with the hash of the weights, if it can be read."""
    name = next(one for one in files if one.endswith(".json"))
    weights = next(content for one, content in files.items() if one.endswith(".safetensors"))
    try:
        card = json.loads(files[name]) | {"sha256": hashlib.sha256(weights).hexdigest()}
        return {**files, name: json.dumps(card).encode()}
    except (ValueError, TypeError, RecursionError):
        return files


def _read_zoo(folder: Path) -> None:
    os.environ["CAVBENCH_ZOO"] = str(folder)
    policy = TINY.load(SEED, FACTS)
    policy.scores(torch.zeros(3, 10, 5))
    zoo.missing(zoo.Recipe.of(TINY), 9)


def _array() -> Files:
    return {"array": base64.b64encode(pickle.dumps(np.zeros((2, 50), np.float32)))}


def _read_array(folder: Path) -> None:
    text = (folder / "array").read_bytes().decode("latin-1")
    if floats(text, 50) is None:
        raise UserError("no array")


@st.composite
def _pickled(draw: Any, content: bytes) -> bytes:
    return base64.b64encode(draw(damaged(base64.b64decode(content))))


def _zipped() -> Files:
    return {
        "own.zip": Archive(_written(lambda path: torch.save([torch.zeros(4)], path), "x")["x"], "x")
        .repacked()
        .getvalue()
    }


def _read_zip(folder: Path) -> None:
    """An archive that was taken is read as the same members when it is packed again, and by torch's reader."""
    archive = Archive.read(folder / "own.zip")
    if Archive(archive.repacked().getvalue(), "again").members != archive.members:
        raise AssertionError("it has other members when it is packed again")


def _suite() -> Files:
    path = ATTACKS / "standard-2.toml"
    return {path.name: path.read_bytes()}


def _named(outcome: Callable[[Path], object]) -> Callable[[Path], object]:
    return lambda folder: outcome(next(folder.iterdir()))


def _words() -> Files:
    run = [*RUN_WORDS, "attack.steps=3", "threat.queries=10", "victim=dqn,ppo", "lanes=3,4", "seeds=0,1", "out=results"]
    train = ["victim=dqn", "defense=advtrain", "victim.hidden=16", "world.vehicles=3", "seeds=0", "out=zoo"]
    return {"run": "\0".join(run).encode(), "train": "\0".join(train).encode()}


RUN_WORDS = ("attack=pgd", "density=1.5", "weather=clear", "episodes=4", "workers=2", "record=0", "reference=false")


def _read_words(folder: Path) -> None:
    for name, reads in (("run", plan_of), ("train", training_of)):
        reads((folder / name).read_bytes().decode("utf-8", "surrogateescape").split("\0"))


def _json() -> Files:
    return {"own.json": _submission()[DESCRIPTION]}


NAMES = {"names.txt": b"car\nstop sign\n"}
READERS: Mapping[str, Reader] = {
    reader.name: reader
    for reader in (
        Reader(
            name="records of driving",
            make=lambda: _records("standard-v2/ddpg.parquet"),
            change={"": changed_table},
            read=_read_records,
        ),
        Reader(
            name="records of detection",
            make=lambda: _records("approach-v1/fcos.parquet"),
            change={"": changed_table},
            read=_read_records,
        ),
        Reader(
            name="submission",
            make=_submission,
            change={".json": changed_json, ".parquet": changed_table},
            read=_read_submission,
            mend=_rehashed,
        ),
        Reader(name="words of run and train", make=_words, change={"": changed_words}, read=_read_words),
        Reader(name="JSON", make=_json, change={"": changed_json}, read=_named(bounded.read_json)),
        Reader(name="zip", make=_zipped, change={"": changed}, read=_read_zip),
        Reader(
            name="ONNX, a driver",
            make=_onnx_policy,
            change={"": changed_onnx},
            read=_drives("onnx", "policy.onnx"),
            guarded=True,
        ),
        Reader(name="ONNX with a file beside it", make=_onnx_beside, change={".onnx": changed_onnx}, read=_read_whole),
        Reader(
            name="ONNX, a detector",
            make=lambda: _written(lambda path: detectors.onnx_file(path), "own.onnx") | NAMES,
            change={".onnx": changed_onnx, ".txt": damaged},
            read=_detects("own.onnx"),
            guarded=True,
        ),
        Reader(
            name=".pt2, a driver",
            make=lambda: _written(lambda path: drivers.torch_file(path, Linear()), "policy.pt2"),
            change={"": changed},
            read=_drives("torch", "policy.pt2"),
            guarded=True,
        ),
        Reader(
            name=".pt2, a detector",
            make=lambda: _written(lambda path: detectors.torch_file(path), "own.pt2") | NAMES,
            change={".pt2": changed, ".txt": damaged},
            read=_detects("own.pt2"),
            guarded=True,
        ),
        Reader(
            name="Stable-Baselines3",
            make=lambda: _written(lambda path: drivers.sb3_file(path, "ppo", net_arch=[8]), "ppo.zip"),
            change={"": changed},
            read=_drives("sb3", "ppo.zip"),
            guarded=True,
        ),
        Reader(name="pickled array", make=_array, change={"": _pickled}, read=_read_array),
        Reader(name="YOLOv5, safetensors", make=_yolov5, change={"": changed_safetensors}, read=_read_yolov5),
        Reader(name="YOLOv5, .pt", make=_yolov5_pickled, change={"": changed}, read=_read_yolov5),
        Reader(name="patch", make=_patch, change={"": changed_safetensors}, read=_read_patch),
        Reader(
            name="zoo",
            make=_zoo,
            change={".json": changed_json, ".safetensors": changed_safetensors},
            read=_read_zoo,
            mend=_carded,
        ),
        Reader(
            name="suite", make=_suite, change={"": damaged}, read=_named(Suite.read), refusals=(ValueError, UserError)
        ),
    )
}
