"""The end of a run in a continuous integration: whether it passes its gates, as JUnit XML and in the summary of a job."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import pyarrow as pa
import pyarrow.compute as pc
from rich.text import Text

from cavbench.cli.compare import Compared, compared, markdown
from cavbench.core.pair import Pair
from cavbench.errors import UserError, in_markdown, notice, plain
from cavbench.files import whole
from cavbench.records import reading
from cavbench.run.plan import Plan
from cavbench.statistics.episodes import Episodes
from cavbench.statistics.estimates import Interval, share_interval
from cavbench.terminal import Console

NOT_PASSED = 3
"""The exit code of a run that did not pass a gate."""
SUMMARY = "GITHUB_STEP_SUMMARY"
"""The variable of the environment with the file that GitHub shows as the summary of a step."""


@dataclass(frozen=True)
class Case:
    """What became of a pair.

    Args:
        pair: the pair.
        score: of its episodes; None if it has none.
        seconds: wall time of its units.
        why: why it did not pass, one line each.
    """

    pair: Pair
    score: Interval | None
    seconds: float
    why: tuple[str, ...]


class Gate:
    """The gates of a run. Make it before anything is driven: it reads what the run is compared with.

    Args:
        plan: the run.

    Raises:
        UserError: if the other results cannot be read, or have none of the pairs.
    """

    def __init__(self, plan: Plan) -> None:
        self.plan, self.gates = plan, plan.gates
        self.gates.check(plan.out)
        self.before: Mapping[str, pa.Table] = {}
        if self.gates.against is not None:
            self.before = _of_pairs(plan, self.gates.against)

    def passes(self, records: pa.Table | None, errors: Sequence[str], console: Console) -> bool:
        """Judge the run, print what it did not pass, and write the reports.

        Args:
            records: of the run; None if it has none.
            errors: what failed.
            console: where to print.
        """
        summary = os.environ.get(SUMMARY, "")
        if not (self.gates or summary):
            return True
        versus = None
        if self.gates.against is not None and records is not None:
            own = {self.plan.track.name: _only(records, self.plan)}
            versus = compared(self.before, own, (str(self.gates.against), str(self.plan.out)))
        worse = (
            [f"significantly worse than {self.gates.against}: {_line(line)}" for line in versus.worse] if versus else []
        )
        cases = [self._case(pair, records) for pair in self.plan.pairs]
        for line in (*(f"{case.pair}: {why}" for case in cases for why in case.why), *worse):
            console.print(Text(f"not passed: {line}", style="bold red"), soft_wrap=True)
        if self.gates.junit is not None:
            _write(self.gates.junit, junit(cases, worse, errors, self.plan))
        if summary:
            _append(Path(summary), in_summary(cases, worse, errors, versus, self.plan))
        return not worse and not any(case.why for case in cases)

    def _case(self, pair: Pair, records: pa.Table | None) -> Case:
        own = None if records is None else records.filter(pc.equal(records["pair"], pair.id))
        if own is None or not own.num_rows:
            return Case(pair, None, 0.0, ())
        score = share_interval(Episodes.arrange(own).column(self.plan.track.metric))
        least = self.gates.fail_below
        low = least is not None and score.estimate < least
        why = (f"{self.plan.track.metric_title} {score.estimate:.3f} is below fail_below={least:g}",) if low else ()
        units = own.select(["unit", "wall_s"]).group_by("unit").aggregate([("wall_s", "max")])
        return Case(pair, score, float(pc.sum(units["wall_s_max"]).as_py()), why)


def _of_pairs(plan: Plan, folder: Path) -> dict[str, pa.Table]:
    """The records of the pairs of a run in another folder."""
    every = reading.read_all(folder)
    found = every.get(plan.track.name)
    wanted = {pair.id for pair in plan.pairs}
    if found is None or not wanted & set(pc.unique(found["pair"]).to_pylist()):
        pairs = sorted({str(name) for table in every.values() for name in pc.unique(table["pair"]).to_pylist()})
        more = f" and {len(pairs) - 5} more" if len(pairs) > 5 else ""
        raise UserError(
            f"against={folder} has no records of the pairs of this run; it has {', '.join(pairs[:5])}{more}"
        )
    return {plan.track.name: _only(found, plan)}


def _only(records: pa.Table, plan: Plan) -> pa.Table:
    """The records of the pairs that were asked for, and of their clean controls."""
    names = sorted({pair.id for asked in plan.pairs for pair in (asked, asked.clean())})
    return records.filter(pc.is_in(records["pair"].cast(pa.string()), pa.array(names)))


def _line(line: object) -> str:
    difference = line.difference  # type: ignore[attr-defined]
    return (
        f"{line.attack} on {line.defended}, {difference.estimate:+.3f} [{difference.low:+.3f}, {difference.high:+.3f}]"  # type: ignore[attr-defined]
    )


def junit(cases: Sequence[Case], worse: Sequence[str], errors: Sequence[str], plan: Plan) -> bytes:
    """JUnit XML: a case for each pair, one for the comparison, and an error for each thing that failed."""
    failures = sum(bool(case.why) for case in cases) + bool(worse)
    own = {"failures": str(failures), "errors": str(len(errors)), "time": f"{sum(case.seconds for case in cases):.3f}"}
    tests = len(cases) + bool(plan.gates.against) + len(errors)
    root = ElementTree.Element("testsuites", {"name": "cavbench", "tests": str(tests)} | own)
    suite = ElementTree.SubElement(
        root, "testsuite", {"name": f"cavbench.{plan.track.name}", "tests": str(tests)} | own
    )

    def case(name: str, classname: str, seconds: float = 0.0) -> ElementTree.Element:
        named = {"name": plain(name), "classname": plain(classname), "time": f"{seconds:.3f}"}
        return ElementTree.SubElement(suite, "testcase", named)

    for one in cases:
        found = case(str(one.pair.attack), f"{plan.track.name}.{one.pair.defended}", one.seconds)
        for why in one.why:
            ElementTree.SubElement(found, "failure", {"message": plain(why)}).text = plain(why)
        if one.score is None:
            ElementTree.SubElement(found, "skipped", {"message": "it has no records"})
        else:
            said = f"{plan.track.metric_title} {one.score.estimate:.4f} [{one.score.low:.4f}, {one.score.high:.4f}]"
            ElementTree.SubElement(found, "system-out").text = said
    if plan.gates.against is not None:
        found = case(f"against {plan.gates.against}", plan.track.name)
        if worse:
            ElementTree.SubElement(found, "failure", {"message": plain(worse[0])}).text = plain("\n".join(worse))
    for error in errors:
        ElementTree.SubElement(case("run", plan.track.name), "error", {"message": plain(error)}).text = plain(error)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def in_summary(
    cases: Sequence[Case], worse: Sequence[str], errors: Sequence[str], versus: Compared | None, plan: Plan
) -> str:
    """The same in Markdown."""
    title = plan.track.metric_title
    rows = [f"## cavbench: {'not passed' if worse or any(case.why for case in cases) else 'passed'}", ""]
    rows += [f"| defended victim | attack | {title} | 95 % | |", "|---|---|--:|---|---|"]
    for case in cases:
        score = case.score
        numbers = ("—", "") if score is None else (f"{score.estimate:.3f}", f"{score.low:.3f} … {score.high:.3f}")
        said = (case.pair.defended, str(case.pair.attack), *numbers, "; ".join(case.why) and f"✗ {'; '.join(case.why)}")
        rows.append(f"| {' | '.join(in_markdown(one) for one in said)} |")
    rows += ["", *(f"- {in_markdown(line)}" for line in (*worse, *errors)), ""]
    return "\n".join(rows) + (f"\n{markdown(versus)}" if versus else "")


def _write(path: Path, content: bytes) -> None:
    try:
        with whole(path) as file:
            file.write(content)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}; choose another with junit=") from error


def _append(path: Path, text: str) -> None:
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        notice(f"the summary of the step, {path}, cannot be written: {error.strerror}")
