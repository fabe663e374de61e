"""Makes pip distributions in a folder, as installed: modules and the metadata that entry points are read from."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

TOY = Path(__file__).with_name("toy.py")
TOY_POINTS = {
    "cavbench.attacks": {"nudge": "toy_plugin:Nudge", "steer": "toy_plugin:Steer"},
    "cavbench.defenses": {"guard": "toy_plugin:Guard"},
    "cavbench.victims": {"toy": "toy_plugin:ToyVictim"},
    "cavbench.worlds": {"toy": "toy_plugin:ToyWorld"},
}


def install(
    folder: Path, name: str, points: Mapping[str, Mapping[str, str]], modules: Mapping[str, str], version: str = "1.0"
) -> None:
    """Write a distribution to `folder`, which is found once the folder is on the import path."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = [
        f"[{group}]\n" + "".join(f"{key} = {at}\n" for key, at in names.items()) for group, names in points.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)


def install_toy(folder: Path) -> None:
    """The plug-ins of `toy.py`, as the distribution cavbench-toy 1.0."""
    install(folder, "cavbench-toy", TOY_POINTS, {"toy_plugin": TOY.read_text()})
