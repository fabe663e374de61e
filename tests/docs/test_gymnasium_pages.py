"""Every Python example of the pages on gymnasium, as it is but shorter."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.tree import ROOT

SHORTER = {
    "20_000": "60",
    "2_000": "30",
    "learning_starts=200": "learning_starts=20",
    "episodes=20": "episodes=1, baselines=False, out=OUT",
    "episodes=10, **cell": "episodes=1, **cell",
    'log_dir="logs"': "log_dir=OUT",
}
PAGES = ("gymnasium.md", "worlds/gym.md")
"""The first example of the first page, and that with a package, have tests of their own."""
EXAMPLES = [
    pytest.param(code, id=f"{page}-{number}")
    for page in PAGES
    for number, code in enumerate(re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.DOTALL))
    if "cartpole" not in code and "GymWorld)" not in code and (page, number) != ("gymnasium.md", 0)
]


@pytest.mark.slow
@pytest.mark.parametrize("code", EXAMPLES)
def test_the_examples_run(code: str, tmp_path: Path) -> None:
    if "stable_baselines3" in code:
        pytest.importorskip("stable_baselines3")
        code = code.replace('"MlpPolicy", env, seed=0)', '"MlpPolicy", env, seed=0, n_steps=32, batch_size=32)')
    for long, short in SHORTER.items():
        code = code.replace(long, short)
    exec(code, {"__name__": "__main__", "OUT": str(tmp_path)})
