"""The command line: `bench run | audit | train | list | new | check | render | show | view | report | fetch`.

A command imports what it needs when it is called, so that `bench list` and `--help` do not import torch.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.text import Text

from bench.cli.axes_help import AxesHelp
from bench.errors import UnfinishedError, UserError

if TYPE_CHECKING:
    import pyarrow as pa

    from bench.plugins.track import Track

app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False)

Words = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="KEY=VALUE...",
        help="Comma lists sweep: attack=zo,noise defense=advtrain victim=dqn attack.steps=50 threat.budget=0.1,0.2. "
        "Training seeds and axes select a part of the grid: seeds=0,1 lanes=3,4 weather=clear,rain episodes=20.",
    ),
]


@app.callback()
def bench() -> None:
    """A benchmark for the adversarial robustness of driving policies and object detectors.

    With --debug, or BENCH_DEBUG=1 in the environment, errors show their traceback.
    """


@app.command("list")
def list_components(
    name: Annotated[str, typer.Argument(help="A component to describe, with its parameters.")] = "",
) -> None:
    """List the installed attacks, defences, victims and worlds, or describe one."""
    from bench.cli import listing as cli_list

    cli_list.print_component(name, Console()) if name else cli_list.print_names(Console())


@app.command()
def new(
    kind: Annotated[str, typer.Argument(help="attack, defense or victim.")],
    name: Annotated[str, typer.Argument(help="Its name on the command line, for instance my_attack.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="[track=…] [out=…]", help="track=detection for a detector; out=FOLDER for the package."),
    ] = None,
) -> None:
    """Create a plug-in package: a small component that works and passes its tests, to start from.

    For instance: bench new attack my_attack, or bench new defense my_defense track=detection
    """
    from bench.cli import new as cli_new

    cli_new.print_new(kind, name, words or [], Console())


@app.command()
def check(
    name: Annotated[str, typer.Argument(help="A component, built-in or from a plug-in.")],
    words: Annotated[
        list[str] | None,
        typer.Argument(metavar="[KEY=VALUE]...", help="Its parameters; victim=NAME and world=NAME to check it with."),
    ] = None,
) -> None:
    """Check that a component follows the rules of the benchmark, and print what to fix.

    For instance: bench check my_attack attack.strength=2
    """
    from bench.cli import check as cli_check

    raise typer.Exit(cli_check.print_checks(name, words or [], Console()))


@app.command(cls=AxesHelp)
def run(words: Words = None) -> None:
    """Score attacks on defended victims over a grid of scenarios. Run the same command again to continue an interrupted run.

    For instance: bench run attack=zo defense=advtrain
    """
    from bench.cli import run as cli_run

    cli_run.run(words or [], Console(), _print_report)


@app.command()
def audit(words: Words = None) -> None:
    """Score pairs again on scenarios drawn at this moment. A pair that scores higher on the public ones is flagged, exit code 1.

    The options are those of bench run; salt=NUMBER repeats an audit. For instance: bench audit attack=pgd defense=advtrain
    """
    from bench.cli import audit as cli_audit

    raise typer.Exit(cli_audit.audit(words or [], Console()))


@app.command()
def train(words: Words = None) -> None:
    """Train a victim, with or without a defence, and save it to the zoo.

    For instance: bench train victim=dqn seeds=0,1,2, or bench train defense=advtrain defense.skip=0.3 victim=dqn
    """
    from bench.cli import train as cli_train

    cli_train.train(words or [], Console())


@app.command()
def render(
    out: Annotated[
        Path | None, typer.Option(help="Folder for the frames; by default the one that bench run reads.")
    ] = None,
    world: Annotated[str, typer.Option(help="The camera world.")] = "camera",
) -> None:
    """Render the frames of a camera world. This takes hours; run the same command again to continue.

    It needs the renderer: pip install 'cavbench[render]'. The frames of the standard grid ship with cavbench.
    """
    from bench.cli import render as cli_render

    cli_render.render(world, out, Console())


@app.command()
def show(
    run: Annotated[str, typer.Argument(help="A results folder, or the name of a pair.")] = "results",
    out: Annotated[Path, typer.Option(help="Results folder to look for the pair in.")] = Path("results"),
) -> None:
    """Show a run: its configuration, provenance, table and recordings."""
    from bench.cli import show as cli_show

    cli_show.print_run(run, out, Console(), _print_report)


@app.command()
def view(
    run: Annotated[str, typer.Argument(help="A recording (.rrd), a results folder, or the name of a pair.")],
    where: Annotated[list[str] | None, typer.Argument(metavar="COLUMN=VALUE...", help="The record to replay.")] = None,
    out: Annotated[Path, typer.Option(help="Results folder to look for the pair in.")] = Path("results"),
) -> None:
    """Open a recording in the rerun viewer; with COLUMN=VALUE, replay and record that episode first.

    For instance: bench view results, or bench view zo-advtrain-dqn lanes=3 weather=fog seed=1000017
    """
    from bench.cli import view as cli_view

    cli_view.open_recording(run, where or [], out, Console())


@app.command()
def report(words: Words = None) -> None:
    """Print a report on all records of a results folder.

    For instance: bench report thesis out=results

    With html=PAGE, write the leaderboards as one HTML file, with JSON and CSV files next to it. Without out=, the folder is
    results; if it does not exist, a report shows the published records that it ships, if any.
    """
    from bench.cli import report as cli_report

    cli_report.print_report(words or [], Console())


@app.command()
def fetch(
    names: Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Files to download.")] = None,
) -> None:
    """Download published weights to the cache, or list them.

    Other commands download what they need; use this before you work without a network.
    """
    from bench.cli import fetch as cli_fetch

    cli_fetch.print_fetched(names, Console()) if names else cli_fetch.print_downloads(Console())


def _print_report(track: Track, records: pa.Table) -> None:
    from bench.plugins import registry

    report = registry.resolve(registry.REPORTS, "run", "report")
    report({track.name: records}, Console())


def main() -> None:
    """Run the command line. Bad input prints one line on standard error and exits with code 2."""
    debug = "--debug" in sys.argv or bool(os.environ.get("BENCH_DEBUG"))
    arguments = [argument for argument in sys.argv[1:] if argument != "--debug"]
    try:
        status = app(arguments, standalone_mode=False)
    except UnfinishedError as error:
        if debug:
            raise
        sys.exit(_complain(*error.lines))
    except (UserError, typer.TyperException) as error:
        if debug:
            raise
        reason = error.format_message() if isinstance(error, typer.TyperException) else str(error)
        sys.exit(_complain(reason))
    # Unexpected errors are mostly in plug-ins: tell their authors how to see the traceback.
    except Exception as error:
        if debug:
            raise
        sys.exit(_complain(f"{type(error).__name__}: {error} (--debug shows the traceback)"))
    sys.exit(status or 0)


def _complain(*reasons: str) -> int:
    for reason in reasons:
        line = " ".join(reason.split())
        Console(stderr=True).print(Text.assemble(("error:", "bold red"), f" {line}"), soft_wrap=True)
    return 2


if __name__ == "__main__":
    main()
