"""Whether the claims of chapter 3 of the thesis hold in ours: a test over patch seeds each, and its answer in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from rich.text import Text

from cavbench.leaderboard.comparisons.comparison import ENOUGH_SEEDS
from cavbench.leaderboard.comparisons.pairing import beside
from cavbench.leaderboard.terminal.text import bounds, change
from cavbench.leaderboard.thesis.patch_records import ABLATION, COVERS, LOCATIONS, STANDARD, WEATHERS, Detector, Source
from cavbench.leaderboard.thesis.trend import LEVEL, trend
from cavbench.statistics.episodes import shared
from cavbench.statistics.estimates import Array, interval

Place = tuple[str, str | None]
"""A weather and a location of ours; no location is all of them."""
Direction = Literal["rises", "falls"]
TREND, INTERVALS = "Page's trend test over patch seeds", "95 % intervals over patch seeds"


@dataclass(frozen=True)
class Claim:
    """That the confidence under attack moves with a setting of the patch.

    Args:
        question: whether it does.
        rows: the setting in order, keys of `CONFIGURATIONS`.
        expected: what the thesis says it does; None where it names no direction.
    """

    question: str
    rows: tuple[str, ...]
    expected: Direction | None


CLAIMS = (
    Claim(
        "does leaving out one transformation after the other raise the confidence under attack?",
        tuple(ABLATION),
        "rises",
    ),
    Claim("does a larger patch lower the confidence under attack?", ("patch_32", "patch_64", STANDARD), "falls"),
    Claim(
        "does the weight of the total variation change the confidence under attack?", (STANDARD, "tv_3", "tv_5"), None
    ),
)


def configuration_claims(source: Source, places: Mapping[str, Place]) -> Iterator[Text]:
    """What tables 3.1 and 3.2 are read for.

    Args:
        source: our records.
        places: where, by the name that an answer begins with.
    """
    for detector in source.detectors:
        for claim in CLAIMS:
            answers = {
                name: _trend(
                    _left(source, detector, claim.rows, place), claim.expected, f"all {len(claim.rows)} configurations"
                )
                for name, place in places.items()
            }
            yield _text(detector, claim.question, answers, f"{TREND}, {'one' if claim.expected else 'two'}-sided")


def location_claims(source: Source) -> Iterator[Text]:
    """What table 3.3 is read for."""
    for detector in source.detectors:
        lost = {theirs: _lost(source, detector, ours) for theirs, ours in WEATHERS.items()}
        question = "is the confidence lower under the patch than under random noise and grey, at every location?"
        answers = {theirs: _below(source, detector, ours) for theirs, ours in WEATHERS.items()}
        yield _text(detector, question, answers, INTERVALS)
        question = "is most lost where the sun shines on the sign, least where it is behind it?"
        answers = {
            theirs: _trend(np.array(list(by_seed.values())), "falls", f"all {len(LOCATIONS)} locations")
            for theirs, by_seed in lost.items()
        }
        yield _text(detector, question, answers, f"{TREND}, one-sided")
        yield _text(detector, "does rain weaken the patch?", {"": _weaker(**lost)}, INTERVALS)


def _text(detector: Detector, question: str, answers: Mapping[str, Text], test: str) -> Text:
    text = Text.assemble((f"{detector.victim}: ", "bold"), question)
    if len({answer.plain for answer in answers.values()}) == 1:
        answers = {" and ".join(answers): next(iter(answers.values()))}
    for name, answer in answers.items():
        text.append(f" {name}: " if name else " ").append_text(answer)
    return text.append(f" {test}.", style="dim")


def _trend(scores: Array, expected: Direction | None, needed: str) -> Text:
    """The answer from scores [R, S], patch seeds x settings in order; `needed` says what those are."""
    if len(scores) < ENOUGH_SEEDS:
        return _unknown(needed, len(scores))
    found = trend(scores)
    p = found.p if expected else min(1.0, 2 * found.p)
    direction = found.direction if p < LEVEL else "does not change detectably"
    if direction == "does not change detectably":
        verdict = "Not shown"
    else:
        verdict = "Yes" if direction == expected or not expected else "No"
    return Text.assemble((verdict, "bold"), f", it {direction} (p = {p:.2g}, Spearman {found.correlation:+.2f}).")


def _unknown(needed: str, seeds: int) -> Text:
    return Text(
        f"It cannot be said: that takes {needed} with at least {ENOUGH_SEEDS} patch seeds in common, {seeds} are recorded.",
        style="yellow",
    )


def _left(source: Source, detector: Detector, rows: Sequence[str], place: Place) -> Array:
    """[R, S] confidence under attack, patch seeds x settings, on the approaches of all settings; no seed where one is missing."""
    found = [each.of.own for row in rows if (each := source.find(detector, row, *place))]
    if len(found) < len(rows):
        return np.empty((0, len(rows)))
    common = found[0]
    try:
        for other in found:
            common, _ = shared(common, other)
    except ValueError:
        return np.empty((0, len(rows)))
    same = [each.only(runs=common.runs, cells=common.cells, seeds=common.seeds) for each in found]
    return np.stack([each.column("confidence_mean").mean((1, 2)) for each in same], 1)


def _lost(source: Source, detector: Detector, weather: str) -> dict[int, list[float]]:
    """The share of the unpatched confidence that is lost at each location, by patch seed."""
    by_location = []
    for location in LOCATIONS.values():
        found = source.find(detector, STANDARD, weather, location)
        clean = found.of.clean if found else None
        if found is None or clean is None or not clean.column("confidence_mean").any():
            return {}
        own, control = beside(found.of.own, clean)
        left, whole = (each.column("confidence_mean").mean((1, 2)) for each in (own, control))
        by_location.append(dict(zip(own.runs, 1 - left / whole, strict=True)))
    seeds = set.intersection(*(set(each) for each in by_location))
    return {seed: [each[seed] for each in by_location] for seed in sorted(seeds)}


def _below(source: Source, detector: Detector, weather: str) -> Text:
    found = [source.find(detector, STANDARD, weather, location) for location in LOCATIONS.values()]
    whole = [each for each in found if each and set(COVERS) <= set(each.of.baselines)]
    seeds = min((len(each.of.own.runs) for each in whole), default=0)
    beyond = [each.of.lead for each in whole if each.of.lead]
    if len(beyond) < len(LOCATIONS) or seeds < ENOUGH_SEEDS:
        return _unknown(f"all {len(LOCATIONS)} locations and both controls", seeds)
    below, above = sum(one.high < 0 for one in beyond), sum(one.low > 0 for one in beyond)
    verdict = "Yes" if below == len(beyond) else "No" if above else "Not shown"
    return Text.assemble((verdict, "bold"), f", at {below} of {len(beyond)}.")


def _weaker(sun: Mapping[int, Sequence[float]], rain: Mapping[int, Sequence[float]]) -> Text:
    seeds = sorted(set(sun) & set(rain))
    if len(seeds) < ENOUGH_SEEDS:
        return _unknown(f"all {len(LOCATIONS)} locations in sun and rain", len(seeds))
    found = interval(np.array([np.subtract(rain[seed], sun[seed]) for seed in seeds])[..., None])
    verdict = "Yes" if found.high < 0 else "No" if found.low > 0 else "Not shown"
    what = ", the share lost in rain minus that in sun, over all locations, is "
    return Text.assemble((verdict, "bold"), what, change(found), " ", bounds(found), ".")
