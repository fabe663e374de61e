"""Command-line options such as `attack=zo,noise attack.steps=50 lanes=3,4`: hydra's grammar, types checked by OmegaConf.

Comma lists of seeds and of the axes of a world (lanes, weather) select values; all other comma lists sweep. A parameter is
passed to those of the chosen components that have it.
"""

from __future__ import annotations

import copy
import itertools
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import Field, field, fields, is_dataclass, make_dataclass
from enum import Enum
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cavbench.core import budgets, registry, sets, suites
from cavbench.core.contracts import Access, Defense, ThreatModel
from cavbench.core.outline import outline
from cavbench.core.pair import Chosen, choose
from cavbench.core.parameters import Parameter, flattened, parameters
from cavbench.core.registry import KINDS, Kind
from cavbench.core.suites import Suite
from cavbench.core.track import track
from cavbench.errors import PluginError, UserError, message, short
from cavbench.scenarios import Axes, Axis, Value

LONGEST_VALUE, MOST_VALUES = 5_000, 1_000
"""Limits of what is parsed: the characters of a value, and the values of a list."""
NESTED = re.compile(r"\[[^\]]*\[|\(.*\(.*\(")
"""A list in a list, which no option takes. A parser of deep nesting is slow."""
DEFAULTS: dict[Kind, str] = {"attack": "none", "defense": "none", "victim": "dqn"}


class Options:
    """The given options: the values of each key, in hydra's override grammar.

    Args:
        words: options, each `key=value`.
        kinds: kinds of components that may be chosen.
        settings: dataclass of the other keys.
        axes: names of the axes of all worlds; empty for a training, which has neither cells nor a threat model.

    `broken` says of each component that was left out of a sweep what is wrong with it.
    """

    def __init__(
        self, words: Sequence[str], *, kinds: Sequence[Kind], settings: type[Any], axes: Sequence[str] = ()
    ) -> None:
        self.kinds, self.axes = tuple(kinds), tuple(axes)
        self.schema = settings
        keys = [word.partition("=")[0] for word in words]
        if twice := [key for key in keys if keys.count(key) > 1]:
            hint = "" if twice[0] == "out" else f"; separate its values with commas: {short(twice[0])}=a,b"
            raise UserError(f"{short(twice[0])} is given twice{hint}")
        # Paths bypass hydra: its grammar gives a meaning to many characters that occur in them.
        paths = {item.name: item.metadata["path"] for item in fields(settings) if "path" in item.metadata}
        self.paths = {key: word.partition("=")[2] for key, word in zip(keys, words, strict=True) if key in paths}
        if empty := [key for key, path in self.paths.items() if not path]:
            raise UserError(f"{empty[0]} has an empty value; write {empty[0]}={paths[empty[0]]}")
        self.values: dict[str, tuple[str, ...]] = {}
        self.broken: dict[str, str] = {}
        self._made: dict[Kind, list[Chosen[Any]]] = {}
        for override in _parsed([word for key, word in zip(keys, words, strict=True) if key not in paths]):
            key = override.key_or_group
            self._check_key(key)
            self.values[key] = _elements(override)

    def _check_key(self, key: str) -> None:
        head, _, parameter = key.partition(".")
        # Only `bench run` has axes; `bench train` takes no threat model.
        threats = [f"threat.{item.name}" for item in fields(ThreatModel)] if self.axes else []
        if threats and head == "threat" and parameter:
            # `threats` checks it against the threat model of the victim's track.
            return
        settings = [name for item in fields(self.schema) for name in _setting_names(item)]
        known = [*self.kinds, *settings, *self.axes, *threats]
        if key not in known and not (head in self.kinds and parameter):
            raise UserError(registry.unknown(f"key {short(key)!r}", key, known))

    def check_names(self) -> None:
        """Refuse names of components that nothing has. It is quick: nothing is imported.

        Raises:
            UserError: if there is one.
        """
        for kind in self.kinds:
            # A training takes one attack, no suite of them.
            known = [*registry.names(kind), *(suites.names() if self.axes and kind == "attack" else [])]
            for name in self.values.get(kind, ()):
                # Hydra's grammar escapes the colon of NAME:CHOICE.
                plain = name.replace("\\:", ":").partition(":")[0]
                for link in registry.split(plain) if kind == "defense" else [plain]:
                    if link not in known:
                        registry.find(registry.GROUPS[kind], link, kind)

    def settings(self) -> dict[str, Any]:
        """The values of the keys that choose neither a component nor a cell."""
        lists = {item.name for item in fields(self.schema) if "list" in str(item.type)}
        overrides = []
        for key, values in self.values.items():
            if key.partition(".")[0] in (*self.kinds, *self.axes, "threat"):
                continue
            if key not in lists and len(values) > 1:
                raise UserError(f"{key} takes one value, got {short(','.join(values))}")
            whole = values[0] if len(values) == 1 and values[0].startswith("[") else f"[{','.join(values)}]"
            overrides.append(f"{key}={whole if key in lists else values[0]}")
        found = OmegaConf.to_container(_composed(OmegaConf.structured(self.schema), overrides, self.schema))
        assert isinstance(found, dict)
        return {str(key): value for key, value in found.items()} | self.paths

    def cell_values(self, axes: Axes) -> dict[str, tuple[Value, ...]]:
        """The given values on the axes of the world of the run.

        Raises:
            UserError: if the world does not have the axis, or a value is not allowed.
        """
        given = [key for key in self.values if key in self.axes]
        if strange := [key for key in given if key not in axes]:
            raise UserError(registry.unknown(f"axis {strange[0]!r} of the world", strange[0], axes))
        return {
            key: tuple(_axis_value(axes[key], text) for text in _distinct(key, _listed(self.values[key])))
            for key in given
        }

    @cached_property
    def track(self) -> str:
        """Name of the track of the chosen victims.

        Raises:
            UserError: if they belong to several tracks.
        """
        found = {chosen.component.tracks()[0]: chosen.name for chosen in self.chosen("victim")}
        if len(found) > 1:
            victims = " and ".join(f"{name!r} ({track})" for track, name in found.items())
            raise UserError(
                f"victims {victims} belong to different tracks: start one run for each; both may use the same out="
            )
        return next(iter(found))

    def chosen(self, kind: Kind) -> list[Chosen[Any]]:
        """The chosen components of a kind, with every combination of their parameter values; each is made once.

        Broken plug-ins are left out, if there is another component: see `broken`.

        Raises:
            UserError: if a component or a parameter is unknown, a value is not allowed, or every component is broken.
        """
        if kind not in self._made:
            self._made[kind] = self._make(kind)
        return list(self._made[kind])

    def _make(self, kind: Kind) -> list[Chosen[Any]]:
        names = self.values.get(kind) or (track(self.track).world if kind == "world" else DEFAULTS[kind],)
        # Hydra's grammar escapes the colon of NAME:CHOICE.
        names = tuple(name.replace("\\:", ":") for name in names)
        if kind == "attack":
            names = tuple(name for name in names if name not in suites.names())
        if kind != "victim":
            names = tuple(registry.on_track(kind, name, self.track) for name in names)
        known = self._parameters(kind, names)
        swept = {key.partition(".")[2]: v for key, v in self.values.items() if key.startswith(f"{kind}.")}
        if swept and not names:
            fixed = " and ".join(suite.name for suite in self.suites)
            raise UserError(f"the attacks of the suite {fixed} have fixed parameters, got {kind}.{next(iter(swept))}")
        self._refuse_unknown(kind, names, known)
        found: dict[str, Chosen[Any]] = {}
        for name, owned in known.items():
            _check_lists(kind, owned, swept)
            keys = [key for key in swept if key.partition(".")[0] in owned]
            for values in itertools.product(*(swept[key] for key in keys)):
                with self._left_out(name):
                    one = configured(kind, name, dict(zip(keys, values, strict=True)))
                    found[f"{name} {one.params}"] = one
        if names and not found:
            raise PluginError(self.broken[names[0]])
        return list(found.values())

    def _refuse_unknown(self, kind: Kind, names: Sequence[str], known: Mapping[str, Mapping[str, Parameter]]) -> None:
        """Refuse a parameter that no chosen component has."""
        for key in (key.partition(".")[2] for key in self.values if key.startswith(f"{kind}.")):
            if not any(key.partition(".")[0] in owned for owned in known.values()):
                if lost := [why for name, why in self.broken.items() if name in names]:
                    raise PluginError(lost[0])
                what = f"parameter {kind}.{key} of {', '.join(names)}"
                every = dict.fromkeys(name for owned in known.values() for name in owned)
                raise UserError(registry.unknown(what, key, every))

    def check_outlines(self) -> None:
        """Refuse what built-in components do not allow, as far as their sources say it. It is quick: torch is not imported.

        Raises:
            UserError: if a parameter is unknown, or a value is not allowed.
        """
        victims = [outline("victim", name) for name in self.values.get("victim", (DEFAULTS["victim"],))]
        on = {victim.tracks()[0] for victim in victims if victim is not None}
        if len(on) != 1 or None in victims:
            return
        for kind in self.kinds:
            names = [name for name in self.values.get(kind, ()) if kind != "attack" or name not in suites.names()]
            names = names or ([DEFAULTS[kind]] if kind in DEFAULTS and kind not in self.values else [])
            if kind == "world" and not names:
                names = [track(next(iter(on))).world]
            names = names if kind == "victim" else [registry.on_track(kind, name, next(iter(on))) for name in names]
            found = {name: outline(kind, name) for name in names}
            if found and None not in found.values():
                self._check_outlines(kind, {name: one for name, one in found.items() if one is not None})
        if self.axes and victims[0] is not None and isinstance(victims[0].threat, type):
            self._threats(victims[0].threat, next(iter(on)))

    def modules(self) -> list[str]:
        """The modules of the built-in components that are named, or chosen by default; nothing is imported to know them."""
        outlines = [outline("victim", name) for name in self.values.get("victim", (DEFAULTS["victim"],))]
        on = [victim.tracks()[0] for victim in outlines if victim is not None][:1]
        found: dict[str, None] = {}
        for kind in self.kinds if on else ():
            for name in self.values.get(kind, (DEFAULTS[kind],) if kind in DEFAULTS else ()):
                for link in registry.split(name) if kind == "defense" else (name,):
                    claims = registry.entries(registry.GROUPS[kind]).get(registry.on_track(kind, link, on[0]), ())
                    found |= {one.target.partition(":")[0]: None for one in claims if one.distribution == registry.OWN}
        return list(found)

    def _check_outlines(self, kind: Kind, found: Mapping[str, type[Any]]) -> None:
        known = {name: parameters(one) for name, one in found.items()}
        self._refuse_unknown(kind, list(found), known)
        swept = {key.partition(".")[2]: values for key, values in self.values.items() if key.startswith(f"{kind}.")}
        for name, owned in known.items():
            _check_lists(kind, owned, swept)
            keys = [key for key in swept if key.partition(".")[0] in owned]
            for values in itertools.product(*(swept[key] for key in keys)):
                arguments = _arguments(kind, name, owned, dict(zip(keys, values, strict=True)))
                try:
                    found[name](**arguments)
                except ValueError as error:
                    raise UserError(f"{kind} {name!r}: {message(error)}") from error

    def _parameters(self, kind: Kind, names: Sequence[str]) -> dict[str, dict[str, Parameter]]:
        """The parameters of the components that can be loaded."""
        found = {}
        for name in names:
            with self._left_out(name):
                found[name] = parameters(registry.load(kind, name))
        return found

    @contextmanager
    def _left_out(self, name: str) -> Iterator[None]:
        """Note in `broken` that a component is broken."""
        try:
            yield
        except PluginError as error:
            self.broken[name] = str(error)

    @cached_property
    def suites(self) -> list[Suite]:
        """The suites of attacks in `attack=`.

        Raises:
            UserError: if a suite is broken, or is not for the track of the victims.
        """
        found = [suites.suite(name, self.track) for name in self.values.get("attack", ()) if name in suites.names()]
        for suite in found:
            if suite.track != self.track:
                fitting = [one for one in suites.names() if suites.suite(one).track == self.track]
                raise UserError(
                    f"suite {suite.name!r} is for the {suite.track} track; suites for the {self.track} track of the victim: "
                    f"{', '.join(fitting) or 'none is installed'}"
                )
        return found

    def threats(self) -> list[ThreatModel]:
        """The threat models: every combination of the given values. A suite needs the access of its members by default."""
        model = self.chosen("victim")[0].component.threat
        if self.suites and "threat.access" not in self.values:
            self.values["threat.access"] = (max((suite.access for suite in self.suites), key=get_args(Access).index),)
        for name, value in suites.allowed(self.suites).items():
            self.values.setdefault(f"threat.{name}", (str(value),))
        return self._threats(model, self.track)

    def _threats(self, model: type[ThreatModel], track_name: str) -> list[ThreatModel]:
        owned = parameters(model)
        keys = [key for key in self.values if key.startswith("threat.")]
        names = [key.removeprefix("threat.") for key in keys]
        nested = {name: parameters(kind) for name, kind in sets.of(model).items()}
        every = [name for name in owned if name not in nested]
        every += [f"{name}.{inner}" for name, known in nested.items() for inner in known]
        if strange := [key for key, name in zip(keys, names, strict=True) if name not in every]:
            known = [f"threat.{name}" for name in every]
            raise UserError(registry.unknown(f"key {strange[0]!r} of the {track_name} track", strange[0], known))
        found = []
        for values in itertools.product(*(self.values[key] for key in keys)):
            given = dict(zip(names, values, strict=True))
            budget, confirmed = budgets.read(given.get("budget"))
            given |= {} if budget is None else {"budget": str(budget)}
            flat = {name: value for name, value in given.items() if "." not in name}
            arguments = _arguments("threat", "model", {name: owned[name] for name in every if name in owned}, flat)
            for name, own_fields in nested.items():
                inner = {key.partition(".")[2]: value for key, value in given.items() if key.startswith(f"{name}.")}
                own = _arguments(f"threat.{name}", name, own_fields, inner)
                # Those that were not typed keep their defaults.
                arguments |= {name: {key: own[key] for key in inner}} if inner else {}
            try:
                found.append(budgets.checked(model(**arguments), confirmed=confirmed))
            except ValueError as error:
                raise UserError(str(error)) from error
        return found


def configured(kind: Kind, name: str, values: Mapping[str, str]) -> Chosen[Any]:
    """A component by name, with parameters parsed as on the command line.

    Raises:
        UserError: if a value cannot be parsed or is not allowed.
    """
    owned = parameters(registry.load(kind, name))
    known = flattened(registry.load(kind, name))
    for key in values:
        head = key.partition(".")[0]
        if head not in owned or (_is_link(owned[head].hint) and key not in known):
            raise UserError(registry.unknown(f"parameter {kind}.{key} of {name}", key, known))
    return choose(kind, name, **_arguments(kind, name, owned, values))


def parameter_words(text: str) -> dict[str, str]:
    """Parameters in one text, as in `attack_params` of adversarial training: "steps=3 restarts=2".

    Raises:
        UserError: if a part is not `name=value`.
    """
    found = {}
    for word in text.split():
        name, equals, value = word.partition("=")
        if not equals:
            raise UserError(
                f'attack_params takes name=value pairs, for instance "steps=3 restarts=2", got {short(word)!r}'
            )
        found[name] = value
    return found


def _setting_names(setting: Field[Any]) -> list[str]:
    """The keys of a setting: its name or, if it is a group, those of its members."""
    group = setting.default_factory
    if isinstance(group, type) and is_dataclass(group):
        return [f"{setting.name}.{item.name}" for item in fields(group)]
    return [setting.name]


def _parsed(words: Sequence[str]) -> list[Override]:
    overrides = []
    for word in words:
        key, equals, value = word.partition("=")
        if not (equals and re.fullmatch(r"\w+(\.\w+)*", key)):
            raise UserError(f"cannot read {short(word)!r}: write key=value, for instance attack=zo or lanes=3,4")
        if not value:
            raise UserError(f"{key} has an empty value; write {key}=value")
        if "${" in value or not value.isprintable():
            raise UserError(f"cannot read {short(word)!r}: a value is plain text on one line, without ${{…}}")
        if len(value) > LONGEST_VALUE or NESTED.search(value):
            raise UserError(f"cannot read {short(word)!r}: a value is one word, or a list a,b,c of them")
        try:
            override = _override(word)
        except HydraException:
            # The value is outside of hydra's grammar: quote it as plain text.
            escaped = value.replace("\\", "\\\\").replace('"', '\\"')
            try:
                override = _override(f'{key}="{escaped}"')
            except HydraException as error:
                raise UserError(f"cannot read {short(word)!r}") from error
        overrides.append(override)
    return overrides


@lru_cache(maxsize=1000)
def _override(word: str) -> Override:
    """One option in hydra's grammar, which takes a millisecond to read; a run reads its own several times.

    Raises:
        HydraException: if it is outside of the grammar.
    """
    (override,) = OverridesParser.create().parse_overrides([word])
    return override


def _elements(override: Override) -> tuple[str, ...]:
    swept = override.is_sweep_override()
    key = override.key_or_group
    try:
        every = override.sweep_string_iterator() if swept else iter([override.get_value_element_as_str()])
        values = list(itertools.islice(every, MOST_VALUES + 1))
    except (HydraException, ValueError, TypeError) as error:
        raise UserError(f"cannot read {short(str(override.input_line))!r}") from error
    if len(values) > MOST_VALUES:
        raise UserError(f"{key} has more than {MOST_VALUES} values")
    return _distinct(key, values)


def _distinct(key: str, values: Sequence[str]) -> tuple[str, ...]:
    """The values, none of which is empty or given twice."""
    if "" in values:
        raise UserError(f"{key} has an empty value; write {key}=value")
    if twice := [value for value in values if values.count(value) > 1]:
        raise UserError(f"{key} has the value {short(twice[0])!r} twice")
    return tuple(values)


def _listed(values: Sequence[str]) -> Sequence[str]:
    """The values of `key=a,b` or `key=[a,b]`."""
    if len(values) == 1 and values[0].startswith("[") and values[0].endswith("]"):
        return [value.strip() for value in values[0][1:-1].split(",")]
    return values


def _axis_value(axis: Axis, text: str) -> Value:
    try:
        return axis.read(text)
    except ValueError as error:
        if axis.kind == "str" and axis.choices:
            raise UserError(registry.unknown(f"{axis.name} {short(text)!r}", text, map(str, axis.choices))) from error
        raise UserError(str(error)) from error


NOUNS = {"Integer": "a whole number", "Float": "a number", "Boolean": "true or false", "String": "text"}


def _composed(config: DictConfig, overrides: list[str], schema: type[Any]) -> DictConfig:
    """A structured config with other values.

    Raises:
        UserError: if one of them has another type than its field.
    """
    try:
        for override in map(_override, overrides):
            OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
        OmegaConf.resolve(config)
        return config
    except (HydraException, OmegaConfBaseException) as error:
        full = str(getattr(error, "full_key", "") or "").partition("[")[0]
        word = next((word for word in overrides if full and word.startswith(f"{full}=")), " ".join(overrides))
        key, _, value = word.partition("=")
        names = {item.name for item in fields(schema)}
        wanted = re.search(r"could not be converted to (\w+)", str(error))
        noun = NOUNS.get(wanted[1]) if wanted else None
        if key.rpartition(".")[2] in names and noun:
            listed = "whole numbers, for instance 0,1,2" if "[" in value and noun == NOUNS["Integer"] else noun
            raise UserError(f"{key} must be {listed}, got {short(value)}") from error
        raise UserError(f"cannot read {short(word)}: its value is not of the type that {short(key)} takes") from error


def _schema(owned: dict[str, Parameter]) -> type[Any]:
    """A structured config of a component's parameters, with types that OmegaConf supports."""
    made: list[tuple[str, Any, Any]] = []
    for parameter in owned.values():
        value = parameter.default
        if _is_link(parameter.hint):
            link = _schema(parameters(parameter.hint))
            made.append((parameter.name, link, field(default_factory=link)))
            continue
        default = field() if parameter.required else field(default_factory=partial(copy.copy, value))
        made.append((parameter.name, _omegaconf_type(parameter.hint), default))
    return make_dataclass("Parameters", made, kw_only=True)


def _omegaconf_type(hint: Any) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return type(arguments[0])
    if origin in (Union, types.UnionType):
        # OmegaConf knows no union with a container.
        found = tuple(_omegaconf_type(argument) for argument in arguments)
        return Any if Any in found else Union[found]  # noqa: UP007
    if origin in (tuple, list):
        return list[_omegaconf_type(arguments[0])]  # type: ignore[misc]
    plain = isinstance(hint, type) and issubclass(hint, (bool, int, float, str, Path, Enum, types.NoneType))
    return hint if plain or is_dataclass(hint) else Any


def _arguments(kind: str, name: str, owned: dict[str, Parameter], given: Mapping[str, str]) -> dict[str, Any]:
    """Constructor arguments from values in hydra's grammar: typed, checked against the choices, lists as tuples."""
    given_names = {key.partition(".")[0] for key in given}
    if missing := [f"{kind}.{key}=…" for key, p in owned.items() if p.required and key not in given_names]:
        raise UserError(f"{kind} {name!r} needs {', '.join(missing)}")
    if not given:
        return {}
    schema = _schema(owned)
    try:
        config = OmegaConf.create()
        OmegaConf.update(config, kind, OmegaConf.structured(schema))
    except OmegaConfBaseException as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"the parameters of {kind} {name!r} cannot be set on the command line: {reason}") from error
    overrides = [f"{kind}.{key}={value}" for key, value in given.items()]
    composed = OmegaConf.select(_composed(config, overrides, schema), kind)
    arguments = OmegaConf.to_object(composed)
    return _read(kind, owned, arguments)


def _check_lists(kind: str, owned: Mapping[str, Parameter], swept: Mapping[str, Sequence[str]]) -> None:
    """Refuse a comma list, which sweeps, for a parameter whose value is a list."""
    for key, values in swept.items():
        if key in owned and _takes_lists(owned[key].hint) and not all(value.startswith("[") for value in values):
            listed = short(",".join(values))
            raise UserError(f"{kind}.{key} takes a list, which goes in brackets: write {kind}.{key}=[{listed}]")


def _takes_lists(hint: Any) -> bool:
    """Whether every value of a type is a list, or nothing."""
    hints = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    return all(get_origin(one) in (tuple, list) for one in hints if one is not types.NoneType)


def _read(kind: str, owned: dict[str, Parameter], arguments: Any) -> dict[str, Any]:
    """The typed values of a component's parameters; those of the links of a chain are defences."""
    values = {item: getattr(arguments, item) for item in owned}
    for key, value in values.items():
        if _is_link(owned[key].hint):
            values[key] = _link(f"{kind}.{key}", owned[key].hint, value)
            continue
        choices = owned[key].choices
        if choices and value is not None and value not in choices:
            line = registry.unknown(f"{kind}.{key} {short(str(value))!r}", str(value), map(str, choices))
            component = f"; {value!r} is a {kind}: write {kind}={value}"
            raise UserError(line + (component if kind in KINDS and str(value) in registry.names(kind) else ""))
        if isinstance(value, list):
            values[key] = tuple(value)
    return values


def _is_link(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, Defense)


def _link(prefix: str, link: type[Any], arguments: Any) -> Any:
    try:
        return link(**_read(prefix, parameters(link), arguments))
    except ValueError as error:
        raise UserError(f"{prefix}: {str(error).splitlines()[0]}") from error
