"""Each flag fires on the records it is made for, does not on the others, and says so where nothing was measured."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.ranking.boards import Board, boards
from cavbench.leaderboard.ranking.flags import FLAGS, Flag
from tests.leaderboard.full_house import PGD, SEEN
from tests.leaderboard.synthetic import CLEAR, GRID, approach, baseline_drivers, drive, probed

HALF = CLEAR[:3]


def board(*tables: pa.Table, track: str = "driving") -> Board:
    return boards(read_tracks({track: pa.concat_tables(tables)}))[0]


def flag(name: str, *tables: pa.Table) -> Flag:
    """The flag of the only row."""
    track = "driving" if "safe_progress" in tables[0].column_names else "detection"
    (row,) = board(*tables, track=track).rows
    return next(each for each in row.flags if each.name == name)


def zo(skill: float = 0.3, **changes: object) -> pa.Table:
    given = {"attack": "zo", "queries": 44.0, "weights": "ab", **changes}
    return probed(drive(skill=skill, **given), gradient_queries=0.0, **SEEN)  # type: ignore[arg-type]


def pgd(skill: float = 0.3, **probes: float) -> pa.Table:
    return probed(drive(attack="pgd", skill=skill, queries=45.0, weights="ab"), **(PGD | SEEN | probes))


def clean(**probes: float) -> pa.Table:
    return probed(drive(skill=0.8, weights="ab"), **(SEEN | probes))


def noise(skill: float = 0.7) -> pa.Table:
    return probed(drive(attack="noise", skill=skill, weights="ab"), gradient_queries=0.0, **SEEN)


BLIND = baseline_drivers()
FIRES: dict[str, tuple[pa.Table, ...]] = {
    "unattacked": (clean(), noise()),
    "blind": (clean(), zo(0.1), BLIND),
    "unsafe": (clean(), zo(0.1), BLIND),
    "ignores_input": (clean(same_answer=1.0), probed(zo(), same_answer=1.0)),
    "masked_gradients": (clean(), zo(0.2), pgd(0.5)),
    "zero_gradients": (clean(), pgd(0.5, zero_gradients=0.9)),
    "nan_gradients": (clean(nan_gradients=0.0), pgd(0.5, nan_gradients=0.02)),
    "noise": (clean(), zo(0.7), noise(0.5)),
    "one_draw": (clean(redrawn=1.0), probed(zo(), redrawn=1.0, draws=1.0)),
    "no_fall": (clean(), zo(0.4, threat=("relative", 0.2)), zo(0.3, threat=("relative", 0.1))),
    "not_flattened": (
        clean(),
        zo(0.2, attack_params={"steps": 40}, queries=400.0),
        zo(0.5, attack_params={"steps": 4}, queries=40.0),
    ),
    "public_only": (clean(), zo(0.6), zo(0.2, grid="audit")),
    "octagon": (probed(approach(0.9), octagons=0.8), probed(approach(0.1, attack="eot"), octagons=0.8)),
    "two_faced": (clean(inconsistent=0.2), probed(zo(), inconsistent=0.2)),
    "left_out": (
        probed(drive(skill=0.8, weights="ab", runs=range(9)), **SEEN),
        zo(0.7, runs=range(9)),
        probed(drive(attack="pgd", skill=0.2, queries=45.0, weights="ab", runs=(1, 2)), **(PGD | SEEN)),
    ),
    "too_little": (probed(drive(skill=0.8, cells=HALF), **SEEN), zo(cells=HALF)),
}
FIRES_NOT: dict[str, tuple[pa.Table, ...]] = {
    "unattacked": (clean(), zo(), noise()),
    "blind": (clean(), zo(0.6), BLIND),
    "unsafe": (clean(), zo(0.6), BLIND),
    "ignores_input": (clean(), zo()),
    "masked_gradients": (clean(), zo(0.5), pgd(0.2)),
    "zero_gradients": (clean(), pgd(0.5)),
    "nan_gradients": (clean(nan_gradients=0.0), pgd(0.5, nan_gradients=0.0)),
    "noise": (clean(), zo(0.3), noise(0.7)),
    "one_draw": (clean(redrawn=1.0), probed(zo(), redrawn=1.0, draws=8.0)),
    "no_fall": (clean(), zo(0.2, threat=("relative", 0.2)), zo(0.5, threat=("relative", 0.1))),
    "not_flattened": (
        clean(),
        zo(0.3, attack_params={"steps": 40}, queries=400.0),
        zo(0.3, attack_params={"steps": 4}, queries=40.0),
    ),
    "public_only": (clean(), zo(0.4), zo(0.4, grid="audit")),
    "octagon": (probed(approach(0.9), octagons=0.2), probed(approach(0.1, attack="eot"), octagons=0.2)),
    "two_faced": (clean(inconsistent=0.0), probed(zo(), inconsistent=0.0)),
    "left_out": (
        probed(drive(skill=0.8, weights="ab", runs=range(9)), **SEEN),
        zo(0.2, runs=range(9)),
        probed(drive(attack="pgd", skill=0.7, queries=45.0, weights="ab", runs=(1, 2)), **(PGD | SEEN)),
    ),
    "too_little": (clean(), zo()),
}
NOT_MEASURED: dict[str, tuple[pa.Table, ...]] = {
    "blind": (clean(), zo()),
    "unsafe": (clean(), zo()),
    "ignores_input": (drive(), drive(attack="zo", queries=44.0)),
    "masked_gradients": (drive(), drive(attack="zo", queries=44.0), drive(attack="pgd", queries=45.0)),
    "zero_gradients": (clean(), zo()),
    "nan_gradients": (clean(), zo()),
    "noise": (clean(), zo()),
    "one_draw": (drive(), drive(attack="zo", queries=44.0)),
    "no_fall": (clean(), zo()),
    "not_flattened": (clean(), zo()),
    "public_only": (clean(), zo()),
    "octagon": (approach(0.9), approach(0.1, attack="eot")),
    "two_faced": (drive(), drive(attack="zo", queries=44.0)),
}


@pytest.mark.parametrize(("runs", "episodes"), [(10, 20), (9, 30), (10, 30)])
def test_the_best_part_of_a_grid_in_blocks_cannot_be_chosen(runs: int, episodes: int) -> None:
    part = {"runs": range(runs), "episodes": episodes, "grid": "standard-v2", "weights": "ab"}
    found = flag("too_little", *(probed(drive(skill=0.8, attack=attack, **part), **SEEN) for attack in ("none", "zo")))  # type: ignore[arg-type]
    assert found.fired is ((runs, episodes) != (10, 30))


def test_every_flag_is_tested_both_ways() -> None:
    assert set(FIRES) == set(FIRES_NOT) == set(FLAGS)


def test_a_detector_that_reads_no_words_is_flagged_though_it_passes_all_decoys() -> None:
    for column in ("false_stops_words", "false_stops_colours"):
        found = flag(
            "octagon", *(probed(approach(0.9, attack=name), octagons=0.0, **{column: 0.9}) for name in ("none", "eot"))
        )
        assert found.fired
        assert "0.90 with another" in found.reason


@pytest.mark.parametrize("name", FLAGS)
def test_a_flag_fires_where_it_should_and_only_there(name: str) -> None:
    assert flag(name, *FIRES[name]).fired is True
    assert flag(name, *FIRES_NOT[name]).fired is False
    if name in NOT_MEASURED:
        unmeasured = flag(name, *NOT_MEASURED[name])
        assert unmeasured.fired is None
        assert unmeasured.reason.startswith("Not measured: ")


def test_an_attack_that_asks_nothing_needs_no_draws() -> None:
    assert flag("one_draw", clean(redrawn=1.0), probed(noise(), redrawn=1.0)).fired is None
    assert flag(
        "one_draw", clean(redrawn=1.0), probed(noise(), redrawn=1.0), probed(zo(), redrawn=1.0, draws=1.0)
    ).fired


@pytest.mark.parametrize("name", FLAGS)
def test_a_reason_is_one_sentence(name: str) -> None:
    for records in (FIRES, FIRES_NOT):
        reason = flag(name, *records[name]).reason
        assert reason.endswith(".")
        assert ". " not in reason


def test_a_detector_that_sees_signs_in_grey_images_is_flagged() -> None:
    def seen(share: float) -> Flag:
        tables = [approach(0.9), approach(0.8, attack="eot")]
        return flag("ignores_input", *(probed(one, same_answer=share) for one in tables))

    assert seen(1.0).fired is True
    assert seen(0.0).fired is False


def test_a_patch_that_lowers_the_score_no_more_than_noise_is_flagged() -> None:
    def beside(left: float) -> Flag:
        tables = approach(0.9), approach(left, attack="eot"), approach(0.6, attack="noise_patch")
        return flag("noise", *tables)

    assert beside(0.65).fired is True
    assert beside(0.2).fired is False


def test_a_flagged_row_ranks_below_those_without_whatever_its_score() -> None:
    cheat = {"defense": "cheat"}
    good = [clean(), zo(0.4), noise(0.6)]
    bad = [probed(drive(skill=0.8, weights="ab", **cheat), **(SEEN | {"same_answer": 1.0})),
           probed(zo(0.7, **cheat), same_answer=1.0)]  # fmt: skip
    found = board(*good, *bad)
    assert [(row.identity["defense"], row.flagged, row.group) for row in found.rows] == [
        ("none", False, 1),
        ("cheat", True, 2),
    ]
    assert found.rows[1].worst.score.estimate > found.rows[0].worst.score.estimate


def test_the_worst_attack_of_each_cell_counts() -> None:
    dense = [cell for cell in GRID.cells() if cell.density == 2]
    (row,) = board(clean(), zo(0.4), probed(drive(attack="pgd", skill=0.1, cells=dense, queries=9.0), **PGD)).rows
    attacks = {cell: one.identity["attack"] for cell, one in zip(row.worst.cells, row.worst.attacks, strict=True)}
    assert {cell.density for cell, attack in attacks.items() if attack == "pgd"} == {2.0}
    assert {cell.density for cell, attack in attacks.items() if attack == "zo"} == {1.0}
    assert row.worst.score.estimate < min(one.score.estimate for one in row.attacks if one.identity["attack"] == "zo")


def test_an_attack_with_less_counts_in_a_larger_threat_model_but_not_the_other_way_round() -> None:
    small = zo(0.2, threat=("relative", 0.05))
    large = zo(0.5, threat=("relative", 0.1))
    found = boards(read_tracks({"driving": pa.concat_tables([clean(), small, large])}))
    budgets = {one.threat[1]: [attack.identity["threat_budget"] for attack in one.rows[0].attacks] for one in found}
    assert budgets == {0.1: [0.05, 0.1], 0.05: [0.05]}


def test_rows_that_are_not_significantly_below_the_first_share_its_group() -> None:
    skills = {"a": 0.7, "b": 0.69, "c": 0.3}
    tables = []
    for name, skill in skills.items():
        tables += [drive(skill=0.9, defense=name, weights="ab"), zo(skill, defense=name)]
    groups = {row.identity["defense"]: row.group for row in board(*tables).rows}
    assert groups["a"] == groups["b"] == 1
    assert groups["c"] == 2


def test_an_attack_on_a_few_cells_changes_nothing_but_their_score() -> None:
    (row,) = board(clean(), BLIND, pgd(0.3), zo(0.5)).rows
    longer = probed(
        drive(attack="pgd", attack_params={"steps": 30}, skill=0.1, queries=99.0, weights="ab", cells=HALF[:1]),
        **(PGD | SEEN),
    )
    (also,) = board(clean(), BLIND, pgd(0.3), zo(0.5), longer).rows
    assert also.worst.score.estimate < row.worst.score.estimate
    assert also.worst.clean == row.worst.clean
    assert also.attacks[0].identity["attack_params"] == row.attacks[0].identity["attack_params"]
    fired = [[flag.name for flag in each.flags if flag.fired] for each in (row, also)]
    assert fired[1] == fired[0]


def test_masked_gradients_are_judged_cell_by_cell() -> None:
    """The best white-box attack of each cell is compared with the black box, not the one whose own cells are hardest."""
    strong = probed(
        drive(attack="pgd", attack_params={"objective": "target"}, skill=0.05, queries=45.0, weights="ab"),
        **(PGD | SEEN),
    )
    assert flag("masked_gradients", clean(), zo(0.3), pgd(0.5)).fired
    assert not flag("masked_gradients", clean(), zo(0.3), pgd(0.5), strong).fired
    easy = drive(attack="pgd", attack_params={"steps": 30}, skill=0.5, queries=99.0, weights="ab", cells=HALF[:1])
    assert flag("masked_gradients", clean(), zo(0.3), pgd(0.5), probed(easy, **(PGD | SEEN))).fired


@pytest.mark.parametrize("stray", [{"episodes": 3, "grid": "custom"}, {"episodes": 3}, {"runs": (7,)}, {"runs": (0,)}])
def test_a_stray_partial_run_changes_no_row(stray: dict[str, object]) -> None:
    """Three episodes of one cell, or one training seed, of an attack that takes everything."""
    records = [clean(), zo(0.5), pgd(0.4), BLIND]
    more = zo(0.0, attack_params={"steps": 99}, cells=HALF[:1], **stray)
    rows = [next(one for one in boards(read_tracks({"driving": pa.concat_tables(tables)})) if one.grid == GRID.name).rows
            for tables in (records, [*records, more])]  # fmt: skip
    (before,), (after,) = rows
    assert (after.worst.score, after.worst.failure, after.flags) == (
        before.worst.score,
        before.worst.failure,
        before.flags,
    )


@pytest.mark.parametrize("more", [{"runs": (0, 1, 2, 3)}, {"runs": range(9)}])
def test_a_weak_attack_on_more_training_seeds_does_not_push_out_the_strong_ones(more: dict[str, object]) -> None:
    records = [
        clean(),
        pgd(0.2),
        probed(drive(attack="pgd", attack_params={"steps": 30}, skill=0.25, queries=99.0), **PGD),
        BLIND,
    ]
    # A run drives the clean control of every seed, too.
    control = probed(drive(skill=0.8, weights="ab", **more), **SEEN)  # type: ignore[arg-type]
    (before,), (after,) = (board(*tables).rows for tables in (records, [control, *records[1:], zo(0.7, **more)]))
    assert after.worst.score == before.worst.score
    assert len(after.attacks) == 3


def test_the_strongest_attack_is_not_the_luckiest() -> None:
    """Ten attacks that differ in luck alone: the score is that of one of them, not of the best of ten."""
    attacks = [probed(zo(0.5, attack_params={"draw": draw}, queries=44.0 + draw), **SEEN) for draw in range(10)]
    generator = np.random.default_rng(0)
    lucky = []
    for table in attacks:
        scores = generator.permutation(table["safe_progress"].to_numpy())
        place = table.schema.get_field_index("safe_progress")
        lucky.append(
            table.set_column(place, table.schema.field(place), pa.array(scores, table.schema.field(place).type))
        )
    (row,) = board(clean(), *lucky).rows
    single = [one.score.estimate for one in row.attacks]
    assert np.stack([one.scores for one in row.attacks]).min(0).mean() < 0.5 * np.mean(single)
    assert row.worst.score.estimate == pytest.approx(np.mean(single), abs=0.03)


def test_a_curve_at_the_floor_is_no_evidence() -> None:
    """Where an attack takes everything with its least effort, more effort shows nothing."""
    weak = zo(0.02, attack_params={"steps": 4}, queries=40.0)
    strong = zo(0.0, attack_params={"steps": 40}, queries=400.0)
    found = flag("not_flattened", clean(), weak, strong)
    assert found.fired is None


def test_a_curve_says_its_cells() -> None:
    reason = flag("not_flattened", *FIRES["not_flattened"]).reason
    assert "18 of 18 cells" in reason or "at the floor or the ceiling" in reason
    two = [zo(0.2, attack_params={"steps": steps}, queries=10.0 * steps, cells=HALF[:2]) for steps in (4, 40)]
    assert flag("not_flattened", clean(), zo(0.5), *two).fired is not True
