"""The tables of the detection track, of the published records."""

from __future__ import annotations

import io
import re

import pyarrow as pa
import pyarrow.compute as pc
import pytest
from rich.console import Console

from cavbench.core.pair import choose
from cavbench.core.track import track
from cavbench.leaderboard.comparisons.comparison import parameters
from cavbench.leaderboard.published import published
from cavbench.leaderboard.terminal.run import run_report
from cavbench.leaderboard.thesis.patch_records import usual_crafting
from tests.leaderboard.synthetic import approach, probed


@pytest.mark.parametrize("width", [80, 100, 120, 160])
def test_no_line_is_wider_than_the_terminal_and_no_number_is_cut_off(width: int) -> None:
    out = io.StringIO()
    records = published(track("detection")).filter(pc.field("defense") == "none")
    run_report({"detection": records}, Console(file=out, width=width))
    text = out.getvalue()
    assert max(map(len, text.splitlines())) <= width
    assert "…" not in re.sub(r"[−+]\S*…[−+]\S*", "", text)  # an interval of numbers below 0 is written −.54…−.53


def test_records_without_decoys_are_shown_without_columns_of_decoys() -> None:
    records = pa.concat_tables([approach(0.9), approach(0.1, attack="eot")])
    assert records["decoy_confidence"].null_count == records.num_rows
    texts = []
    for tables in (records, probed(records, false_stops=0.25, average_precision=0.5)):
        out = io.StringIO()
        run_report({"detection": tables}, Console(file=out, width=160))
        texts.append(out.getvalue())
    assert "stops" not in texts[0]
    assert "stops" in texts[1]


def test_most_published_patches_were_crafted_with_the_default_parameters() -> None:
    """The commands of `bench report thesis` leave these out without importing the attack, which takes seconds."""
    usual = parameters(usual_crafting())
    assert usual
    assert usual.items() <= parameters(choose("attack", "eot").params).items()
