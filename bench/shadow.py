"""Reports when a user's file or folder shadows a package of cavbench on the import path."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec

PACKAGES = ("attacks", "defenses", "envs", "leaderboard")
ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))


def check(*packages: str) -> None:
    """Make sure that Python finds cavbench's own packages.

    Args:
        packages: names of the packages; by default those installed beside `bench`.

    Raises:
        ImportError: if another file or folder comes first on the import path; the message is one line.
        SystemExit: instead, in the command `bench` and in `python -m bench`: the line on standard error and exit code 2.
    """
    for name in packages or PACKAGES:
        if line := _shadowed(name, ROOT):
            # While Python looks for a module to run with -m, its first argument is still "-m".
            if os.path.basename(sys.argv[0]) in ("bench", "bench.exe", "-m"):
                print(f"error: {line}", file=sys.stderr)
                sys.exit(2)
            raise ImportError(line)


def explanation(module: str, distribution: str) -> str:
    """Say in one line what shadows a module of a distribution; empty if nothing does.

    Args:
        module: module of an entry point.
        distribution: name of the pip package that ships it.
    """
    from importlib import metadata  # takes 40 ms, which `import bench` can do without

    name = module.partition(".")[0]
    if name in PACKAGES and distribution == "cavbench":
        return _shadowed(name, ROOT)
    try:
        return _shadowed(name, str(metadata.distribution(distribution).locate_file("")), distribution)
    except metadata.PackageNotFoundError:
        return ""


def _shadowed(name: str, root: str, owner: str = "cavbench") -> str:
    candidates = (os.path.join(root, name, "__init__.py"), os.path.join(root, f"{name}.py"))
    expected = {os.path.realpath(path) for path in candidates if os.path.isfile(path)}
    try:
        found = find_spec(name)
    except ValueError:  # a module created by hand has no spec
        return ""
    if not expected or found is None or not found.origin or os.path.realpath(found.origin) in expected:
        return ""
    path = found.origin.removesuffix(f"{os.sep}__init__.py")
    return f"{path} shadows {name!r} of {owner}: rename it, or start Python in another folder"
