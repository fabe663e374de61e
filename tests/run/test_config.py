"""Options become typed, checked configurations; bad options are refused in one line that says what is allowed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavbench.core.registry import load
from cavbench.envs.highway.axes import STANDARD_V2
from cavbench.errors import UserError
from cavbench.run.config import component, plan_of, training_of
from cavbench.run.plan import Plan

pytestmark = pytest.mark.usefixtures("toy_folder")


def read(line: str) -> Plan:
    return plan_of(line.split())


def test_the_defaults_are_the_clean_dqn_on_the_standard_grid() -> None:
    config = read("")
    (pair,) = config.pairs
    assert (pair.attack.name, pair.defense.name, pair.victim.name, pair.world.name) == (
        "none",
        "none",
        "dqn",
        "highway",
    )
    assert config.grid == STANDARD_V2
    assert (config.seeds, config.out, config.reference, config.record) == (
        tuple(range(10)),
        Path("results"),
        True,
        None,
    )


def test_options_set_every_part_of_the_configuration() -> None:
    config = read(
        "attack=noise defense=advtrain victim=dqn attack.scale=0.5 defense.skip=0.25 lanes=3,4 density=1 weather=clear,rain "
        "episodes=20 threat.norm=linf threat.budget=0.2 world.vehicles=50 seeds=0,1 workers=2 out=some/where record=3"
    )
    (pair,) = config.pairs
    assert (pair.attack.component.scale, pair.defense.component.skip, pair.world.component.vehicles) == (0.5, 0.25, 50)
    assert (pair.threat.norm, pair.threat.budget, pair.threat.access) == ("linf", 0.2, "gradients")
    values = {name: tuple(values) for name, values in config.grid.values.items()}
    assert values == {"lanes": (3, 4), "density": (1.0,), "weather": ("clear", "rain")}
    assert (len(config.grid.seeds()), config.grid.name) == (20, "custom")
    assert (config.seeds, config.workers, config.out, config.record) == ((0, 1), 2, Path("some/where"), 3)


def test_a_grid_in_blocks_keeps_its_name_for_whole_blocks_of_all_cells() -> None:
    config = read("attack=noise grid=standard-v2 episodes=20")
    assert config.grid.name == "standard-v2"
    assert [len(block) for block in config.grid.blocks()] == [10, 10]
    assert config.grid.blocks() == STANDARD_V2.blocks()[:2]
    for words in ("episodes=15", "episodes=40", "lanes=3"):
        assert read(f"attack=noise grid=standard-v2 {words}").grid.name == "custom"
    assert len(read("attack=noise grid=standard-v2 episodes=15").grid.blocks()) == 1
    whole = replace(STANDARD_V2, block=0)
    assert whole.blocks() == (whole.seeds(),)


def test_comma_lists_sweep_over_names_parameters_and_threats() -> None:
    config = read("attack=noise,nudge attack.scale=0.5,1 victim=toy,dqn threat.budget=0.1,0.2 world=toy")
    seen = {
        (pair.attack.name, pair.attack.component.scale, pair.victim.name, pair.threat.budget) for pair in config.pairs
    }
    assert len(config.pairs) == len(seen) == 2 * 2 * 2 * 2
    assert len({pair.id for pair in config.pairs}) == 16


def test_in_a_sweep_a_parameter_is_passed_to_the_components_that_have_it() -> None:
    config = read("attack=noise,nudge attack.pause=0.5 attack.distribution=gaussian victim=toy world=toy")
    noise, nudge = (pair.attack.component for pair in config.pairs)
    assert (noise.distribution, nudge.pause) == ("gaussian", 0.5)


def test_a_budget_may_be_in_per_cent() -> None:
    budgets = [pair.threat.budget for pair in read("attack=noise threat.budget=2%,10%,200%").pairs]
    assert budgets == [0.02, 0.1, 2.0]
    assert read("attack=noise threat.norm=linf threat.budget=2").pairs[0].threat.budget == 2


def test_a_clean_pair_is_the_same_under_every_threat_model() -> None:
    assert len(read("attack=none threat.budget=0.1,0.2").pairs) == 1


def test_a_set_that_no_attack_would_meet_is_refused() -> None:
    given = ["threat.access=dynamics", "threat.dynamics.friction=0.5"]
    with pytest.raises(
        UserError, match=r"attack=none leaves out threat\.dynamics\.friction, as runs without an attack"
    ):
        plan_of(["attack=none", *given])
    clean, attacked = plan_of(["attack=none,noise", *given]).pairs
    assert (clean.attack.name, attacked.threat.dynamics.friction) == ("none", 0.5)


def test_a_path_is_not_parsed() -> None:
    assert plan_of(["out=/some/a,b=c {d}/[e]"]).out == Path("/some/a,b=c {d}/[e]")


def test_plain_text_needs_no_quotes() -> None:
    config = plan_of(["defense=advtrain", "defense.attack_params=steps=3 step_size=0.7"])
    assert config.pairs[0].defense.component.attack_params == "steps=3 step_size=0.7"


@settings(deadline=None, max_examples=20)
@given(pause=st.floats(0, 1e6), scale=st.floats(1e-6, 1), mood=st.sampled_from(["calm", "raise", "kill"]))
def test_records_are_read_as_written(pause: float, scale: float, mood: str) -> None:
    values = {"pause": repr(pause), "scale": repr(scale), "mood": mood}
    assert component("attack", "nudge", values) == load("attack", "nudge")(pause=pause, scale=scale, mood=mood)


BAD = {
    "attack=nois": "unknown attack 'nois'; did you mean 'noise'?",
    "defense=advtran": "unknown defense 'advtran'; did you mean 'advtrain'?",
    "lane=3": "unknown key 'lane'; did you mean 'lanes'?",
    "threat=linf": "unknown key 'threat'",
    "threat.norm=l2": "unknown threat.norm 'l2'; known: relative, linf",
    "threat.budget=-1": "threat.budget must be between 0 and 2, got -1",
    "threat.budget=2": "lets each value change by 200 % of itself: write threat.budget=2% for 2 %, or threat.budget=200% if you",
    "threat.budget=0.1,1": "write threat.budget=1% for 1 %, or threat.budget=100% if you mean that",
    "threat.budget=x%": "threat.budget must be a number, such as 0.1, or per cent, such as 10%, got x%",
    "threat.budget=201%": "threat.budget must be between 0 and 2",
    "threat.budget=much": "threat.budget must be a number, got much",
    "attack=noise attack.steps=3": "unknown parameter attack.steps of noise; known: distribution, scale",
    "attack=noise attack.distribution=normal": "'normal'; did you mean 'uniform'? known: uniform, gaussian",
    "attack=pgd attack.steps=many": "attack.steps must be a whole number, got many",
    "attack=pgd attack.steps=0": "attack 'pgd': ",
    "attack=veer victim=toy": "attack 'veer' does not fit victim 'toy', whose actions are discrete: it needs continuous ones",
    "attack=veer victim=toy victim.actions=continuous threat.access=scores": "needs access 'gradients'",
    "defense=guard": "defense 'guard' needs defense.digits=",
    "lanes=9": "lanes must be a whole number between 2 and 8, got 9",
    "lanes=3.5": "lanes must be a whole number between 2 and 8, got 3.5",
    "lanes=[[3]]": "cannot read 'lanes=[[3]]': a value is one word, or a list a,b,c of them",
    "density=-1": "density must be a number above 0 and at most 4, got -1",
    "density=nan": "density must be a number above 0 and at most 4, got nan",
    "weather=snow": "unknown weather 'snow'; known: clear, rain, fog",
    "weather=night": "unknown weather 'night'; known: clear, rain, fog",
    "episodes=0": "episodes must be between 1 and 10000, got 0",
    "episodes=1000000": "episodes must be between 1 and 10000, got 1000000",
    "episodes=1,2": "episodes takes one value, got 1,2",
    "grid=standard": "unknown grid 'standard' of the world 'highway'; did you mean 'standard-v2'?",
    "grid=approach-v1": "unknown grid 'approach-v1' of the world 'highway'",
    "world.vehicles=0": "world 'highway': vehicles must be between 1",
    "executor=dask": "unknown executor 'dask'; known: serial, processes, ray",
    "workers=0": "workers must be at least 1, got 0",
    "ray.address=auto": "ray.address is of executor=ray: add executor=ray, or leave it out",
    "executor=serial ray.address=local": "ray.address is of executor=ray",
    "seeds=-1": "seeds must be distinct whole numbers of at least 0, got -1",
    "record=31": "record must be between 0 and the 30 episodes, got 31",
    "attack=zo attack=pgd": "attack is given twice; separate its values with commas: attack=a,b",
    "out=a out=b": "out is given twice",
    "seeds=0,0": "seeds has the value '0' twice",
    "lanes=[3,3]": "lanes has the value '3' twice",
    "episodes=${oc.env:HOME}": "a value is plain text on one line",
    "attack=pgd attack.steps=range(1,1000000000)": "attack.steps has more than 1000 values",
    "attack=": "attack has an empty value",
    "zo": "cannot read 'zo': write key=value",
    "+attack=zo": "cannot read '+attack=zo': write key=value",
}


@pytest.mark.parametrize("line", BAD)
def test_bad_options_are_refused_in_one_line(line: str) -> None:
    with pytest.raises(UserError) as raised:
        read(line)
    assert BAD[line] in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_training_takes_one_component_of_each_kind_and_several_seeds() -> None:
    config = training_of(["victim=dqn", "victim.batch=64", "seeds=3"])
    assert (config.victim.component.batch, config.defense.name, config.seeds) == (64, "none", (3,))
    with pytest.raises(UserError, match="one network per seed"):
        training_of(["victim=dqn,ddpg"])
    with pytest.raises(UserError, match=r"unknown key 'threat\.budget'"):
        training_of(["attack=paad", "threat.budget=0.2"])
