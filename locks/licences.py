"""Prints the licence of every installed distribution; fails if one is neither permissive nor allowed here, with a reason.

    make licences

A distribution states its licence itself. What it contains besides (the FFmpeg in OpenCV is LGPL) stands in its own files.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from importlib import metadata

STRONG = re.compile(
    r"\b(A?GPL|GNU|SSPL|EUPL|CC[- ]BY[- ]NC)|General Public|Non-?commercial|Proprietary|Commons Clause", re.I
)
"""Words of licences that ask for more than to be named."""
ALLOWED: Mapping[str, str] = {
    "pygame-ce": "LGPL-2.1: a library that highway-env imports to draw; nothing of it is changed or shipped",
    "docutils": "public domain and BSD; its Emacs mode and a few tools are GPL, and nothing uses them",
}
STATED: Mapping[str, str] = {
    "torchrl": "MIT",
    # axe-core, which it contains, is MPL-2.0; only tests of the page run it.
    "axe-playwright-python": "MIT",
}
"""Those that state nothing in their metadata, from their licence files."""


def licence(name: str, about: metadata.PackageMetadata) -> str:
    """The licence that a distribution states, as short as it can be said; empty if it states none."""
    if expression := about.get("License-Expression"):
        return str(expression)
    listed = [one.rpartition(" :: ")[2] for one in about.get_all("Classifier") or () if one.startswith("License ::")]
    if listed := [one for one in listed if one != "OSI Approved"]:
        return ", ".join(listed)
    text = str(about.get("License") or "").strip()
    return text.splitlines()[0].strip() if text else STATED.get(plain(name), "")


def complaints(found: Iterable[tuple[str, str]]) -> list[str]:
    """What is wrong with distributions, from their names and licences."""
    lines = []
    for name, text in found:
        if not text:
            lines.append(f"{name} states no licence: read it, and note it in STATED of locks/licences.py")
        elif STRONG.search(text) and plain(name) not in ALLOWED:
            lines.append(f"{name} has the licence {text}: replace it, or allow it in locks/licences.py, with a reason")
    return lines


def plain(name: str) -> str:
    """The name of a distribution, as pip compares names."""
    return re.sub(r"[-_.]+", "-", name).lower()


def main() -> None:
    found = {one.name: licence(one.name, one.metadata) for one in metadata.distributions()}
    rows = sorted(found.items(), key=lambda row: row[0].lower())
    for name, text in rows:
        reason = f"  ({ALLOWED[plain(name)]})" if plain(name) in ALLOWED else ""
        sys.stdout.write(f"{name:32} {text}{reason}\n")
    lines = complaints(rows)
    sys.stdout.write(f"{len(rows)} distributions, {len(lines)} to look at\n")
    if lines:
        raise SystemExit("\n".join(lines))


if __name__ == "__main__":
    main()
