"""Chapter 3 of the thesis beside ours."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator

import pyarrow as pa
import pytest
from rich.console import Console

from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.detection import PatchThreat
from cavbench.leaderboard.comparisons.comparison import NO_ATTACK, parameters
from cavbench.leaderboard.thesis import patch_records, policy_records
from cavbench.leaderboard.thesis.claims import configuration_claims, location_claims
from cavbench.leaderboard.thesis.numbers import printed
from cavbench.leaderboard.thesis.patch_records import (
    ABLATION,
    CONFIGURATIONS,
    CONTROLS,
    LOCATIONS,
    STANDARD,
    VARIED,
    WEATHERS,
    Source,
)
from cavbench.leaderboard.thesis.report import thesis_report
from cavbench.records.schema import schema
from cavbench.run.config import plan_of
from tests.leaderboard.synthetic import approach

Left = float | Callable[[str, str], float]
NONE = schema(track("detection")).empty_table()
SIZES, WEIGHTS = ("patch_32", "patch_64", STANDARD), (STANDARD, "tv_3", "tv_5")
SUN_AND_RAIN = {theirs: (ours, LOCATIONS[1]) for theirs, ours in WEATHERS.items()}


@pytest.fixture(autouse=True)
def nothing_published(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patch_records, "shipped_records", lambda chapter: NONE)
    monkeypatch.setattr(policy_records, "shipped_records", lambda chapter: schema(track("driving")).empty_table())


def patch(row: str = STANDARD, left: Left = 0.1, victim: str = "yolov3_tiny", **more: object) -> pa.Table:
    """Records of the patch of a row."""
    configuration = CONFIGURATIONS[row]
    settings = {"changes": dict(configuration.changes), "budget": configuration.budget, **more}
    return approach(left, victim, attack="eot", **settings)  # type: ignore[arg-type]


def test_the_first_row_is_the_attack_and_the_threat_model_with_their_defaults() -> None:
    defaults = parameters(choose("attack", "eot").params)
    assert {name: defaults[name] for name in VARIED} == VARIED
    assert CONFIGURATIONS[STANDARD].budget == PatchThreat().budget
    assert {name for configuration in CONFIGURATIONS.values() for name in configuration.changes} == set(VARIED)


def controls(victim: str = "yolov3_tiny", left: Left = 0.9, noise: Left = 0.6, **more: object) -> pa.Table:
    """No patch, and both reference patches of every size."""
    tables = [approach(left, victim, **more)]  # type: ignore[arg-type]
    for budget in sorted({configuration.budget for configuration in CONFIGURATIONS.values()}):
        for name, value in (("noise_patch", noise), ("grey_patch", 0.7)):
            tables.append(approach(value, victim, attack=name, budget=budget, **more))  # type: ignore[arg-type]
    return pa.concat_tables(tables)


def everything(victim: str = "yolov3_tiny", **more: object) -> pa.Table:
    patches = [patch(row, 0.05 * place, victim, **more) for place, row in enumerate(CONFIGURATIONS)]
    return pa.concat_tables([controls(victim, **more), *patches])


def report(*tables: pa.Table, width: int = 140) -> str:
    """Chapter 3 of it."""
    out = io.StringIO()
    thesis_report({"detection": pa.concat_tables(tables)} if tables else {}, Console(file=out, width=width))
    return out.getvalue().split("Chapter 4")[0]


def rows_of(text: str, table: str) -> Iterator[str]:
    return (line.strip() for line in text.split(table)[1].split("Table")[0].splitlines())


def claims(*tables: pa.Table) -> list[str]:
    """What is said of leaving out transformations, of size, and of total variation."""
    return [text.plain for text in configuration_claims(Source(pa.concat_tables(tables), NONE), SUN_AND_RAIN)]


def test_every_printed_number_stands_in_its_row() -> None:
    text, numbers = report(), printed()
    static = list(rows_of(text, "Table 3.1"))
    assert len(numbers["static"]["rows"]) == 12
    for row, values in numbers["static"]["rows"].items():
        label = CONFIGURATIONS[row].label.strip() if row in CONFIGURATIONS else "random noise"
        (line,) = (line for line in static if line.startswith(f"{label}  "))
        for name, value in values.items():
            assert (value if name == "label" else f"{value:.{3 if name == 'confidence' else 4}f}") in line
    for weather in WEATHERS:
        part = text.split("Table 3.2")[1].split(f" {weather} ", 1)[1].splitlines()[: len(CONFIGURATIONS) + 6]
        shown = [re.findall(r"\d\.\d{3}", line) for line in part]
        rows = numbers["configurations"]["rows"].values()
        assert len(rows) == 13
        for values in rows:
            assert [f"{values[name]:.3f}" for name in (weather, f"{weather}_median")] in shown
    shown = [line.split() for line in rows_of(text, "Table 3.3")]
    for location in numbers["locations"]["rows"]:
        for weather in WEATHERS:
            place = shown.index(["location", f"{location['location']},", weather])
            patched, noise, _, clean = shown[place + 1 : place + 5]
            for line, row in ((patched, STANDARD), (noise, "noise_patch"), (clean, "none")):
                assert f"{location[row][weather]:.3f}" in line


def test_what_is_derived_from_the_thesis_is_its_own_arithmetic() -> None:
    rain = report().split("Table 3.2")[1].split(" rain ", 1)[1]
    (row,) = (line for line in rain.split("Table 3.3")[0].splitlines() if line.strip().startswith("all transf"))
    assert row.split()[2:6] == ["0.489", "38", "%", "−0.07"]


def test_what_is_missing_is_a_dash_and_a_command_that_makes_it() -> None:
    text = report()
    commands = re.findall(r"missing: (bench run .*)", text)
    made = set()
    for command in commands:
        config = plan_of(command.removeprefix("bench run ").split())
        assert config.grid.values["weather"] == ("clear", "rain")
        assert config.seeds == (0, 1, 2)
        assert config.reference
        for pair in config.pairs:
            identity = {
                "attack": pair.attack.name,
                "attack_params": pair.attack.params,
                "threat_budget": pair.threat.budget,
            }
            made |= {row for row in CONFIGURATIONS if patch_records.is_of(row, identity)}
    assert made == set(CONFIGURATIONS)
    assert len(commands) == len(set(commands)) < len(CONFIGURATIONS)
    assert "missing" not in report(everything())
    assert "cannot be said" in text


def test_what_one_row_lacks_is_all_that_is_asked_for() -> None:
    source = Source(pa.concat_tables([controls(), *(patch(row) for row in CONFIGURATIONS if row != "tv_3")]), NONE)
    (detector,) = source.detectors
    for row in (*CONFIGURATIONS, *CONTROLS):
        source.find(detector, row, "rain")
    assert source.commands() == ["bench run attack=eot victim=yolov3_tiny weather=clear,rain seeds=0,1,2 attack.tv=0.3"]


def test_a_patch_without_a_baseline_is_asked_for_again() -> None:
    source = Source(pa.concat_tables([approach(0.9), patch("patch_32")]), NONE)
    found = source.find(source.detectors[0], "patch_32", "clear")
    assert found is not None
    assert found.of.lead is None
    assert source.commands() == [
        "bench run attack=eot victim=yolov3_tiny weather=clear,rain seeds=0,1,2 attack.texels=32 threat.budget=0.16"
    ]


def test_our_numbers_stand_beside_the_thesis() -> None:
    text = report(everything())
    for table in ("Table 3.1", "Table 3.2"):
        (row, *_) = (line for line in rows_of(text, table) if line.startswith("and no perspective"))
        assert re.search(r"0\.1[5-6] \.[01]\d–\.[1-4]\d +8[2-4] % +−0\.4[4-6]", row), row
    (row, *_) = (line for line in rows_of(text, "Table 3.3") if line.startswith("no patch"))
    assert re.search(r"0\.657.* 0\.(89|9)", row), row


@pytest.mark.parametrize(
    "other",
    [
        patch("tv_3"),
        patch("no_noise"),
        patch("patch_32"),
        patch(budget=0.4),
        patch(defense="jpeg"),
        patch(changes={"hue": 0.1}),
        patch(cells=[cell for cell in plan_of(["victim=yolov3_tiny"]).grid.cells() if cell.weather == "fog"]),
    ],
)
def test_records_of_other_settings_do_not_stand_beside_the_thesis(other: pa.Table) -> None:
    source = Source(pa.concat_tables([controls(), other]), NONE)
    for detector in source.detectors:
        assert source.find(detector, STANDARD, "clear") is None


def test_a_location_has_its_own_approaches_and_all_have_all() -> None:
    left = {"sun-behind-ego": 0.1, "sun-beside": 0.3, "sun-behind-sign": 0.5}
    source = Source(pa.concat_tables([controls(), patch(left=lambda weather, location: left[location])]), NONE)
    (detector,) = source.detectors
    for location, expected in [*left.items(), (None, 0.3)]:
        found = source.find(detector, STANDARD, "rain", location)
        assert found is not None
        assert found.of.score.estimate == pytest.approx(expected, abs=0.02)
        assert {cell.weather for cell in found.of.own.cells} == {"rain"}


def test_the_rows_of_a_table_are_on_the_same_approaches() -> None:
    whole = [approach(0.9), approach(0.6, attack="noise_patch"), approach(0.7, attack="grey_patch"), patch()]
    part = [cell for cell in plan_of(["victim=yolov3_tiny"]).grid.cells() if (cell.lanes, cell.density) == (4, 1)]
    records = pa.concat_tables([*whole, patch("tv_3", cells=part)])
    source = Source(records, NONE)
    found = source.find_all(source.detectors[0], (STANDARD, "tv_3", "tv_5", NO_ATTACK), "rain")
    assert found["tv_5"] is None
    assert {each.of.cells for each in found.values() if each} == {(part[1],)}
    assert part[1].weather == "rain"
    first, second, third = report(records).split("Table 3.")[1:]
    assert all("yolov3_tiny: on the roads 4 × 1 only" in table for table in (first, second))
    assert "on the roads" not in third


def test_a_smaller_patch_is_compared_with_baselines_of_its_own_size() -> None:
    noise = [approach(value, attack="noise_patch", budget=budget) for budget, value in ((0.5, 0.4), (0.16, 0.8))]
    source = Source(pa.concat_tables([approach(0.9), *noise, patch(left=0.3), patch("patch_32", 0.7)]), NONE)
    for row in (STANDARD, "patch_32"):
        found = source.find(source.detectors[0], row, "clear")
        assert found is not None
        assert found.of.lead is not None
        assert found.of.lead.estimate == pytest.approx(-0.1, abs=0.03)


def test_published_records_fill_in_where_they_are_of_the_same_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patch_records, "shipped_records", lambda chapter: everything())
    assert report().count("†") > 20
    tables = pa.concat_tables([controls(), patch()])
    same, other = Source(tables), Source(pa.concat_tables([controls(), patch(changes={"steps": 10})]))
    for source, shipped in ((same, {STANDARD: False, "tv_3": True}), (other, {STANDARD: False, "tv_3": None})):
        (detector,) = source.detectors
        for row, expected in shipped.items():
            found = source.find(detector, row, "clear")
            assert (found.shipped if found else None) == expected
    assert other.commands()[0].endswith("attack.steps=10 attack.tv=0.3")


def test_rows_that_do_not_share_their_settings_are_not_mixed() -> None:
    longer = [patch(row, changes={**CONFIGURATIONS[row].changes, "steps": 300}) for row in (STANDARD, "tv_3")]
    source = Source(pa.concat_tables([controls(), patch(), *longer]), NONE)
    (detector,) = source.detectors
    found = source.find(detector, STANDARD, "clear")
    assert found is not None
    assert parameters(found.of.identity["attack_params"])["steps"] == 300


def test_every_detector_has_its_columns_and_its_commands() -> None:
    own = {"victim_params": {"path": "my detector.pt", "size": "n"}, "world_params": {"bank": "frames"}}
    text = report(everything(), patch(victim="yolov5", **own), width=200)
    (heading, *_) = (line for line in rows_of(text, "Table 3.2") if "thesis" in line)
    assert heading.index("yolov3_tiny") < heading.index("yolov5")
    commands = re.findall(r"missing: bench run (.*)", text)
    asked = "attack=eot victim=yolov5 weather=clear,rain seeds=0,1,2 'victim.path=my detector.pt' victim.size=n world.bank=frames"
    assert commands
    assert all(command.startswith(asked) for command in commands)


def test_a_detector_that_no_patch_was_crafted_for_has_no_column() -> None:
    source = Source(pa.concat_tables([approach(0.9, "yolov5"), patch()]), NONE)
    assert [detector.victim for detector in source.detectors] == ["yolov3_tiny"]


def settings(rows: tuple[str, ...], step: float, first: float = 0.2, runs: int = 3) -> list[pa.Table]:
    """Records of a setting that moves the confidence left by `step` from row to row."""
    return [patch(row, first + step * place, runs=range(runs)) for place, row in enumerate(rows)]


def test_claims_hold_where_every_patch_seed_says_so() -> None:
    assert "sun and rain: Yes, it rises (p = 7.8e-12" in claims(controls(), *settings(tuple(ABLATION), 0.08))[0]
    assert "sun and rain: Yes, it falls" in claims(controls(), *settings(SIZES, -0.09, 0.5))[1]
    for step, direction in ((0.09, "rises"), (-0.09, "falls")):
        assert f"Yes, it {direction}" in claims(controls(), *settings(WEIGHTS, step, 0.4))[2]


def test_claims_are_not_shown_without_a_trend_and_fail_with_the_opposite_one() -> None:
    assert "sun and rain: No, it falls" in claims(controls(), *settings(tuple(ABLATION), -0.08, 0.7))[0]
    assert "No, it rises" in claims(controls(), *settings(SIZES, 0.09))[1]
    up_and_down = [patch(row, left) for row, left in zip(WEIGHTS, (0.3, 0.5, 0.3), strict=True)]
    assert "Not shown, it does not change detectably" in claims(controls(), *up_and_down)[2]


def test_nothing_is_claimed_from_two_patch_seeds_or_without_one_of_the_settings() -> None:
    for records in (settings(SIZES, -0.09, 0.5, runs=2), settings(SIZES, -0.09, 0.5)[1:]):
        assert "sun and rain: It cannot be said" in claims(controls(), *records)[1]


def location_answers(left: Left) -> list[str]:
    source = Source(
        pa.concat_tables([controls(left=lambda weather, _: 0.9 if weather == "clear" else 0.7), patch(left=left)]), NONE
    )
    return [text.plain for text in location_claims(source)]


def test_nothing_is_claimed_of_controls_that_were_not_driven() -> None:
    driven = pa.concat_tables([approach(0.9), approach(0.6, attack="noise_patch"), patch()])
    below, *_ = (text.plain for text in location_claims(Source(driven, NONE)))
    assert "cannot be said: that takes all 3 locations and both controls" in below


def test_the_claims_of_table_3_3() -> None:
    place = {name: number for number, name in LOCATIONS.items()}
    below, most, rain = location_answers(lambda weather, location: 0.1 * place[location] + 0.1 * (weather == "rain"))
    assert "sun and rain: Yes, at 3 of 3." in below
    assert "sun and rain: Yes, it falls" in most
    assert "Yes, the share lost in rain minus that in sun, over all locations, is −0.2" in rain
    below, most, rain = location_answers(
        lambda weather, location: 1 - 0.2 * place[location] - 0.15 * (weather == "rain")
    )
    assert "sun: No, at 1 of 3. rain: No, at 2 of 3." in below
    assert "sun and rain: No, it rises" in most
    assert "rain weaken the patch? No, " in rain


@pytest.mark.parametrize(("width", "detectors"), [(80, 1), (80, 2), (100, 2)])
def test_no_number_is_cut_off(width: int, detectors: int, monkeypatch: pytest.MonkeyPatch) -> None:
    records = pa.concat_tables([everything(victim) for victim in ("yolov3_tiny", "yolov5")[:detectors]])
    monkeypatch.setattr(patch_records, "shipped_records", lambda chapter: records)
    lines = report(width=width).splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in re.sub(r"[−+]\S*…[−+]\S*", "", "\n".join(lines))


def test_no_patch_is_seen_once_and_stands_for_every_patch_seed() -> None:
    source = Source(pa.concat_tables([controls(), patch()]), NONE)
    found = source.find(source.detectors[0], NO_ATTACK, "clear")
    assert found is not None
    assert found.of.own.shape == (1, 6, 3)
    assert found.of.own.column("confidence_mean").mean() == pytest.approx(0.9, abs=0.02)
