"""An audit drives drawn scenarios, finds a defence that knows the public ones, and tells the leaderboard."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest

from cavbench.core import registry
from cavbench.errors import UserError
from cavbench.leaderboard.ranking.boards import read_boards
from cavbench.records import reading
from cavbench.records.schema import AUDIT, IDENTITY
from cavbench.run.audit import SALTS, audit_of
from cavbench.scenarios import SeedBlock
from cavbench.statistics.estimates import Array
from cavbench.statistics.unpaired import NOTABLE, POWER, Finds, finds, unpaired
from tests.command import Said
from tests.plugins.distributions import install
from tests.tree import PLUGINS

KNOWING = PLUGINS / "knowing.py"
ROW = (
    *("attack=pgd", "attack.restarts=1", "attack.steps=5", "victim=dqn", "defense=none,knows", "world.max_steps=150"),
    *(
        "lanes=3",
        "density=1",
        "weather=clear",
        "episodes=20",
        "seeds=0",
        "reference=false",
        "executor=serial",
        "record=0",
    ),
)


@pytest.mark.slow
def test_a_defence_that_knows_the_public_scenarios_is_caught_and_the_honest_victim_is_not(
    bench: Callable[..., Said], plugins: Path, tmp_path: Path
) -> None:
    install(
        plugins,
        "cavbench-knows",
        {"cavbench.defenses": {"knows": "knowing_plugin:Knows"}},
        {"knowing_plugin": KNOWING.read_text()},
    )
    registry.installed.cache_clear()
    out = tmp_path / "results"
    said = bench("audit", *ROW, f"out={out}", "salt=7")
    assert said.code == 1, said.err
    assert "salt=7 repeats or continues this audit" in said.out
    *_, reach, verdict = said.out.strip().splitlines()
    assert re.search(
        r"A public score of .* that is 0\.05 too high is found in \d+ % of audits of this size; episodes=\d+ \(", reach
    )
    assert verdict.startswith("public_only: ")
    assert "knows" in verdict
    assert "none + dqn" not in verdict
    records = reading.read_all(out)
    driving = records["driving"]
    drawn = driving.filter(pc.equal(driving["grid"], AUDIT))
    assert min(drawn["seed"].to_pylist()) == SeedBlock.AUDIT + 7
    assert drawn.num_rows * 2 == driving.num_rows
    (board,), _ = read_boards(records)
    fired = {row.identity["defense"]: {flag.name: flag.fired for flag in row.flags} for row in board.rows}
    assert fired["knows"]["public_only"] is True
    assert fired["none"]["public_only"] is False
    assert all(set(row.worst.scores.shape) == {1, 20} for row in board.rows)


def test_every_audit_draws_other_scenarios_and_can_be_repeated() -> None:
    words = ["attack=noise", "victim=dqn", "episodes=10"]
    first, second = audit_of(words), audit_of(words)
    assert first.drawn.grid.seeds() != second.drawn.grid.seeds()
    again = audit_of([*words, f"salt={first.salt}"])
    assert again.drawn.grid.seeds() == first.drawn.grid.seeds()
    assert again.drawn.grid.cells() == first.public.grid.cells()
    assert first.public.grid.seeds() == range(SeedBlock.REPORT, SeedBlock.REPORT + 10)


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["attack=noise", "salt=abc"], "salt must be one whole number"),
        (["attack=noise", "salt=1", "salt=2"], "salt must be one whole number"),
        (["attack=noise", "episodes=9"], "at least 10 episodes"),
        (["attack=noise_patch", "victim=yolov3_tiny"], "fixed set of scenarios"),
    ],
)
def test_an_audit_that_says_nothing_is_refused(words: list[str], why: str) -> None:
    with pytest.raises(UserError, match=why):
        audit_of(words)


@pytest.mark.parametrize("comparisons", [1, 4])
def test_honest_scores_raise_a_false_alarm_in_2_5_percent_of_audits(comparisons: int) -> None:
    """Scores as on the highway: most episodes crash and score 0, cells and training seeds share the traffic."""
    generator = np.random.default_rng(0)
    alarms = []
    for _ in range(4000):
        traffic = generator.normal(size=(1, 1, 200))
        own = generator.normal(size=(3, 2, 200))
        score = np.clip(0.5 + 0.3 * (traffic + own), 0, 1) * (traffic + own > 0)
        alarms.append(unpaired(score[..., :100], score[..., 100:], comparisons=comparisons).low > 0)
    assert np.mean(alarms) == pytest.approx(0.025 / comparisons, abs=0.008)


def studies(size: int, inflation: float, count: int = 4000) -> Iterator[tuple[Array, Array]]:
    """Public and drawn scores as on the highway, [3, 2, size] each; the public ones are higher by `inflation`."""
    generator = np.random.default_rng(1)
    for _ in range(count):
        traffic = generator.normal(size=(1, 1, 2 * size))
        own = generator.normal(size=(3, 2, 2 * size))
        score = np.clip(0.5 + 0.3 * (traffic + own), 0, 1) * (traffic + own > 0)
        yield score[..., :size] + inflation, score[..., size:]


@pytest.mark.parametrize(("size", "comparisons"), [(10, 1), (30, 1), (60, 6)])
def test_an_audit_says_truly_how_often_it_finds_an_inflation(size: int, comparisons: int) -> None:
    said, found = [], []
    for public, drawn in studies(size, NOTABLE, 2000):
        said.append(finds(public, drawn, comparisons=comparisons).chance)
        found.append(unpaired(public, drawn, comparisons=comparisons).low > 0)
    assert np.mean(said) == pytest.approx(np.mean(found), abs=0.025)


def test_an_audit_of_the_size_that_it_asks_for_finds_it_in_80_percent() -> None:
    asked = [finds(*study) for study in studies(40, 0.0, 300)]
    size = int(np.median([one.scenarios for one in asked]))
    assert size > 200
    larger = [unpaired(*study).low > 0 for study in studies(size, NOTABLE, 600)]
    assert np.mean(larger) == pytest.approx(POWER, abs=0.06)
    smallest = float(np.median([one.smallest for one in asked]))
    assert smallest > NOTABLE
    same = [unpaired(*study).low > 0 for study in studies(40, smallest, 1000)]
    assert np.mean(same) == pytest.approx(POWER, abs=0.06)


def test_scores_that_do_not_vary_hide_no_inflation() -> None:
    assert finds(np.ones((1, 1, 10)), np.ones((1, 1, 12))) == Finds(smallest=0.0, chance=1.0, scenarios=12)


def test_a_difference_needs_the_same_cells_and_enough_scenarios() -> None:
    with pytest.raises(ValueError, match="differ in training seeds or cells"):
        unpaired(np.zeros((1, 2, 10)), np.zeros((1, 3, 10)))
    with pytest.raises(ValueError, match="at least 10 scenarios"):
        unpaired(np.zeros((1, 2, 10)), np.zeros((1, 2, 9)))
    assert unpaired(np.ones((1, 1, 10)), np.zeros((1, 1, 10))).low == 1


def test_every_drawn_seed_can_be_recorded() -> None:
    (seed,) = (column for column in IDENTITY if column.name == "seed")
    assert seed.metadata is not None
    assert float(seed.metadata[b"high"]) > SeedBlock.AUDIT + SALTS
