"""Records that are older than some columns are still read; others are not."""

from __future__ import annotations

import pyarrow as pa

from cavbench.core.track import track
from cavbench.records.schema import schema, written_by


def without(*names: str) -> pa.Schema:
    whole = schema(track("driving"))
    return pa.schema([one for one in whole if one.name not in names], metadata=whole.metadata)


def test_later_columns_may_be_missing_one_by_one_and_no_others() -> None:
    driving = track("driving")
    assert driving.later
    assert written_by(driving, without())
    assert written_by(driving, without(*driving.later))
    assert all(written_by(driving, without(name)) for name in driving.later)
    assert not written_by(driving, without("safe_progress"))
    assert not written_by(track("detection"), without())


def test_columns_in_another_order_or_of_another_type_are_refused() -> None:
    driving = track("driving")
    whole = list(without())
    assert not written_by(driving, pa.schema(whole[::-1], metadata=without().metadata))
    assert not written_by(driving, without().append(pa.field("amplification", pa.float64())))
    place = [one.name for one in whole].index("amplification")
    whole[place] = pa.field("amplification", pa.string())
    assert not written_by(driving, pa.schema(whole, metadata=without().metadata))
