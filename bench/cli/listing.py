"""`bench list`: prints all components with a line on each, or the description of one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavbench import documents
from cavbench.core import registry, suites
from cavbench.core.contracts import ANY_TRACK
from cavbench.core.outline import outline
from cavbench.core.registry import GROUPS, KINDS, Kind
from cavbench.core.sources import summary, tracks_of
from cavbench.core.suites import Suite
from cavbench.errors import UserError

SUITE = "suite"


@dataclass(frozen=True, kw_only=True)
class Listed:
    """A line of `bench list`; `problem` says why the component cannot be used, and is mostly empty."""

    kind: str
    name: str
    tracks: tuple[str, ...]
    summary: str
    shipped_by: str
    problem: str


def listed(kind: str = "") -> list[Listed]:
    """Every component, or those of one kind, read from the sources without importing them."""
    found = []
    for each in KINDS if kind in ("", *KINDS) else ():
        if kind in ("", each):
            found += [_component(each, name, claims) for name, claims in registry.entries(GROUPS[each]).items()]
    return found + ([_suite(name) for name in registry.entries(registry.SUITES)] if kind in ("", SUITE) else [])


def _component(kind: Kind, name: str, claims: tuple[registry.Entry, ...]) -> Listed:
    return Listed(
        kind=kind,
        name=name,
        tracks=tuple(tracks_of(claims[0].target)),
        summary=summary(claims[0].target),
        shipped_by=claims[0].shipped_by,
        problem=registry.problem(claims),
    )


def _suite(name: str) -> Listed:
    claims = registry.entries(registry.SUITES)[name]
    try:
        suite = suites.suite(name)
    except UserError as error:
        return Listed(kind=SUITE, name=name, tracks=(), summary="", shipped_by=claims[0].shipped_by, problem=str(error))
    return Listed(
        kind=SUITE,
        name=name,
        tracks=(suite.track,),
        summary=suite.meaning,
        shipped_by=claims[0].shipped_by,
        problem=registry.problem(claims),
    )


def print_names(console: Console, kind: str = "", *, as_json: bool = False) -> None:
    """Print the components, or those of one kind, with what they do, without importing them.

    Args:
        console: console to print to.
        kind: attack, defense, victim, world or suite; empty for all.
        as_json: print one document (`cavbench.documents`) instead, with the fields of `Listed`.
    """
    found = listed(kind)
    if as_json:
        documents.show("list", {"components": [asdict(one) for one in found]})
        return
    foreign = any(not one.shipped_by.startswith("cavbench ") for one in found)
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column in ("kind", "name", "track"):
        table.add_column(column, no_wrap=True)
    table.add_column("what it does", ratio=1)
    if foreign:
        table.add_column("shipped by")
    before = ""
    for one in found:
        said = Text(one.problem, style="red") if one.problem else _with_code(one.summary)
        row = [
            Text(one.kind if one.kind != before else ""),
            Text(one.name, style="bold"),
            Text(", ".join(one.tracks) or "?"),
            said,
        ]
        table.add_row(*row, *([Text(one.shipped_by)] if foreign else []))
        before = one.kind
    console.print(table)
    console.print("\n`bench list NAME` describes a component and its parameters.", style="dim", highlight=False)


def show_component(name: str) -> None:
    """Print every component of this name, with its parameters or members, as one document (`cavbench.documents`).

    Raises:
        UserError: if no component has the name, or its plug-in is broken.
    """
    if name in suites.names():
        members = [str(member.chosen) for member in suites.suite(name).members]
        documents.show("list", {"components": [asdict(_suite(name)) | {"members": members}]})
        return
    found = []
    for kind in registry.kinds_of(name):
        claims = registry.entries(GROUPS[kind]).get(name) or (registry.find(GROUPS[kind], name, kind),)
        found.append(asdict(_component(kind, name, claims)) | {"parameters": _parameters(kind, name)})
    documents.show("list", {"components": found})


def _parameters(kind: Kind, name: str) -> list[dict[str, str | None]]:
    from cavbench.core.parameters import flattened

    return [
        {
            "name": f"{kind}.{own}",
            "type": one.type_name,
            "default": None if one.required else one.default_text,
            "allowed": one.allowed,
            "meaning": one.meaning,
        }
        for own, one in flattened(outline(kind, name) or registry.load(kind, name)).items()
    ]


def print_component(name: str, console: Console) -> None:
    """Describe every component of this name: what it does, track, parameters, and the package that ships it.

    Raises:
        UserError: if no component has the name, or its plug-in is broken.
    """
    if name in suites.names():
        _print_suite(suites.suite(name), console)
        return
    for number, kind in enumerate(registry.kinds_of(name)):
        if number:
            console.rule(style="dim")
        _print_page(kind, name, console)


def heading(kind: Kind, name: str) -> Text:
    """One line: the component, its module, and the package that ships it."""
    entry = registry.find(GROUPS[kind], name, kind)
    return Text.assemble((f"{kind} ", "dim"), (name, "bold"), (f"   {entry.target}, {entry.shipped_by}", "dim"))


def _print_page(kind: Kind, name: str, console: Console) -> None:
    from cavbench.core.parameters import description, flattened

    known = outline(kind, name)
    offered = {} if known else registry.offers(kind, name)
    component = known or (registry.declared(kind, name) if offered else registry.load(kind, name))
    console.print(heading(kind, name))
    console.print()
    for paragraph in _paragraphs(description(component)):
        console.print(_with_code(paragraph), highlight=False)
        console.print()
    if offered:
        _print_choices(name, offered, console)
        return
    console.print(fits(kind, component), highlight=False)
    console.print()
    owned = flattened(component)
    if not owned:
        console.print("It has no parameters.")
        return
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("parameter", no_wrap=True)
    table.add_column("type", no_wrap=True)
    table.add_column("default", max_width=18)
    table.add_column("meaning", ratio=1)
    for name, parameter in owned.items():
        meaning = Text("\n").join(filter(None, [_with_code(parameter.meaning), Text(parameter.allowed, style="dim")]))
        written = Text(f"{kind}.{name}", style="bold")
        table.add_row(written, parameter.type_name, parameter.default_text, meaning)
    console.print(table)


def _print_suite(suite: Suite, console: Console) -> None:
    """Print the members of a suite."""
    entry = registry.find(registry.SUITES, suite.name, "suite")
    console.print(
        Text.assemble(("suite ", "dim"), (suite.name, "bold"), (f"   {entry.target}, {entry.shipped_by}", "dim"))
    )
    meaning = f"{suite.meaning[:1].upper()}{suite.meaning[1:]}."
    console.print(f"\n{meaning} Track: {suite.track}. Access: {suite.access}.\n", highlight=False)
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    for column in ("attack", "victims", "purpose"):
        table.add_column(column)
    for member in suite.members:
        victims = ", ".join(f"{name} {value}" for name, value in member.victims.items()) or "all"
        table.add_row(Text(str(member), style="bold"), victims, member.purpose)
    console.print(table)
    console.print(
        f"\n`bench run attack={suite.name}` runs all of them that fit the victim.", style="dim", highlight=False
    )


def _print_choices(name: str, choices: Mapping[str, str], console: Console) -> None:
    """Print the choices of an adapter."""
    table = Table(box=None, show_header=False, pad_edge=False, padding=(0, 2, 0, 0))
    for choice, word in choices.items():
        table.add_row(Text(f"{name}:{choice}", style="bold"), word)
    console.print(table)
    example = f"{name}:{next(iter(choices))}"
    console.print(f"\n`bench list {example}` describes one and its parameters.", style="dim", highlight=False)


def fits(kind: Kind, component: type[Any]) -> str:
    """Its tracks, the access and actions that an attack needs, and the access that a black-box victim supports."""
    tracks = component.tracks()
    track = "Track: all." if tracks == (ANY_TRACK,) else f"Track: {' and '.join(tracks)}."
    if kind == "victim" and component.answers != "gradients":
        return f"{track} Supports access {component.answers} at most: attacks that need more are refused."
    if kind != "attack":
        return track
    types = getattr(component, "action_types", ())
    actions = f" and {' or '.join(types)} actions" if types else ""
    return f"{track} Needs access {component.access}{actions}."


def _paragraphs(text: str) -> list[str]:
    """The paragraphs of a docstring, each joined to one line unless it is indented (an example)."""
    paragraphs = []
    for paragraph in text.split("\n\n"):
        indented = any(line.startswith(" ") for line in paragraph.splitlines())
        paragraphs.append(paragraph if indented else " ".join(paragraph.split()))
    return [paragraph for paragraph in paragraphs if paragraph.strip()]


def _with_code(text: str) -> Text:
    """Text with `backticked` words highlighted."""
    rendered = Text()
    for number, piece in enumerate(re.split(r"`([^`]+)`", text)):
        rendered.append(piece, style="cyan" if number % 2 else "")
    return rendered
