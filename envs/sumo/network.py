"""SUMO's programs and files: the network of a batch, made by netconvert at its first use and kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from platformdirs import user_cache_path

from cavbench.envs.sumo.cars import types
from cavbench.envs.sumo.layouts import LAYOUTS
from cavbench.envs.sumo.roads import Road
from cavbench.errors import UserError
from cavbench.files import scratch, whole

LIBRARIES = ("libsumo", "eclipse-sumo")
"""Distributions of the simulation, and of netconvert."""
VERSION = "1.28"
INSTALL = "pip install 'cavbench[sumo]'"


def check_installed() -> None:
    """Check that SUMO is there, in the version whose traffic the world has.

    Raises:
        UserError: says what to install.
    """
    for name in LIBRARIES:
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            raise UserError(f"world=sumo needs {name} {VERSION}: {INSTALL}") from None
        if version.split(".")[:2] != VERSION.split("."):
            raise UserError(f"world=sumo needs {name} {VERSION}, but {version} is installed: {INSTALL}")


def program(name: str) -> Path:
    """A program of SUMO in the wheel, for instance `netconvert`."""
    home = Path(str(metadata.distribution("eclipse-sumo").locate_file("sumo")))
    return home / "bin" / (f"{name}.exe" if os.name == "nt" else name)


def types_file() -> Path:
    """The file of the types of cars."""
    text = types()
    return _kept(text, "rou.xml") or _keep(text.encode(), text, "rou.xml")


def network_file(layout: str, roads: Sequence[Road]) -> Path:
    """The network with a road of the layout for each of `roads` [R].

    Raises:
        UserError: if netconvert refuses it, or the cache cannot be written.
    """
    parts = LAYOUTS[layout].plain_network(roads)
    key = f"{metadata.version('eclipse-sumo')} {parts}"
    return _kept(key, "net.xml") or _keep(_converted(parts), key, "net.xml")


def _converted(parts: dict[str, str]) -> bytes:
    """netconvert's network of plain XML, by option."""
    with scratch() as folder:
        made, options = folder / "made.net.xml", list[str]()
        for option, text in parts.items():
            path = folder / f"{option.strip('-')}.xml"
            path.write_text(text)
            options += [option, str(path)]
        # Otherwise the coordinates begin at the lower left corner of what is drawn.
        options += ["--offset.disable-normalization", "true", "--output-file", str(made), "--xml-validation", "never"]
        told = subprocess.run(
            [str(program("netconvert")), *options], capture_output=True, text=True, errors="replace", check=False
        )
        if told.returncode or not made.is_file():
            raise UserError(f"netconvert made no network: {complaint(told.stderr)}")
        return made.read_bytes()


def complaint(text: str) -> str:
    """What SUMO says, in one line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line.removeprefix("Error:").strip() for line in lines if line.startswith("Error:")]
    return next(iter(errors or lines[-1:]), "it said nothing")


def _path(key: str, ending: str) -> Path:
    return user_cache_path("cavbench") / "sumo" / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.{ending}"


def _kept(key: str, ending: str) -> Path | None:
    path = _path(key, ending)
    return path if path.is_file() else None


def _keep(content: bytes, key: str, ending: str) -> Path:
    path = _path(key, ending)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as file:
            file.write(content)
    except OSError as error:
        raise UserError(
            f"{path} cannot be written: {error.strerror or error}; set XDG_CACHE_HOME to another folder"
        ) from None
    return path
