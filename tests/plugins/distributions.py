"""Creates installed pip distributions in a folder: modules, and metadata with entry points."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

TOY = Path(__file__).with_name("toy.py")
TOY_CAMERA = TOY.with_name("toy_camera.py")
TOY_POINTS = {
    "cavbench.attacks": {
        "nudge": "toy_plugin:Nudge",
        "veer": "toy_plugin:Veer",
        "paint": "toy_camera_plugin:Paint",
        "blank": "toy_camera_plugin:Blank",
    },
    "cavbench.defenses": {"guard": "toy_plugin:Guard", "harden": "toy_camera_plugin:Harden"},
    "cavbench.victims": {
        "toy": "toy_plugin:ToyVictim",
        "red": "toy_camera_plugin:RedVictim",
        "stop_everywhere": "toy_camera_plugin:CheatingVictim",
    },
    "cavbench.worlds": {
        "toy": "toy_plugin:ToyWorld",
        "bend": "toy_plugin:BendWorld",
        "red_street": "toy_camera_plugin:RedStreet",
    },
    "cavbench.grids": {
        "toy-v1": "toy_plugin:TOY_V1",
        "bend-v1": "toy_plugin:BEND_V1",
        "red-v1": "toy_camera_plugin:RED_V1",
    },
}


def install(
    folder: Path, name: str, points: Mapping[str, Mapping[str, str]], modules: Mapping[str, str], version: str = "1.0"
) -> None:
    """Write a distribution to `folder`, which must be on the import path."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = [
        f"[{group}]\n" + "".join(f"{key} = {at}\n" for key, at in names.items()) for group, names in points.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)


def pip_install(folder: Path, *packages: Path) -> None:
    """Install packages to `folder` with pip, outside of the environment of the tests and without a network."""
    pip = (
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--upgrade",
        "--no-deps",
        "--no-build-isolation",
        "--target",
        folder,
    )
    subprocess.run([*pip, *packages], check=True, capture_output=True, text=True)


def install_toy(folder: Path) -> None:
    """Install the plug-ins of `toy.py` and `toy_camera.py` as the distribution cavbench-toy 1.0."""
    modules = {"toy_plugin": TOY.read_text(), "toy_camera_plugin": TOY_CAMERA.read_text()}
    install(folder, "cavbench-toy", TOY_POINTS, modules)
