"""A driver trained with Stable-Baselines3, rebuilt from its file. Only tensors are unpickled.

A saved model is a zip file. `policy.pth` holds the weights, which torch's restricted unpickler reads; `data` says in text what
they are (`cavbench.driving.victims.sb3_saved`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import torch
from annotated_types import Ge

from cavbench.archive import Archive
from cavbench.driving import ActionType, DrivingFacts
from cavbench.driving.victims.from_file import FileDriver, FilePolicy
from cavbench.driving.victims.remembering import RememberingPolicy
from cavbench.driving.victims.sb3_network import BOTH, NormalisedCritic, Recurrent, critic_in, network_in, normalised
from cavbench.driving.victims.sb3_saved import FORMAT, Algorithm, Saved, saved_model
from cavbench.driving.victims.sb3_seen import Stack, Stacked, statistics
from cavbench.driving.victims.sb3_traces import check_traces
from cavbench.driving.victims.spaces import Bounds, Expected, check_actions, check_range
from cavbench.errors import UserError
from cavbench.formats.trial import hashed
from cavbench.identity.fingerprint import digest


@dataclass(frozen=True, kw_only=True)
class StableBaselines3(FileDriver):
    """A policy trained with Stable-Baselines3 in this world, from the zip of `model.save`; SB3 need not be installed.

    Only `MlpPolicy`, fully connected layers on the flattened observation, and sb3-contrib's `MlpLstmPolicy`. It acts like
    `predict(deterministic=True)`. The algorithm, the spaces and the last observation of the training are read from the file and
    checked. Only the tensors in the file are unpickled.

    Args:
        algo: the algorithm of the training; None reads it from the file.
        actions: `discrete` or `continuous`; None reads it from the file.
        normalize: the file of `VecNormalize.save`, if it was trained behind it; None for none.
        frames: number of frames that it is shown at once (`VecFrameStack`, `FrameStackObservation`).
        padding: what stands for frames before the first: `zero` as in `VecFrameStack`, `reset` for copies of the first, which is
            gymnasium's default; None takes the one that goes with the shape of its observations.
    """

    format: ClassVar[str] = FORMAT

    algo: Algorithm | None = None
    actions: Literal["discrete", "continuous"] | None = None  # type: ignore[assignment] # the file says it, too
    normalize: str | None = None
    frames: Annotated[int, Ge(1)] = 1
    padding: Literal["zero", "reset"] | None = None

    @property
    def action_type(self) -> ActionType:
        if self.algo is not None and self.algo not in BOTH:
            return "discrete" if self.algo == "dqn" else "continuous"
        return self.actions or saved_model(self.path).actions

    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        saved = saved_model(self.path)
        self._check(saved)
        check_actions(self.path, saved.actions, saved.width, facts)
        if saved.range is not None:
            check_range(self.path, saved.range, facts)
        stack, bounds = self._stack(saved, facts)
        native = self.fitted(facts, bounds.shape, bounds)
        normaliser = None if self.normalize is None else statistics(self.normalize)
        self._check_traces(saved, facts, stack, native)
        weights = torch.load(
            Archive(Archive.read(path, self.path).member("policy.pth"), f"{self.path}, policy.pth").repacked(),
            map_location="cpu",
            weights_only=True,
        )
        network, before, critic = network_in(saved, weights), None, critic_in(saved, weights)
        if normaliser is not None and normaliser.shape == saved.observation.shape:
            network, critic = normalised(network, normaliser), critic and NormalisedCritic(critic, normaliser)
        elif normaliser is not None and normaliser.shape == bounds.shape:
            before = normaliser
        elif normaliser is not None:
            raise UserError(
                f"{self.normalize} has statistics of observations {normaliser.shape}, {self.path} takes {saved.observation.shape}"
            )
        options: dict[str, Any] = {
            "shape": bounds.shape,
            "action_type": saved.actions,
            "width": saved.width,
            "sha256": sha256 if self.normalize is None else digest([sha256, hashed(self.normalize, "statistics")]),
            "native": native,
        }
        if stack is not None:
            network = Stacked(network, stack, bounds.shape, before)
        if isinstance(network, Recurrent | Stacked):
            return RememberingPolicy(network, network.memory, **options)
        return FilePolicy(network, critic=critic, **options)

    def _stack(self, saved: Saved, facts: DrivingFacts) -> tuple[Stack | None, Bounds]:
        """The stack of its frames, and the space of one of them."""
        if self.frames == 1:
            if self.padding is not None:
                raise UserError(
                    "victim.padding is for a policy with a stack of frames: say how many with victim.frames=…"
                )
            return None, saved.observation
        expected = Expected(facts=facts, rows=self.rows)
        own = expected.native if facts.flat else expected.shape
        try:
            stack = Stack.of(self.frames, saved.observation.shape, own)
            stack = stack if self.padding is None else replace(stack, zero=self.padding == "zero")
            bounds = stack.bounds(saved.observation)
        except ValueError:
            raise UserError(
                f"{self.path} was trained on {saved.observation}, which is no stack of victim.frames={self.frames} observations "
                f"{own} of this world"
            ) from None
        if saved.algorithm == "recurrent_ppo":
            raise UserError(f"{self.path} is recurrent; victim.frames is for policies without a memory of their own")
        return stack, bounds

    def _check_traces(self, saved: Saved, facts: DrivingFacts, stack: Stack | None, native: object) -> None:
        """Refuse a file whose last observations are none of this world, or that was normalised and nothing says how."""
        if self.normalize is not None:
            return
        last, raw = saved.last, saved.raw
        if stack is not None:
            last, raw = (None if one is None else stack.frame(one, saved.observation.shape) for one in (last, raw))
        expected = Expected(facts=facts, rows=self.rows)
        check_traces(
            self.path, expected, last, raw, saved.kept, native=native is not None, algorithm=saved.algorithm.upper()
        )

    def _check(self, saved: Saved) -> None:
        """Refuse a file that is not what `algo` and `actions` say."""
        if self.algo not in (None, saved.algorithm):
            raise UserError(
                f"{self.path} is a model of {saved.algorithm}, victim.algo says {self.algo}; leave victim.algo out"
            )
        if self.actions not in (None, saved.actions):
            raise UserError(
                f"{self.path} has {saved.actions} actions, victim.actions says {self.actions}; leave victim.actions out"
            )
