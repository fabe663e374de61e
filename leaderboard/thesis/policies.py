"""Chapter 4 of the thesis, driving policies: tables 4.1, 4.2 and 4.3 beside ours."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from rich import box
from rich.table import Table
from rich.text import Text

from cavbench.driving.track import BEST_BLIND, IDM
from cavbench.leaderboard.comparisons.comparison import ENOUGH_SEEDS
from cavbench.leaderboard.terminal.text import ATTACKED, CLEAN, estimate, share
from cavbench.leaderboard.thesis.numbers import PUBLISHED, THESIS, Beside, as_printed
from cavbench.leaderboard.thesis.policy_records import BUDGET, CLEAR, Attack, Found, Source, Victim, Wanted
from cavbench.leaderboard.thesis.trend import trend
from cavbench.scenarios import Cell

SKIPS = (0.0, 0.3, 0.5, 1.0)
"""The thesis', and the control: the same training without an attack."""
VICTIMS: tuple[Victim, ...] = ("dqn", "ddpg")


def heading(max_reward: float) -> Text:
    """On what settings the numbers of chapter 4 were made, the thesis' and ours."""
    ours = (
        f".\nOurs: threat model linf {BUDGET:g}, attack zo with objective target (DQN: FASTER; DDPG: full throttle and right), "
        "clear weather; 3 lanes at density 1 where nothing else is said."
    )
    return Text.assemble(
        f"Return of at most {max_reward} (highway-env's normalised reward over 450 steps): thesis ",
        ("as printed", THESIS),
        ", ours as mean over training seeds with its 95 % interval, ",
        ("clean", CLEAN),
        " and ",
        ("attacked", ATTACKED),
        ours,
    )


def tables(numbers: Mapping[str, Any], records: pa.Table) -> Iterator[Beside]:
    """Each table of chapter 4 beside ours.

    Args:
        numbers: the thesis', by table.
        records: the user's; where they have none, those published with the package are read.
    """
    made = {"skip": skip_table, "policies": policy_table, "generalisation": road_table}
    for name, table in made.items():
        source = Source(records)
        shown, notes = table(numbers[name], source)
        yield Beside(numbers[name], shown, notes, source.commands())


def skip_table(section: Mapping[str, Any], source: Source) -> tuple[Table, list[Text]]:
    """Table 4.1 beside both of our victims, and whether there is a trade-off."""
    made = _table("skip probability", "thesis\nclean", "\nattacked",
                  *(f"{name}\n{attack}" for name in ("DQN", "DDPG") for attack in ("clean", "attacked")))  # fmt: skip
    rows = {row["skip"]: row for row in section["rows"]}
    found = {(victim, attack, skip): source.find(Wanted(victim, attack, skip))
             for skip in SKIPS for victim in VICTIMS for attack in ("none", "zo")}  # fmt: skip
    for skip in SKIPS:
        thesis = rows.get(skip, {})
        label = f"{skip:g}" + ("  (control: never attacked)" if skip == 1 else "")
        made.add_row(
            label,
            *(as_printed(thesis.get(name)) for name in ("clean", "attacked")),
            *(_ours(found[victim, attack, skip]) for victim in VICTIMS for attack in ("none", "zo")),
        )
    answers = [
        trade_off(victim, {key[1:]: drive for key, drive in found.items() if key[0] == victim}) for victim in VICTIMS
    ]
    return made, answers


def trade_off(victim: Victim, found: Mapping[tuple[str, float], Found | None]) -> Text:
    """Whether skipping attacks in training buys clean return at the price of attacked return, in words.

    The claim holds if clean return rises with the skip probability and attacked return falls with it, each by Page's
    trend test over training seeds at the 5 % level.
    """
    text = Text.assemble((f"{victim.upper()}: ", "bold"), "does the trade-off exist? ")
    drives = [drive.episodes for drive in found.values() if drive]
    seeds = sorted(set.intersection(*(set(drive.runs) for drive in drives))) if len(drives) == len(found) else []
    if len(seeds) < ENOUGH_SEEDS:
        return text.append(
            f"It cannot be said: that takes all four skip probabilities with at least {ENOUGH_SEEDS} training seeds in common, "
            f"{len(seeds)} are recorded.",
            style="yellow",
        )
    trends = {}
    for measure in ("return", "safe_progress"):
        for attack in ("none", "zo"):
            scores = [_by_seed(found[attack, skip], seeds, measure) for skip in SKIPS]
            trends[measure, attack] = trend(np.stack(scores, 1))
    clean, attacked = trends["return", "none"].direction, trends["return", "zo"].direction
    if clean == "rises" and attacked == "falls":
        text.append("Yes. ", style="bold")
    else:
        text.append("No, the opposite. " if clean == "falls" or attacked == "rises" else "Not shown. ", style="bold")
    text.append("With rising skip probability ")
    for measure, name, end in (("return", "return", "; "), ("safe_progress", "safe progress", ". ")):
        parts = []
        for attack, when in (("none", "clean"), ("zo", "attacked")):
            one = trends[measure, attack]
            parts.append(f"{when} {name} {one.direction} (p = {one.p:.2g}, Spearman {one.correlation:+.2f})")
        text.append(" and ".join(parts) + end)
    return text.append(f"Page's trend test, one-sided, {len(seeds)} training seeds.", style="dim")


def _by_seed(found: Found | None, seeds: Sequence[int], measure: str) -> np.ndarray:
    assert found is not None
    return found.episodes.only(runs=seeds).column(measure).mean((1, 2))


def policy_table(section: Mapping[str, Any], source: Source) -> tuple[Table, list[Text]]:
    """Table 4.2 with noise, a blind policy and highway-env's own driver beside it."""
    made = _table(
        "", *(f"{victim.upper()}\n{who}" for victim in VICTIMS for who in ("thesis", "ours", "safe progress"))
    )
    rows: list[tuple[str, str, Attack, float | None]] = [
        ("initial_training", "initial training", "none", None),
        ("under_attack", "under attack", "zo", None),
        ("", "under random noise", "noise", None),
        ("adversarial_training", "advtrain, under attack", "zo", 0.0),
        ("after_training_no_attack", "advtrain, no attack", "none", 0.0),
    ]
    found = {
        (key, victim): source.find(Wanted(victim, attack, skip)) for key, _, attack, skip in rows for victim in VICTIMS
    }
    for key, label, attack, _ in rows:
        cells: list[Text] = []
        for victim in VICTIMS:
            ours = found[key, victim]
            cells += [as_printed(section["rows"].get(key, {}).get(victim)), _ours(ours), _progress(ours)]
        made.add_row(Text(label, style=CLEAN if attack == "none" else ATTACKED), *cells)
    made.add_section()
    for label, name in (("best blind policy", BEST_BLIND), ("IDM and MOBIL", IDM)):
        cells = []
        for victim in VICTIMS:
            cells += [Text(""), estimate(source.baseline(found["initial_training", victim], name), digits=0), Text("")]
        made.add_row(Text(label, style="dim"), *cells)
    made.add_section()
    for label, ratio in RATIOS.items():
        cells = []
        for victim in VICTIMS:
            theirs = {key: values[victim] for key, values in section["rows"].items()}
            own = {key: drive.episode_return.estimate for key in theirs if (drive := found[key, victim])}
            cells += [Text(share(ratio(theirs)), style=THESIS), Text(share(_or_nan(ratio, own))), Text("")]
        made.add_row(label, *cells)
    return made, []


RATIOS: dict[str, Callable[[Mapping[str, float]], float]] = {
    "lost to the attack": lambda of: 1 - of["under_attack"] / of["initial_training"],
    "of that won back": lambda of: (
        (of["adversarial_training"] - of["under_attack"]) / (of["initial_training"] - of["under_attack"])
    ),
    "clean cost of advtrain": lambda of: 1 - of["after_training_no_attack"] / of["initial_training"],
}
"""What table 4.2 is read for, from its four rows."""


def _or_nan(ratio: Callable[[Mapping[str, float]], float], of: Mapping[str, float]) -> float:
    try:
        return ratio(of)
    except (KeyError, ZeroDivisionError):
        return float("nan")


def road_table(section: Mapping[str, Any], source: Source) -> tuple[Table, list[Text]]:
    """Table 4.3: DDPG over lanes and density."""
    made = _table(
        "lanes × density",
        "clean\nthesis",
        "\nours",
        "attacked\nthesis",
        "\nours",
        "lost\nthesis",
        "\nours",
        "best\nblind",
    )
    cells = tuple(Cell(lanes=row["lanes"], density=float(row["density"]), weather=CLEAR) for row in section["rows"])
    for row, cell in zip(section["rows"], cells, strict=True):
        clean, attacked = (source.find(Wanted("ddpg", attack), [cell]) for attack in ("none", "zo"))
        lost = float("nan")
        if clean and attacked and clean.episode_return.estimate:
            lost = 1 - attacked.episode_return.estimate / clean.episode_return.estimate
        made.add_row(
            f"{cell.lanes} × {cell.density:g}",
            as_printed(row["clean"]),
            _ours(clean),
            as_printed(row["attacked"]),
            _ours(attacked),
            Text(share(1 - row["attacked"] / row["clean"]), style=THESIS),
            share(lost),
            estimate(source.baseline(clean or attacked), digits=0),
        )
    # One command makes every road at once.
    source.missing = [(wanted, cells) for wanted, _ in source.missing]
    return made, []


def _table(*headings: str) -> Table:
    made = Table(box=box.SIMPLE_HEAD, header_style="dim", padding=(0, 1, 0, 0), pad_edge=False, show_edge=False)
    for place, heading in enumerate(headings):
        # Where the terminal is narrow, an interval goes under its estimate; no label goes to pieces.
        made.add_column(heading, min_width=0 if place else 11, vertical="bottom")
    return made


def _ours(found: Found | None) -> Text:
    written = estimate(found.episode_return if found else None, digits=0)
    return written.append(PUBLISHED, style="dim") if found and found.shipped else written


def _progress(found: Found | None) -> Text:
    return estimate(found.safe_progress if found else None)
