"""The command line: one function for each command of `bench`.

A command imports what it needs when it is called, so that `bench list` and `--help` do not import torch. What was typed is read
before that, so that an unknown name is refused at once.
"""

from __future__ import annotations

import os
import re
import sys
import warnings
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer
from rich.text import Text

from cavbench import __version__
from cavbench.cli.completion import completed
from cavbench.cli.early import start
from cavbench.cli.options_help import RunHelp, TrainHelp
from cavbench.errors import Notice, UnfinishedError, UserError, bounded, short
from cavbench.terminal import Console

if TYPE_CHECKING:
    import pyarrow as pa

    from cavbench.core.track import Track

KINDS = ("attack", "defense", "victim", "world", "threat")
app = typer.Typer(pretty_exceptions_enable=False)

AsJson = Annotated[
    bool, typer.Option("--json", help="Print one JSON document instead; all else goes to standard error.")
]
Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE...",
        help="Comma lists sweep: attack=zo,noise defense=advtrain victim=dqn attack.steps=50 threat.budget=0.1,0.2. "
        "Training seeds and axes select a part of the grid: seeds=0,1 lanes=3,4 weather=clear,rain episodes=20.",
        autocompletion=completed,
    ),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cavbench {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def bench(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """A benchmark for the adversarial robustness of driving policies and object detectors.

    With --debug, or BENCH_DEBUG=1 in the environment, errors show their traceback.
    """
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command("help")
def explain(
    context: typer.Context,
    term: Annotated[
        list[str] | None, typer.Argument(help="A term of the tables, a column, a parameter, a component or a command.")
    ] = None,
) -> None:
    """Explain a term, such as a column of the tables; without one, list all terms.

    For instance: bench help kept, bench help "min TTC", bench help threat.budget, or bench help run
    """
    from cavbench.cli import explain as cli_explain

    wanted = " ".join(term or [])
    commands = getattr(context.find_root().command, "commands", {})
    if wanted in commands:
        command = commands[wanted]
        with type(context)(command, info_name=wanted, parent=context.find_root()) as inner:
            typer.echo(command.get_help(inner))
    elif wanted:
        cli_explain.print_term(wanted, Console())
    else:
        cli_explain.print_terms(Console())


@app.command("list")
def list_components(
    name: Annotated[
        str, typer.Argument(help="A component to describe, or a kind: attack, defense, victim, world, suite.")
    ] = "",
    as_json: AsJson = False,
) -> None:
    """List the installed attacks, defences, victims and worlds with a line on each, or describe one."""
    from cavbench.cli import listing as cli_list

    if name in ("", "attack", "defense", "victim", "world", "suite"):
        cli_list.print_names(Console(), name, as_json=as_json)
    elif as_json:
        cli_list.show_component(name)
    else:
        cli_list.print_component(name, Console())


@app.command()
def new(
    kind: Annotated[str, typer.Argument(help="attack, defense, victim or world.")],
    name: Annotated[str, typer.Argument(help="Its name on the command line, for instance my_attack.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="[track=…] [out=…]", help="track=detection for a detector; out=FOLDER for the package."),
    ] = None,
    builtin: Annotated[
        bool, typer.Option("--builtin", help="Add it to a checkout of cavbench instead: code, entry, page and test.")
    ] = False,
) -> None:
    """Create a plug-in package: a small component that works and passes its tests, to start from.

    For instance: bench new attack my_attack, or bench new defense my_defense track=detection
    """
    from cavbench.cli import new as cli_new

    cli_new.print_new(kind, name, words or [], Console(), built_in=builtin)


@app.command()
def check(
    name: Annotated[str, typer.Argument(help="A component, built-in or from a plug-in.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="[KEY=VALUE]...", help="Its parameters; victim=NAME and world=NAME to check it with."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check that a component follows the rules of the benchmark, and print what to fix.

    For instance: bench check my_attack attack.strength=2
    """
    from cavbench.cli import check as cli_check

    raise typer.Exit(cli_check.print_checks(name, words or [], Console(), as_json=as_json))


Cells = Annotated[bool, typer.Option("--cells", help="Show every cell, parameter and threat model, too.")]


@app.command(cls=RunHelp)
def run(
    words: Words = None,
    cells: Cells = False,
    as_json: AsJson = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be driven and what it costs, and end.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before a run of more than an hour.")] = False,
) -> None:
    """Score attacks on defended victims over a grid of scenarios. Run the same command again to continue an interrupted run.

    For instance: bench run attack=zo defense=advtrain
    """
    from cavbench.run.config import plan_of

    plan = plan_of(words or [], start)
    from cavbench.cli import run as cli_run

    if dry_run:
        cli_run.show_plan(plan, Console())
        return
    raise typer.Exit(cli_run.run(plan, Console(), partial(_print_report, cells=cells), as_json=as_json, yes=yes))


@app.command(cls=RunHelp)
def audit(words: Words = None, as_json: AsJson = False) -> None:
    """Score pairs again on scenarios drawn at this moment. A pair that scores higher on the public ones is flagged, exit code 1.

    The options are those of bench run; salt=NUMBER repeats an audit. For instance: bench audit attack=pgd defense=advtrain
    """
    from cavbench.run.audit import audit_of

    asked = audit_of(words or [], start)
    from cavbench.cli import audit as cli_audit

    raise typer.Exit(cli_audit.audit(asked, Console(stderr=as_json), as_json=as_json))


@app.command(cls=RunHelp)
def certify(words: Words = None, as_json: AsJson = False) -> None:
    """Prove which decisions no attack can change, and a lower bound of the score under every attack.

    The options are those of bench run; leaves=NUMBER limits the search for the bound, leaves=0 leaves it out.
    For instance: bench certify defense=sa threat.budget=0.005 lanes=3 density=1 weather=clear episodes=5 seeds=0
    """
    from cavbench.cli import certify as cli_certify

    plan, leaves = cli_certify.asked(words or [], start)
    cli_certify.certify(plan, leaves, Console(stderr=as_json), as_json=as_json)


TrainWords = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE...",
        help="One victim, defence and attack, and a list of seeds: victim=dqn defense=advtrain defense.skip=0.3 seeds=0,1,2.",
        autocompletion=completed,
    ),
]


@app.command(cls=TrainHelp)
def train(words: TrainWords = None) -> None:
    """Train a victim, with or without a defence, and save it to the zoo.

    For instance: bench train victim=dqn seeds=0,1,2, or bench train defense=advtrain defense.skip=0.3 victim=dqn
    """
    from cavbench.run.config import training_of

    asked = training_of(words or [], start)
    from cavbench.cli import train as cli_train

    cli_train.train(asked, Console())


Out = Annotated[Path | None, typer.Option(help="The same as out=FOLDER.")]


@app.command()
def render(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[out=…] [world=…]",
            help="out=FOLDER for the frames, by default the one that bench run reads; world=NAME for another camera world.",
        ),
    ] = None,
    out: Out = None,
    world: Annotated[str, typer.Option(help="The same as world=NAME.")] = "camera",
) -> None:
    """Render the frames of a camera world. This takes hours; run the same command again to continue.

    It needs the renderer: pip install 'cavbench[render]'. The frames of the standard grid ship with cavbench.
    """
    from cavbench.cli import render as cli_render
    from cavbench.cli.words import split

    _, values = split(words or [], ("out", "world"), names=0)
    cli_render.render(values.get("world", world), _folder(values, out), Console())


@app.command()
def patch(
    action: Annotated[str, typer.Argument(metavar="print|scan", help="print: a PDF. scan: back from a picture.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="FILE [mm=…] [texels=…] [original=…] [site=…] [out=…]",
            help="print: a file of patches/ in a results folder, mm=SIDE. scan: a picture, texels=SIDE or original=FILE.",
        ),
    ] = None,
) -> None:
    """Print a patch at its true size, and read it back from a scan or a photograph of the page."""
    from cavbench.cli.words import split
    from cavbench.core.track import Track, tracks

    keys = {"print": ("mm", "site", "out"), "scan": ("texels", "original", "site", "out")}
    if action not in keys:
        raise UserError(f"bench patch does print or scan, not {action[:40]!r}")
    names, values = split(words or [], keys[action], names=1)
    (able,) = [one for one in tracks() if type(one).paper is not Track.paper][:1]
    able.paper(cast(Literal["print", "scan"], action), names, values, Console())


@app.command()
def show(
    words: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN] [out=…]", help="A results folder, or the name of a pair.")
    ] = None,
    out: Out = None,
    cells: Cells = False,
    as_json: AsJson = False,
) -> None:
    """Show a run: its configuration, provenance, table and recordings. out=FOLDER is the results folder, by default results."""
    from cavbench.cli import show as cli_show
    from cavbench.cli.words import split

    names, values = split(words or [], ("out",), names=1)
    folder = _folder(values, out) or Path("results")
    report = partial(_print_report, cells=cells)
    run = names[0] if names else str(folder)
    if as_json:
        cli_show.show_run(run, folder)
    else:
        cli_show.print_run(run, folder, Console(), report)


@app.command()
def view(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN... [COLUMN=VALUE]... [out=…]",
            help="A recording (.rrd), a results folder, or the name of a pair; then the record to replay.",
        ),
    ],
    out: Out = None,
    save: Annotated[Path | None, typer.Option(help="Write a film: a .gif, .webp or .mp4 file.")] = None,
    seconds: Annotated[str | None, typer.Option(metavar="FROM:TO", help="The part of the film to save.")] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Open it in a browser on this machine, without a display.")
    ] = False,
) -> None:
    """Open a recording in the rerun viewer; with COLUMN=VALUE, replay and record that episode first.

    For instance: bench view results, or bench view zo-advtrain-dqn lanes=3 weather=fog seed=1000017 out=results

    With --save, replay it and write a film. Two pairs are shown one below the other, on the same scenario:
    bench view none-none-dqn pgd-none-dqn --save clip.gif
    """
    from cavbench.cli import view as cli_view
    from cavbench.cli.words import split

    names, values = split(words, (), names=len(words))
    folder = _folder(values, out) or Path("results")
    where = {key: value for key, value in values.items() if key != "out"}
    runs = names or [str(folder)]
    if save is not None:
        cli_view.save_film(runs, where, folder, Console(), save, seconds)
        return
    if len(runs) > 1 or seconds is not None:
        raise UserError("--seconds, and more than one run, need --save FILE")
    cli_view.open_recording(runs[0], [f"{key}={value}" for key, value in where.items()], folder, Console(), web=web)


def _folder(values: dict[str, str], option: Path | None) -> Path | None:
    """The folder of out=FOLDER or --out FOLDER."""
    if "out" in values and option is not None:
        raise UserError("out is given twice")
    folder = Path(values["out"]) if "out" in values else option
    return folder.expanduser() if folder else None


@app.command()
def submit(
    words: Annotated[
        list[str], typer.Argument(metavar="PAIR out=FOLDER [results=FOLDER]", help="A pair of a results folder.")
    ],
) -> None:
    """Write everything that others need to check a pair to one folder: records, weights, commands, environment, a card.

    For instance: bench submit pgd-my_defense-dqn out=submission
    """
    from cavbench.cli import submit as cli_submit

    cli_submit.submit(words, Console())


@app.command()
def verify(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="FOLDER [KEY=VALUE]...",
            help="sample=3 units are replayed (or all); episodes=20 fresh scenarios in each cell are driven (audit=false for "
            "none, salt=NUMBER to repeat them); out=FOLDER adds the records to a results folder.",
        ),
    ],
) -> None:
    """Check a submission: replay a sample, drive fresh scenarios, and print its row. Exit code 1 if it does not hold.

    Its components must be installed with pip. Nothing in the folder is executed.
    """
    from cavbench.cli import submit as cli_submit

    raise typer.Exit(cli_submit.verify(words, Console(), _print_report))


@app.command()
def report(
    words: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[NAME] [out=…] [html=…] [json=…] [csv=…] [latex=…]",
            help="Name of a report (run, cells, leaderboard, worlds, beside, flags, thesis; by default run), a folder, files.",
            autocompletion=completed,
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print a report on all records of a results folder.

    For instance: bench report thesis out=results, or bench report csv=scores.csv latex=scores.tex

    With html=PAGE, write the leaderboards as one HTML file, with JSON and CSV files next to it. json=, csv= and latex= write such
    a file alone: of the leaderboard, or of the report that is named (run has a line a pair). Without out=, the folder is results;
    if it does not exist, a report shows the published records that it ships, if any.
    """
    from cavbench.cli import report as cli_report

    cli_report.print_report(words or [], Console(stderr=as_json), as_json=as_json)


@app.command()
def compare(
    sources: Annotated[
        list[str] | None,
        typer.Argument(metavar="A B", help="Results folders, published, rows such as dqn+advtrain, or commits."),
    ] = None,
    cells: Annotated[bool, typer.Option("--cells", help="Show every cell, not only those that changed.")] = False,
    as_json: AsJson = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown instead.")] = False,
) -> None:
    """Show what is better and what is worse in B than in A, scenario by scenario.

    For instance: bench compare results published, bench compare dqn+advtrain dqn+shield, bench compare HEAD~1 published,
    or bench compare results:dqn results:dqn+shield
    """
    from cavbench.cli import compare as cli_compare

    cli_compare.print_comparison(sources or [], Console(), cells=cells, as_json=as_json, as_markdown=as_markdown)


@app.command()
def fetch(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Files to download.")] = None,
) -> None:
    """Download published weights to the cache, or list them.

    Other commands download what they need; use this before you work without a network.
    """
    from cavbench.cli import fetch as cli_fetch

    cli_fetch.print_fetched(names, Console()) if names else cli_fetch.print_downloads(Console())


def _print_report(track: Track, records: pa.Table, *, cells: bool = False) -> None:
    from cavbench.core import registry

    for name in ("run", "cells") if cells else ("run",):
        registry.resolve(registry.REPORTS, name, "report")({track.name: records}, Console())


def main() -> None:
    """Run the command line. Bad input prints one line on standard error and exits with code 2."""
    debug = "--debug" in sys.argv or bool(os.environ.get("BENCH_DEBUG"))
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    with warnings.catch_warnings():
        if not debug:
            # Warnings of libraries are for the authors of components.
            warnings.simplefilter("ignore")
        warnings.simplefilter("always", Notice)
        warnings.showwarning = _show
        try:
            status = app(arguments, standalone_mode=False)
        except UnfinishedError as error:
            if debug:
                raise
            sys.exit(_complain(*error.lines))
        except (UserError, typer.TyperException) as error:
            if debug:
                raise
            reason = _typed(error) if isinstance(error, typer.TyperException) else str(error)
            sys.exit(_complain(reason))
        # Unexpected errors are mostly in plug-ins: tell their authors how to see the traceback.
        except Exception as error:
            if debug:
                raise
            # What the system refuses is no error of a plug-in.
            if isinstance(error, OSError) and error.filename and error.strerror:
                sys.exit(_complain(f"{error.filename}: {error.strerror}"))
            full = "there is not enough memory for this: choose smaller numbers"
            reason = full if _is_full(error) else f"{type(error).__name__}: {error}"
            sys.exit(_complain(f"{reason} (--debug shows the traceback)"))
    sys.exit(status or 0)


def _typed(error: typer.TyperException) -> str:
    """What was typed wrong, in our own words; those of Typer for what has none."""
    message, context = error.format_message(), getattr(error, "ctx", None)
    if message.endswith("requires an argument."):
        return f"option {error.option_name} needs a value"  # type: ignore[attr-defined]
    if context is None:
        return message
    if found := re.match(
        r"No such command '(.*?)'\.|Got unexpected extra argument\(?s?\)? \((.*)\)", message, re.DOTALL
    ):
        from cavbench.core.registry import unknown

        if found[2]:
            return f"cannot read {short(found[2])}: `bench {context.info_name} --help` says what it takes"
        return unknown(f"command '{short(found[1])}'", found[1], sorted(context.command.commands))
    options = [option for one in context.command.get_params(context) for option in one.opts if option.startswith("-")]
    match type(error).__name__:
        case "NoSuchOption":
            if word := _without_dashes(str(error.option_name), context.info_name):  # type: ignore[attr-defined]
                return f"unknown option {short(error.option_name)!r}: write it without dashes, {word}"  # type: ignore[attr-defined]
            return f"unknown option {short(error.option_name)!r}; known: {', '.join(options)}"  # type: ignore[attr-defined]
        case "MissingParameter":
            name = str(error.param.metavar or error.param.name.upper())  # type: ignore[attr-defined]
            return f"{name.split()[0].rstrip('.')} is missing; `bench {context.info_name} --help` says what it is"
        case _:
            return message


def _without_dashes(option: str, command: str) -> str:
    """The word that was meant by `--attack pgd`; empty if the command has no such key."""
    from cavbench.cli.completion import known_keys

    key = option.lstrip("-").replace("-", "_")
    if command not in ("run", "audit", "certify", "train") or (
        key not in known_keys() and key.partition(".")[0] not in KINDS
    ):
        return ""
    joined = [word.partition("=")[2] for word in sys.argv if word.startswith(f"{option}=")]
    behind = sys.argv[sys.argv.index(option) + 1 :][:1] if option in sys.argv else []
    values = joined or [word for word in behind if "=" not in word and not word.startswith("-")] or ["VALUE"]
    return f"{key}={short(values[0])}"


def _is_full(error: Exception) -> bool:
    """Whether an error says that memory is used up: Python's own, or that of torch, which has no type."""
    return isinstance(error, MemoryError) or "allocate memory" in str(error) or "out of memory" in str(error)


def _show(message: Warning | str, category: type[Warning], filename: str, lineno: int, *_: Any, **__: Any) -> None:
    """Print a warning: a notice as one line, that of a library with its place."""
    text = str(message) if issubclass(category, Notice) else f"{filename}:{lineno}: {category.__name__}: {message}"
    Console(stderr=True).print(Text(f"warning: {bounded(text)}", style="yellow"), soft_wrap=True)


def _complain(*reasons: str) -> int:
    for reason in reasons:
        line = bounded(reason)
        Console(stderr=True).print(Text.assemble(("error:", "bold red"), f" {line}"), soft_wrap=True)
    return 2


if __name__ == "__main__":
    main()
