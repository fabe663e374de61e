from __future__ import annotations

import json

import jsonschema
import pytest

from cavbench import documents
from tests.command import Bench

SMALL = ("lanes=3", "density=1", "weather=clear", "episodes=1", "seeds=0", "world.max_steps=8")


def test_a_row_has_both_bounds_and_the_certified_score(bench: Bench) -> None:
    said = bench("certify", "attack=noise", "defense=sa", "threat.budget=0", *SMALL, "leaves=4")
    assert said.code == 0, said.err
    assert said.out.count("100.0 %") == 2
    assert "at most 4 courses" in said.out


def test_it_says_the_same_to_a_machine(bench: Bench) -> None:
    words = ("certify", "attack=noise", "defense=sa", "threat.budget=0.005", *SMALL, "--json")
    searched, alone = bench(*words, "leaves=4"), bench(*words, "leaves=0")
    assert "certified" in searched.err
    made = [json.loads(said.out) for said in (searched, alone)]
    for one in made:
        jsonschema.Draft202012Validator(documents.schema()).validate(one)
    (proof,), (unsearched,) = (one["pairs"] for one in made)
    assert (made[0]["leaves"], made[0]["cells"], made[0]["scenarios"]) == (4, 1, 1)
    assert 0 <= proof["interval"] <= proof["linear"] == 1
    assert proof["bound"]["estimate"] == proof["clean"]["estimate"] > 0
    assert unsearched["bound"] is None


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("attack=none",), "leave out attack=none"),
        (("leaves=-1",), "leaves must be one whole number"),
        (("leaves=1", "leaves=2"), "leaves must be one whole number"),
        (("attack=noise", "victim=ddpg", *SMALL), "continuous"),
        (("attack=noise_patch", "victim=yolov3_tiny"), "has no bounds of decisions"),
        (("threat.budget=-1",), "budget"),
    ],
)
def test_bad_input_is_one_line(words: tuple[str, ...], line: str, bench: Bench) -> None:
    said = bench("certify", *words)
    assert said.code == 2
    assert line in said.err
