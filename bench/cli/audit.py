"""`bench audit`: drives a row again on scenarios drawn at this moment, and compares it with the public ones."""

from __future__ import annotations

from collections.abc import Sequence

import pyarrow as pa
import pyarrow.compute as pc
from rich.table import Table
from rich.text import Text

from bench.cli.progress import RunProgress, show_downloads
from bench.cli.terminal import Console
from bench.errors import UserError
from bench.plugins.pair import Pair
from bench.plugins.track import Track, track_of
from bench.records import reading
from bench.records.schema import AUDIT
from bench.run import runner
from bench.run.audit import AuditConfig, audit_config
from bench.statistics.episodes import Episodes
from bench.statistics.estimates import Interval
from bench.statistics.unpaired import unpaired


def audit(words: Sequence[str], console: Console) -> int:
    """Drive what is missing of both runs, and print the difference of each pair.

    Returns:
        0 if no pair scores significantly higher on the public scenarios, otherwise 1.

    Raises:
        UserError: if an option is not allowed or a component fails, or after Ctrl-C.
    """
    show_downloads()
    config = audit_config(words)
    again = f"salt={config.salt} repeats or continues this audit"
    console.print(Text(f"Drawn scenarios: {again}."), soft_wrap=True)
    units: list[str] = []
    with RunProgress(Console(stderr=True)) as progress:
        for part in (config.public, config.drawn):
            try:
                units += runner.run(part, progress)
            except KeyboardInterrupt:
                raise UserError(f"interrupted; {again}") from None
    track = track_of(config.public.pairs[0])
    found = differences(config, reading.read(config.public.out, units, track=track), track)
    return int(not verdict(found, track, console))


def verdict(found: dict[Pair, tuple[float, float, Interval]], track: Track, console: Console) -> bool:
    """Print the differences and what follows, and return whether no pair scores significantly higher on public scenarios."""
    console.print(_table(found, track))
    flagged = [str(pair) for pair, (_, _, gain) in found.items() if gain.low > 0]
    line = (
        f"public_only: {'; '.join(flagged)}"
        if flagged
        else "No pair scores significantly higher on the public scenarios."
    )
    console.print(Text(line, style="bold red" if flagged else ""), soft_wrap=True)
    return not flagged


def differences(config: AuditConfig, records: pa.Table, track: Track) -> dict[Pair, tuple[float, float, Interval]]:
    """Of each pair the public score, the score on drawn scenarios, and their difference (`bench.statistics.unpaired`)."""
    pairs = {pair.id: pair for pair in (*config.public.pairs, *(pair.clean() for pair in config.public.pairs))}
    found = {}
    for name, pair in pairs.items():
        own = records.filter(pc.equal(records["pair"], name))
        drawn = pc.equal(own["grid"], AUDIT)
        sides = [Episodes.arrange(own.filter(rows)).column(track.metric) for rows in (pc.invert(drawn), drawn)]
        gain = unpaired(sides[0], sides[1], comparisons=len(pairs))
        found[pair] = float(sides[0].mean()), float(sides[1].mean()), gain
    return found


def _table(found: dict[Pair, tuple[float, float, Interval]], track: Track) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("pair", overflow="fold")
    for heading in (f"{track.metric_title}\npublic", "\ndrawn", "\npublic - drawn"):
        table.add_column(heading, justify="right")
    for pair, (public, drawn, gain) in found.items():
        style = "bold red" if gain.low > 0 else ""
        difference = f"{gain.estimate:+.3f} [{gain.low:+.3f}, {gain.high:+.3f}]"
        table.add_row(Text(str(pair)), f"{public:.3f}", f"{drawn:.3f}", Text(difference, style=style))
    return table
