"""The sheet of faces: its halves, what trainings show of it, and what approaches are scored with."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from cavbench.detection.scenes import FAMILIES, FOREIGN
from cavbench.envs.camera import faces, poses, sheet, training_signs

FOUR = {*FAMILIES, FOREIGN}


def test_of_every_family_every_second_name_is_kept_back() -> None:
    kept, shown = sheet.half(scored=True), sheet.half(scored=False)
    for family in FOUR:
        names = sorted((one.name, one in kept) for one in (*kept, *shown) if one.family == family)
        assert [is_kept for _, is_kept in names] == [place % 2 == 0 for place in range(len(names))]
    assert not {one.name for one in kept} & {one.name for one in shown}
    assert {"no-entry--g1", "stop--g1"} <= {one.name for one in kept}


def test_faces_have_a_plate_that_fits_the_octagon_and_no_two_are_alike() -> None:
    drawn = [sheet.drawn(one.name) for half in (True, False) for one in sheet.half(scored=half)]
    step = np.abs(np.linspace(-1, 1, sheet.SIDE))
    corners = step[:, None] + step > np.sqrt(2) + 0.06
    for picture, cover in drawn:
        assert picture.shape == (sheet.SIDE, sheet.SIDE, 3)
        assert 0.15 < (cover > 127).mean() < 0.85
        assert (cover[corners] > 127).mean() < 0.08
    assert len({picture.tobytes() for picture, _ in drawn}) == len(drawn) == 102


def test_approaches_are_scored_with_every_kept_back_face_and_no_other() -> None:
    first = [road[0].seed for road in _approaches()]
    shown = [one for seed in first for one in faces.of_sheet(seed, 10)]
    assert {one.name for one in shown} == {one.name for one in sheet.half(scored=True)}
    for seed in first:
        assert max(Counter(one.family for one in faces.of_sheet(seed, 10)).values()) <= 3
    assert faces.of_sheet(first[0], 10) == faces.of_sheet(first[0], 10)


def _approaches() -> list[list[poses.Pose]]:
    scored = poses.scored()
    return [list(scored[start : start + 10]) for start in range(0, len(scored), 10)]


def test_trainings_never_show_a_face_or_a_word_that_is_kept_back() -> None:
    chance = np.random.default_rng(0)
    kept = {one.name for one in sheet.half(scored=True)}
    words = {name.rpartition(" ")[2] for name in kept}
    new = {training_signs.new_word(chance) for _ in range(3000)}
    assert not new & {"STOP", "ALTO", "PARE", *words}
    assert any(sum(a == b for a, b in zip(word, "STOP", strict=False)) == 2 for word in new)
    for number in range(300):
        _, kind, original = training_signs._begun(f"{training_signs.NAME}{number}")
        assert (original is None) == (kind in ("drawn", "word"))
        assert original is None or original.name not in kept


def test_training_faces_show_all_families_and_their_names_say_which() -> None:
    decoys = training_signs.decoys(0, 400)
    often = Counter(one.family for one in decoys)
    assert set(often) == {*FOUR, ""}
    assert often[FOREIGN] / len(decoys) == pytest.approx(0.15, abs=0.05)
    assert all(one.octagonal for one in decoys if one.family == "words")
    word = next(one for one in decoys if one.family == "words")
    again = faces.face(word.name)
    assert (again.cover > 0.9).float().mean() > 0.7
    assert ((again.reflectance[0] > 2 * again.reflectance[1]).float()).mean() > 0.4
