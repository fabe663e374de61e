"""The certified score of a row: from its clean score and the records of its attacks, or nothing."""

from __future__ import annotations

import pyarrow as pa
import pytest

from cavbench.leaderboard.comparisons.reading import read_tracks
from cavbench.leaderboard.ranking.boards import Row, boards
from cavbench.statistics.certificate import certificate
from tests.leaderboard.full_house import SEEN
from tests.leaderboard.synthetic import approach, drive, probed


def row(**probes: float) -> Row:
    """A row under `zo`, whose records have these probes."""
    clean = probed(drive(skill=0.8, weights="ab"), **SEEN)
    attacked = probed(drive(skill=0.3, weights="ab", attack="zo", queries=44.0), **(SEEN | probes))
    (found,) = boards(read_tracks({"driving": pa.concat_tables([clean, attacked])}))[0].rows
    return found


def test_a_row_without_noise_certifies_nothing() -> None:
    assert row().worst.certified is None


@pytest.mark.parametrize("shift", [0.0, 0.5, 900.0])
def test_a_row_certifies_what_its_clean_score_and_its_noise_allow(shift: float) -> None:
    worst = row(shift=shift).worst
    assert worst.clean is not None
    assert worst.certified == pytest.approx(certificate(worst.clean, shift))
    assert 0.0 <= worst.certified <= worst.clean.low + 1e-9


def detector(bound: float | None) -> Row:
    """A row of a detector under `eot`, whose records promise this; the clean run promises nothing."""
    tables = [approach(0.9), approach(0.6, attack="eot"), approach(0.7, attack="grey_patch")]
    if bound is not None:
        tables[1:] = [probed(one, certified=bound) for one in tables[1:]]
    (found,) = boards(read_tracks({"detection": pa.concat_tables(tables)}))[0].rows
    return found


def test_a_detector_certifies_what_its_records_say() -> None:
    assert detector(None).worst.certified is None
    worst = detector(0.25).worst
    assert worst.certified == pytest.approx(0.25)
    assert worst.certified <= worst.score.estimate
