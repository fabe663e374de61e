"""The toy plug-ins on the import path, and the command line as a function."""

from __future__ import annotations

import os
import runpy
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from cavbench.cli import main as cli
from cavbench.core import registry
from cavbench.run import worker
from cavbench.run.process import context
from tests.plugins.distributions import install_toy

BENCH = (sys.executable, "-m", "cavbench")
SETTINGS = {"OMP_NUM_THREADS": "1", "COLUMNS": "160"}
"""Of the environment of a command in a process of its own."""


@pytest.fixture(scope="session")
def toy_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the toy distribution, on the import path of this process."""
    folder = tmp_path_factory.mktemp("site")
    install_toy(folder)
    sys.path.insert(0, str(folder))
    registry.installed.cache_clear()
    yield folder
    sys.path.remove(str(folder))
    registry.installed.cache_clear()


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the import path of this process, for the distributions of a test."""
    folder = tmp_path / "plugins"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    registry.installed.cache_clear()
    yield folder
    registry.installed.cache_clear()


@dataclass(frozen=True)
class Said:
    """The output and the exit code of a command."""

    code: int
    out: str
    err: str


Bench = Callable[..., Said]


@pytest.fixture
def bench(toy_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """The command line in this process: bench("run", "attack=nudge") -> Said."""
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setattr("cavbench.cli.view._has_display", lambda: False)

    def call(*words: str) -> Said:
        monkeypatch.setattr(sys, "argv", ["bench", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        said = capsys.readouterr()
        return Said(int(ended.value.code or 0), said.out, said.err)

    return call


def import_path(*folders: Path) -> str:
    """PYTHONPATH of a process: these folders, then the PYTHONPATH of this process."""
    return os.pathsep.join(filter(None, [*map(str, folders), os.environ.get("PYTHONPATH", "")]))


def started(folder: Path, *words: str) -> subprocess.Popen[str]:
    """Start the command line in a new process, with the plug-ins of `folder`."""
    environment = os.environ | SETTINGS | {"PYTHONPATH": import_path(folder)}

    def hear() -> None:
        """Accept Ctrl-C, which a shell's background job, such as these tests, and its children ignore."""
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    return subprocess.Popen(
        [*BENCH, *words], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=hear
    )


def ran(folder: Path, *words: str, timeout: float = 300) -> Said:
    """Run the command line in a new process, to its end."""
    process = started(folder, *words)
    out, err = process.communicate(timeout=timeout)
    return Said(process.returncode, out, err)


def forked(folders: Iterable[Path], *words: str) -> Said:
    """Run the command line to its end, with the plug-ins of `folders`, in a process that is forked with the imports done."""
    environment = os.environ | SETTINGS
    made = context(worker.__name__, *worker.work_modules())
    with tempfile.TemporaryDirectory() as outputs:
        files = (Path(outputs, "out"), Path(outputs, "err"))
        process = made.Process(target=_command, args=(words, environment, import_path(*folders), Path.cwd(), files))  # type: ignore[attr-defined]
        process.start()
        process.join(timeout=300)
        if process.exitcode is None:
            process.kill()
            pytest.fail(f"bench {' '.join(words)} did not end")
        out, err = (file.read_text() for file in files)
    return Said(process.exitcode, out, err)


def _command(
    words: Sequence[str], environment: Mapping[str, str], paths: str, folder: Path, files: Sequence[Path]
) -> None:
    os.environ.clear()
    os.environ.update(environment | {"PYTHONPATH": paths})
    os.chdir(folder)
    sys.path[:0] = paths.split(os.pathsep)
    for stream, file in enumerate(files, start=1):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), stream)
    sys.argv[:] = ["bench", *words]
    runpy.run_module("cavbench", run_name="__main__")
