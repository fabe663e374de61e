"""Attacks of the Adversarial Robustness Toolbox (ART) on driving policies, by name: `attack=art:SquareAttack`."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from cavbench.core.contracts import Access
from cavbench.driving import ActionType, DrivingAttack
from cavbench.errors import UserError

if TYPE_CHECKING:
    from cavbench.driving import Oracle

ATTACKS: dict[str, Access] = {
    "BoundaryAttack": "decisions",
    "HopSkipJump": "decisions",
    "SignOPTAttack": "decisions",
    "SquareAttack": "scores",
    "AutoConjugateGradient": "gradients",
    "AutoProjectedGradientDescent": "gradients",
    "BasicIterativeMethod": "gradients",
    "CarliniL2Method": "gradients",
    "CarliniLInfMethod": "gradients",
    "DeepFool": "gradients",
    "ElasticNet": "gradients",
    "FastGradientMethod": "gradients",
    "MomentumIterativeMethod": "gradients",
    "NewtonFool": "gradients",
    "ProjectedGradientDescent": "gradients",
}
"""The supported attacks of ART, with the access each needs."""
BATCHED = ("BasicIterativeMethod", "MomentumIterativeMethod", "ProjectedGradientDescent", "SquareAttack")
"""Attacks that treat the episodes of a batch independently. The others are called once per episode."""
FIXED: dict[str, Any] = {"norm": np.inf, "eps": 1.0, "verbose": False}
"""Arguments that the threat model or the benchmark sets."""
LEFT_OUT = (*FIXED, "batch_size", "targeted", "summary_writer", "loss_type", "random_eps", "nb_restarts")
DEFAULTS: dict[str, dict[str, object]] = {"SquareAttack": {"p_init": 0.3}}
"""Defaults that replace ART's own, which need a larger image than an observation."""
PLAIN: dict[str, type] = {"bool": bool, "float": float, "int": int, "str": str}
"""Argument types that the command line supports."""


@dataclass(frozen=True, kw_only=True)
class ART(DrivingAttack):
    """An attack of the Adversarial Robustness Toolbox (Nicolae et al. 2018, "Adversarial Robustness Toolbox v1.0.0").

    ART's own code; it queries the victim through the oracle. It works on the box [-1, 1]^n, the perturbation set scaled by its
    radius. Its goal is any action other than the clean one or, if set, the action `target`. An episode makes no more queries in
    a step once the goal is reached or the query budget is spent; the result is the best queried point. For discrete actions.

    Needs the toolbox: pip install 'cavbench[art]'.
    """

    action_types: ClassVar[tuple[ActionType, ...]] = ("discrete",)
    libraries: ClassVar[tuple[str, ...]] = ("adversarial-robustness-toolbox",)
    access: ClassVar[Access] = "gradients"
    choice: ClassVar[str]

    @classmethod
    def choices(cls) -> Mapping[str, str]:
        return {name: f"needs {access}" for name, access in ATTACKS.items()}

    @classmethod
    def chosen(cls, choice: str) -> type[ART]:
        return _component(choice)

    def __reduce__(self) -> tuple[Any, ...]:
        return _remade, (self.choice, asdict(self))

    def __post_init__(self) -> None:
        from cavbench.attacks.driving.art_victim import Classifier

        if self._target is not None and self._target < 0:
            raise ValueError(f"target must be at least 0, got {self._target}")
        self._on(Classifier())

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        from cavbench.attacks.driving.art_victim import Classifier, OverError, Search, seeded

        if not len(observation) or int(oracle.remaining.min()) < 1:
            return observation
        clean = oracle.decide(observation) if self.access == "decisions" else oracle.scores(observation)
        if self._target is not None and clean.ndim > 1 and self._target >= clean.shape[-1]:
            raise ValueError(f"target must be below the victim's {clean.shape[-1]} actions, got {self._target}")
        seed = int(torch.randint(2**31, (1,), generator=oracle.generator))
        best, everyone = observation.clone(), torch.arange(len(observation))
        for rows in (everyone,) if self.choice in BATCHED else everyone.split(1):
            search = Search(oracle.select(rows), clean[rows], self._target)
            if search.over:
                continue
            origin = search.origin()
            classifier = Classifier(origin.shape[1:], search.classes)
            attack = self._on(classifier)
            classifier.search = search
            labels = np.eye(search.classes, dtype=np.float32)[search.labels.numpy()]
            with seeded(seed), suppress(OverError):
                search.scores(attack.generate(x=origin, y=labels))
            best[rows] = search.best
        return best

    @property
    def _target(self) -> int | None:
        return getattr(self, "target", None)

    def _on(self, classifier: object) -> Any:
        """ART's attack object for a classifier."""
        original = _original(self.choice)
        arguments = FIXED | {"targeted": self._target is not None} | asdict(self)
        if self.choice in BATCHED:
            arguments["batch_size"] = sys.maxsize
        return original(classifier, **{name: arguments[name] for name in _signature(original) if name in arguments})


def _original(choice: str) -> Any:
    """The class of this name in ART."""
    try:
        from art.attacks import evasion
    except ImportError:
        raise UserError("attack 'art' needs the Adversarial Robustness Toolbox: pip install 'cavbench[art]'") from None
    return getattr(evasion, choice)


@cache
def _signature(original: Any) -> dict[str, inspect.Parameter]:
    """The constructor's arguments after the victim."""
    _, _, *arguments = inspect.signature(original.__init__).parameters.items()
    return dict(arguments)


@cache
def _component(choice: str) -> type[ART]:
    """An attack of ART as a component, with its constructor's arguments as parameters."""
    original = _original(choice)
    signature = _signature(original)
    hints, defaults = {}, {}
    for name, argument in signature.items():
        annotated = str(argument.annotation).split(" | ")
        types = [kind for name_of_type, kind in PLAIN.items() if name_of_type in annotated]
        if name not in LEFT_OUT and types:
            hints[name] = types[0] if argument.default is not None else types[0] | None
            defaults[name] = argument.default
    if "eps_step" in hints:
        # Keep ART's default ratio of step size to eps.
        defaults["eps_step"] = round(signature["eps_step"].default / signature["eps"].default, 3)
    meanings = _meanings(original.__init__)
    if "targeted" in signature:
        hints["target"], defaults["target"] = int | None, None
        meanings["target"] = "index of the target action; null for any action other than the clean one."
    summary = re.sub(r"^\| ", "", inspect.cleandoc(original.__doc__), flags=re.MULTILINE)
    lines = [f"    {name}: {meanings.get(name, '')}" for name in hints]
    body = {
        "__annotations__": hints,
        "__doc__": "\n".join((summary, "", inspect.cleandoc(ART.__doc__ or ""), "", "Args:", *lines)),
        "__module__": __name__,
        "access": ATTACKS[choice],
        "choice": choice,
        **defaults,
        **DEFAULTS.get(choice, {}),
    }
    return dataclass(frozen=True, kw_only=True)(type(choice, (ART,), body))


def _meanings(function: Any) -> dict[str, str]:
    """The description of each argument in a Sphinx docstring."""
    entries = re.findall(r":param (\w+):(.*?)(?=:param|:type|:return|\Z)", function.__doc__ or "", re.DOTALL)
    return {name: " ".join(text.split()) for name, text in entries}


def _remade(choice: str, values: dict[str, Any]) -> ART:
    """Rebuild a pickled attack; its class is made at run time and cannot be imported by name."""
    return _component(choice)(**values)
