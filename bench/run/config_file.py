"""A run in a file: `config=study.yaml` stands for its words, and every run writes such a file into its folder.

A key of the file is a key of the command line, a value is what stands behind `=` there, and a list is a comma list. Hydra
composes the file with those that its `defaults` list names; words that are typed replace what the file says. The files are data:
nothing in them is executed, and nothing outside of them is read.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from cavbench import __version__, bounded, files
from cavbench.errors import UserError, message, short
from cavbench.identity.fingerprint import digest

KEY = "config"
FOLDER = "runs"
"""Where a results folder has the files of its runs."""
MOST_BYTES, DEEPEST, MOST_NODES, MOST_FILES = 50_000, 8, 5_000, 20
"""Limits of a file: bytes, levels, nodes; and the files of a composition."""
PART = re.compile(r"[\w-][\w.-]*(/[\w-][\w.-]*)*")
"""A name in a `defaults` list: a file beside the first one, or in a folder there."""


def expanded(words: Sequence[str]) -> list[str]:
    """The words with those of the file that `config=` names; each word that is typed replaces the file's.

    Raises:
        UserError: if the file cannot be read, is no such file, or `config` is given twice.
    """
    named = [word.partition("=")[2] for word in words if word.startswith(f"{KEY}=")]
    if not named:
        return list(words)
    if len(named) > 1:
        raise UserError(f"{KEY} is given twice: a file may name others in its defaults list")
    typed = [word for word in words if not word.startswith(f"{KEY}=")]
    keys = {word.partition("=")[0] for word in typed}
    return [f"{key}={value}" for key, value in read(_found(named[0])).items() if key not in keys] + typed


def _found(text: str) -> Path:
    """The file that is meant: of a results folder with one run, the file of that run."""
    if not text:
        raise UserError(f"{KEY} has an empty value; write {KEY}=FILE.yaml")
    path = Path(text).expanduser()
    if not path.is_dir():
        return path
    runs = sorted((path / FOLDER).glob("*.yaml"))
    if len(runs) != 1:
        known = f"has {len(runs)} runs: choose one of {', '.join(map(str, runs[:5]))}" if runs else "has no run in it"
        raise UserError(f"the folder {short(text)} {known}; {KEY}= takes a file, or a folder with one run")
    return runs[0]


def read(path: Path) -> dict[str, str]:
    """The words of a file by their keys, composed by Hydra.

    Args:
        path: a `.yaml` file.

    Raises:
        UserError: if it, or a file of its `defaults`, is missing, too large, too deep or no such file.
    """
    if path.suffix != ".yaml":
        raise UserError(f"{KEY} takes a file that ends in .yaml, or a results folder, got {short(str(path))}")
    _check(path, set())
    # Only a run with a file needs it, and it takes a tenth of a second.
    from hydra import compose, initialize_config_dir
    from hydra.errors import HydraException
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        with initialize_config_dir(config_dir=str(path.parent.absolute()), version_base="1.3"):
            composed = OmegaConf.to_container(compose(path.stem), resolve=False)
    except (HydraException, OmegaConfBaseException, yaml.YAMLError) as error:
        raise UserError(f"{path} cannot be composed: {getattr(error, 'problem', None) or message(error)}") from error
    found: dict[str, str] = {}
    for key, value in _flat(composed, path):
        if key in found:
            raise UserError(f"{path} has {short(key)} twice")
        found[key] = value
    return found


def _flat(composed: Any, path: Path, prefix: str = "") -> Iterator[tuple[str, str]]:
    """The keys and values as they are typed: nested keys are joined by points, a list is a comma list."""
    for name, value in composed.items():
        key = f"{prefix}{name}"
        if key == KEY:
            raise UserError(f"{path} has a key {KEY!r}: name other files in its defaults list")
        if isinstance(value, Mapping):
            yield from _flat(value, path, f"{key}.")
        elif isinstance(value, list):
            yield key, ",".join(_word(one, key, path) for one in value)
        else:
            yield key, _word(value, key, path)


def _word(value: Any, key: str, path: Path) -> str:
    """A scalar as it is typed."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float, str)):
        return str(value)
    if value is None:
        raise UserError(f"{path}: {short(key)} has no value")
    raise UserError(f"{path}: a list of {short(key)} has a list in it; write a value that is a list in quotes: '[1,2]'")


def _check(path: Path, seen: set[Path], above: tuple[Path, ...] = ()) -> None:
    """Refuse a file, and those that it names, that is larger, deeper or cleverer than a list of options is.

    Args:
        path: the file.
        seen: all files of the composition so far.
        above: those that named it.
    """
    if path in above:
        raise UserError(f"{path} names itself in its defaults list")
    seen.add(path)
    if len(seen) > MOST_FILES:
        raise UserError(f"{path} is one of more than {MOST_FILES} files of a composition")
    try:
        text = bounded.content(path, most=MOST_BYTES).decode()
        _check_events(text, path)
        loaded = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise UserError(f"{path} is no YAML: {' '.join(str(error).split())[:200]}") from None
    if not isinstance(loaded, dict):
        raise UserError(f"{path} has no keys: write KEY: VALUE lines, for instance attack: pgd")
    if "hydra" in loaded:
        raise UserError(f"{path} has the key hydra: it takes the options of bench run, and a defaults list")
    defaults = loaded.get("defaults", [])
    for name in defaults if isinstance(defaults, list) else [defaults]:
        for part in _named(name, path):
            if (named := path.parent / f"{part}.yaml") not in seen or named in (*above, path):
                _check(named, seen, (*above, path))


def _named(entry: object, path: Path) -> Iterator[str]:
    """The files that an entry of a `defaults` list names: NAME, or FOLDER: NAME."""
    if entry == "_self_":
        return
    folder, name = "", entry
    if isinstance(entry, dict) and len(entry) == 1:
        ((folder, name),) = entry.items()
    parts = [part for part in (folder, name) if isinstance(part, str) and PART.fullmatch(part)]
    if len(parts) < 1 + (folder != ""):
        raise UserError(f"{path}: a defaults list takes NAME, FOLDER: NAME or _self_, got {short(str(entry))}")
    yield "/".join(parts)


def _check_events(text: str, path: Path) -> None:
    """Look at a file as a stream of events, so that nothing is built before its size is known."""
    depth = nodes = documents = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise UserError(f"{path} has anchors or aliases (& and *), which a file of options does not need")
        if (tag := getattr(event, "tag", None)) is not None:
            raise UserError(f"{path} has the tag {short(str(tag))}: values are plain text")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        documents += isinstance(event, yaml.DocumentStartEvent)
        nodes += isinstance(event, yaml.NodeEvent)
        if isinstance(event, yaml.ScalarEvent):
            _check_scalar(event, path)
        if depth > DEEPEST or nodes > MOST_NODES or documents > 1:
            what = f"deeper than {DEEPEST} levels" if depth > DEEPEST else f"more than {MOST_NODES} values"
            raise UserError(f"{path} is {what if documents <= 1 else 'more than one document'}")


def _check_scalar(event: yaml.ScalarEvent, path: Path) -> None:
    """Refuse a value that YAML takes for another one than the command line does: 010 is 8, 1:30 is 90, `no` is false."""
    text = event.value
    if "${" in text:
        raise UserError(f"{path} has a ${{…}}: values are plain text")
    if event.style is not None:
        return
    value = yaml.safe_load(text)
    if isinstance(value, bool):
        same = text.lower() == str(value).lower()
    elif isinstance(value, int):
        # Python reads signs, zeros in front and underscores as the command line does.
        same = re.fullmatch(r"[+-]?[0-9]+(_[0-9]+)*", text) is not None and int(text) == value
    else:
        # Of what Python does not read as that number, such as 1:30.5 and 0_., the command line makes a text.
        same = not isinstance(value, float) or not math.isfinite(value) or _number(text) == value
    if not same:
        raise UserError(
            f"{path}: YAML reads {short(text)} as {_word(value, text, path)}; write that, or '{text}' in quotes for the text"
        )


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def write(out: Path, words: Mapping[str, str]) -> Path:
    """Write the file of a run into its results folder, atomically, and return it. The same words have the same file.

    Args:
        out: results folder.
        words: all that decides the records, by key.

    Raises:
        UserError: if it cannot be written.
    """
    names = "-".join(re.sub(r"[^\w+]+", "_", words.get(kind, ""))[:30] for kind in ("attack", "defense", "victim"))
    path = out / FOLDER / f"{names}-{digest(sorted(words.items()))[:8]}.yaml"
    lines = [f"# cavbench {__version__}. To repeat or to continue this run: bench run {KEY}=THIS_FILE"]
    # Without quotes a reader may take a text for a number: 0E0.
    quoted = {
        key: yaml.safe_dump(value, default_style='"', allow_unicode=True, width=10_000).rstrip()
        for key, value in words.items()
    }
    lines += [f"{key}: {value}" for key, value in quoted.items()]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with files.whole(path) as file:
            file.write(("\n".join(lines) + "\n").encode())
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
    return path
