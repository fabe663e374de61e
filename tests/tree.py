"""The checkout that is tested."""

from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = {"bench": "cavbench", **{name: f"cavbench/{name}" for name in ("attacks", "defenses", "envs", "leaderboard")}}
"""The folders whose contents are installed, and where a wheel has them."""
PLUGINS = ROOT / "tests" / "plugins"
"""Source of plug-ins that tests install or import: sound ones, and ones that break a rule."""
