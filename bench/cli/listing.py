"""`bench list`: prints the names of all components, or the description of one."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from bench.errors import UserError
from bench.plugins import registry, suites
from bench.plugins.contracts import ANY_TRACK
from bench.plugins.registry import GROUPS, KINDS, Kind
from bench.plugins.sources import tracks_of
from bench.plugins.suites import Suite


def print_names(console: Console) -> None:
    """Print every component by kind, with its tracks and the package that ships it, without importing it."""
    table = Table(box=None, pad_edge=False, header_style="dim")
    for column in ("kind", "name", "track", "shipped by"):
        table.add_column(column)
    for kind in KINDS:
        for number, (name, claims) in enumerate(registry.entries(GROUPS[kind]).items()):
            complaint = registry.problem(claims)
            shipped_by = Text(complaint, style="red") if complaint else Text(claims[0].shipped_by)
            served = ", ".join(tracks_of(claims[0].target)) or "?"
            table.add_row(kind if number == 0 else "", Text(name, style="bold"), served, shipped_by)
    for number, (name, claims) in enumerate(registry.entries(registry.SUITES).items()):
        complaint = registry.problem(claims)
        try:
            served = suites.suite(name).track
        except UserError as error:
            served, complaint = "?", complaint or str(error)
        shipped_by = Text(complaint, style="red") if complaint else Text(claims[0].shipped_by)
        table.add_row("suite" if number == 0 else "", Text(name, style="bold"), served, shipped_by)
    console.print(table)
    console.print("\n`bench list NAME` describes a component and its parameters.", style="dim", highlight=False)


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
    from bench.plugins.parameters import description, flattened

    offered = registry.offers(kind, name)
    component = registry.declared(kind, name) if offered else registry.load(kind, name)
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
    known = flattened(component)
    if not known:
        console.print("It has no parameters.")
        return
    table = Table(box=None, pad_edge=False, header_style="dim", padding=(0, 2, 0, 0))
    table.add_column("parameter", no_wrap=True)
    table.add_column("type", no_wrap=True)
    table.add_column("default", max_width=18)
    table.add_column("meaning", ratio=1)
    for name, parameter in known.items():
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
