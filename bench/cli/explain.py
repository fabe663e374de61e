"""`bench help TERM`: explains a term, a column, a parameter, a component or a command."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from rich.text import Text

from cavbench.core import registry, suites
from cavbench.core.parameters import Parameter, description, parameters
from cavbench.core.registry import GROUPS, KINDS, Kind
from cavbench.core.track import Measure, tracks
from cavbench.errors import UserError
from cavbench.records.schema import IDENTITY, PROVENANCE
from cavbench.terminal import Console

GLOSSARY = Path(__file__).with_name("glossary.toml")
DOCUMENTATION = "docs/{page}.md"


def print_terms(console: Console) -> None:
    """Print every term of the glossary with its meaning."""
    for name, entry in _glossary().items():
        console.print(Text.assemble((name, "bold"), f"  {entry['meaning']}"), highlight=False)
    console.print(
        "\n`bench help TERM` also explains columns of records, parameters (attack.steps), components and commands.",
        style="dim",
        highlight=False,
    )


def print_term(term: str, console: Console) -> None:
    """Explain a term of the tables, a column of the records, or a component.

    Raises:
        UserError: if nothing has this name.
    """
    found = [*_of_the_glossary(term), *_of_the_records(term), *_of_the_tables(term), *_of_a_parameter(term)]
    for line in found:
        console.print(line, highlight=False)
    kinds = [kind for kind in KINDS if term.partition(":")[0] in registry.entries(GROUPS[kind])]
    if kinds or term in suites.names():
        from cavbench.cli.listing import print_component

        print_component(term, console)
    elif not found:
        raise UserError(registry.unknown(f"term {term!r}", term, _glossary()))


def _glossary() -> dict[str, dict[str, str]]:
    return tomllib.loads(GLOSSARY.read_text(encoding="utf-8"))


def _plain(term: str) -> str:
    """A term without what people write differently: case, hyphens, plural, surroundings."""
    return re.sub(r"[\s_-]+", " ", term.lower()).strip(" /:[]").removesuffix("s")


def _of_the_glossary(term: str) -> list[Text]:
    entries = {name: entry for name, entry in _glossary().items() if _plain(name) == _plain(term)}
    return [
        Text.assemble((name, "bold"), f"  {entry['meaning']} ({DOCUMENTATION.format(page=entry['page'])})")
        for name, entry in entries.items()
    ]


def _columns() -> dict[str, Text]:
    """Every column of the records of all tracks, with its meaning and unit."""
    found: dict[str, Text] = {}
    owned = [(column, track.name) for track in tracks() for column in (*track.measurements, *track.probes)]
    for column, owner in [*((column, "") for column in (*IDENTITY, *PROVENANCE)), *owned]:
        known = {key.decode(): value.decode() for key, value in (column.metadata or {}).items()}
        meaning, unit = known.get("meaning", ""), known.get("unit", "")
        where = f"column of {owner} records" if owner else "column of records"
        found[column.name] = Text.assemble(
            (column.name, "bold"), f"  {where}: {meaning}", f" ({unit})" if unit else "", "."
        )
    return found


def _of_the_records(term: str) -> list[Text]:
    return [text for name, text in _columns().items() if _plain(name) == _plain(term)]


def _of_the_tables(term: str) -> list[Text]:
    """The measurement that a column of the tables shows, by its heading: `frames seen`, `off road`, `over-run m`."""
    columns = _columns()
    return [
        Text.assemble((heading, "bold"), "  in tables: ", columns[measure.column])
        for track in tracks()
        for measure in track.measures
        if measure.column != term and _plain(term) in _spellings(heading := heading_of(measure))
    ]


def heading_of(measure: Measure) -> str:
    """The heading of a measure in one line, without facts of the world: `return`, `queries / step`."""
    joined = " ".join(measure.heading.replace("-\n", "").split())
    return joined.partition(" of {")[0]


def _spellings(heading: str) -> set[str]:
    """How people write a heading: with and without its unit."""
    return {_plain(heading), _plain(heading.partition(" /")[0]), _plain(re.sub(r" (m|s)$", "", heading))}


def _parameters(kind: Kind, owner: str) -> dict[str, Parameter]:
    """The parameters of a component; none of an adapter with choices."""
    from cavbench.core.outline import outline

    if (known := outline(kind, owner)) is not None:
        return parameters(known)
    return {} if registry.offers(kind, owner) else parameters(registry.load(kind, owner))


def _of_a_set(name: str) -> list[Text]:
    """`presence`, all fields of a set of the threat models; or `presence.hidden`, one of them."""
    own, _, wanted = name.partition(".")
    kinds = [track.sets[own] for track in tracks() if own in track.sets]
    found = []
    for kind in kinds:
        said = (
            [] if wanted else [Text.assemble((f"threat.{own}", "bold"), f"  {description(kind).replace(chr(10), ' ')}")]
        )
        for field, one in parameters(kind).items():
            if wanted in ("", field):
                said.append(
                    Text.assemble((f"threat.{own}.{field}", "bold"), f"  {one.meaning} Default {one.default_text}.")
                )
        found += said
    return found


def _of_a_parameter(term: str) -> list[Text]:
    """`threat.budget` or `attack.steps`: a parameter of the threat models, or of all components of a kind that have it."""
    kind, _, name = term.partition(".")
    found = []
    if kind in KINDS and name:
        for owner in registry.names(kind):
            try:
                known = _parameters(kind, owner)
            except UserError:
                continue
            if name in known:
                parameter = known[name]
                found.append(
                    Text.assemble(
                        (f"{term} of {owner}", "bold"), f"  {parameter.meaning} Default {parameter.default_text}."
                    )
                )
    if kind == "threat" and name:
        found += [*_of_the_glossary(name), *_of_a_set(name)]
    return found
