"""`bench audit`: drives a row again on scenarios drawn at this moment, and compares it with the public ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc
from rich.table import Table
from rich.text import Text

from cavbench import documents
from cavbench.cli.progress import show_downloads
from cavbench.core.pair import Pair
from cavbench.core.track import Track
from cavbench.errors import UserError
from cavbench.records import reading
from cavbench.records.schema import AUDIT
from cavbench.run import runner
from cavbench.run.audit import Audit
from cavbench.run.progress import RunProgress
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Interval
from cavbench.statistics.unpaired import NOTABLE, POWER, Finds, finds, unpaired
from cavbench.terminal import Console

OFTEN = f"{100 * POWER:.0f} %"


class Difference(NamedTuple):
    """What an audit found of a pair.

    Args:
        public, drawn: its scores on public and on drawn scenarios.
        gain: their difference.
        finds: what an audit of this size finds.
        episodes: scenarios of each cell, on either side.
    """

    public: float
    drawn: float
    gain: Interval
    finds: Finds
    episodes: int


def audit(both: Audit, console: Console, *, as_json: bool = False) -> int:
    """Drive what is missing of both runs, and print the difference of each pair.

    Args:
        both: the public and the drawn run.
        console: console to print to.
        as_json: print one document (`cavbench.documents`) as well.

    Returns:
        0 if no pair scores significantly higher on the public scenarios, otherwise 1.

    Raises:
        UserError: if a component fails, or after Ctrl-C.
    """
    show_downloads()
    again = f"salt={both.salt} repeats or continues this audit"
    console.print(Text(f"Drawn scenarios: {again}."), soft_wrap=True)
    units: list[str] = []
    aside = Console(stderr=True)
    with RunProgress(aside) as progress:
        for name, part in (("public", both.public), ("drawn", both.drawn)):
            progress.cost = f"{name}: {part.cost}"
            try:
                units += runner.run(part, progress)
            except KeyboardInterrupt:
                raise UserError(f"interrupted; {again}") from None
    track = both.public.track
    found = differences(both, reading.read(both.public.out, units, track=track), track)
    holds = verdict(found, track, console)
    if as_json:
        pairs = [_values(pair, one, track) for pair, one in found.items()]
        documents.show("audit", {"salt": both.salt, "holds": holds, "pairs": pairs})
    return int(not holds)


def _values(pair: Pair, found: Difference, track: Track) -> dict[str, object]:
    return {
        "pair": pair.id,
        "track": track.name,
        "metric": track.metric,
        "public": found.public,
        "drawn": found.drawn,
        "gain": asdict(found.gain),
        "flagged": found.gain.low > 0,
        "episodes": found.episodes,
        "finds": asdict(found.finds),
    }


def verdict(found: Mapping[Pair, Difference], track: Track, console: Console) -> bool:
    """Print the differences and what follows, and return whether no pair scores significantly higher on public scenarios."""
    console.print(_table(found, track))
    console.print(Text(reach(found)), soft_wrap=True)
    flagged = [str(pair) for pair, one in found.items() if one.gain.low > 0]
    line = (
        f"public_only: {'; '.join(flagged)}"
        if flagged
        else "No pair scores significantly higher on the public scenarios."
    )
    console.print(Text(line, style="bold red" if flagged else ""), soft_wrap=True)
    return not flagged


def reach(found: Mapping[Pair, Difference]) -> str:
    """What the audit could not find, and how large an audit would: of the pair whose scores vary most."""
    pair, worst = max(found.items(), key=lambda item: item[1].finds.scenarios)
    chance, smallest, scenarios = 100 * worst.finds.chance, worst.finds.smallest, worst.finds.scenarios
    line = f"A public score of {pair} that is {NOTABLE:g} too high is found in {chance:.0f} % of audits of this size"
    if worst.finds.chance >= POWER:
        return f"{line}, one that is {smallest:.3f} too high in {OFTEN}."
    larger = f"episodes={scenarios} ({scenarios / worst.episodes:.1f} times as many) finds it in {OFTEN}"
    return f"{line}; {larger}. In {OFTEN} this size finds one that is {smallest:.3f} too high."


def differences(both: Audit, records: pa.Table, track: Track) -> dict[Pair, Difference]:
    """What the records say of each pair (`cavbench.statistics.unpaired`)."""
    pairs = {pair.id: pair for pair in (*both.public.pairs, *(pair.clean() for pair in both.public.pairs))}
    found = {}
    for name, pair in pairs.items():
        own = records.filter(pc.equal(records["pair"], name))
        drawn = pc.equal(own["grid"], AUDIT)
        sides = [Episodes.arrange(own.filter(rows)).column(track.metric) for rows in (pc.invert(drawn), drawn)]
        found[pair] = Difference(
            public=float(sides[0].mean()),
            drawn=float(sides[1].mean()),
            gain=unpaired(sides[0], sides[1], comparisons=len(pairs)),
            finds=finds(sides[0], sides[1], comparisons=len(pairs)),
            episodes=sides[0].shape[2],
        )
    return found


def _table(found: Mapping[Pair, Difference], track: Track) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0))
    table.add_column("pair", overflow="fold")
    for heading in (f"{track.metric_title}\npublic", "\ndrawn", "\npublic - drawn", f"found in\n{OFTEN} from"):
        table.add_column(heading, justify="right")
    for pair, (public, drawn, gain, found_from, _) in found.items():
        style = "bold red" if gain.low > 0 else ""
        difference = f"{gain.estimate:+.3f} [{gain.low:+.3f}, {gain.high:+.3f}]"
        table.add_row(
            Text(str(pair)),
            f"{public:.3f}",
            f"{drawn:.3f}",
            Text(difference, style=style),
            f"+{found_from.smallest:.3f}",
        )
    return table
