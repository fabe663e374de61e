"""The base classes of drivers loaded from a user's file, independent of the file format."""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from cavbench.core.ranges import Count
from cavbench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from cavbench.driving.fused.network import chain
from cavbench.driving.victims.spaces import UNKNOWN, Bounds, Expected
from cavbench.errors import UserError, short
from cavbench.formats.trial import RefusedError, failure, hashed, refuse_harm

TRIED = (1, 2, 1500)
"""Batch sizes on which a policy is tested: attacks query many points of many episodes at once."""


class FilePolicy(Policy):
    """A driving policy whose network comes from a file, or from another library.

    Args:
        network: maps observations [N, *shape] to scores [N, A], or to actions [N, 2], which are clipped to [-1, 1].
        shape: input shape: that of the observation (after `native`), or that flattened.
        action_type: discrete or continuous.
        width: size of the output for one observation.
        sha256: hash of the file.
        critic: maps (observations, actions) to values [N, 1], for white-box attacks on continuous actions; None if there is none.
        native: converts observations to the format that the network takes (`DrivingFacts.native`); None leaves them.
    """

    def __init__(
        self,
        network: Callable[[Tensor], Tensor],
        shape: Sequence[int],
        action_type: ActionType,
        width: int,
        sha256: str,
        critic: nn.Module | None = None,
        native: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.network, self.critic, self.native = network, critic, native
        self.shape, self.width = tuple(shape), width
        self.action_type, self.weights_sha256 = action_type, sha256
        self.clips = action_type == "continuous"
        self.fused = chain(network)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> FilePolicy:
        """Stay in eval mode: an exported network has only the mode in which it was exported."""
        self.training = False
        return self

    def forward(self, observation: Tensor) -> Tensor:
        shown = self._shown(observation)
        if not len(shown):
            return self._answered(None, observation)
        if self.fused is not None and self.fused.fits(flat := shown.flatten(1)):
            return self._answered(self.fused(flat), observation)
        return self._answered(self.network(shown), observation)

    def _shown(self, observation: Tensor) -> Tensor:
        """What the network is given for observations [..., V, F]: [N, *shape]."""
        leading = observation.shape[:-2]
        shown = self._native(observation)
        if (own := tuple(shown.shape[len(leading) :])) != self.shape and (math.prod(own),) != self.shape:
            raise UserError(f"the policy takes observations {self.shape}, this world shows {own}")
        return shown.reshape(leading.numel(), *self.shape)

    def _answered(self, output: Tensor | None, observation: Tensor) -> Tensor:
        """The scores of observations [..., V, F] from the output of the network [N, A]; None if there is no observation."""
        leading = observation.shape[:-2]
        if output is None:
            return observation.new_zeros(*leading, self.width)
        if output.is_complex():
            raise UserError("answers complex numbers; scores are real numbers")
        output = output.to(observation.dtype)
        output = output if self.action_type == "discrete" else output.clamp(-1, 1)
        return output.reshape(*leading, output.shape[-1])

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        if self.critic is None:
            return super().value(observation, action, state)
        entries = self._native(observation).reshape(*observation.shape[:-2], -1)
        return self.critic(torch.cat((entries, action), -1)).squeeze(-1)

    def _native(self, observation: Tensor) -> Tensor:
        return observation if self.native is None else self.native(observation)


class Typed(nn.Module):
    """A network that is given its input as numbers of its own precision.

    Args:
        network: the network.
        dtype: what it takes.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype) -> None:
        super().__init__()
        self.network, self.dtype = network, dtype

    def forward(self, observation: Tensor) -> Tensor:
        answer: Tensor = self.network(observation.to(self.dtype))
        return answer


@dataclass(frozen=True, kw_only=True)
class FileDriver(DrivingVictim):
    """A driver from a file.

    Args:
        path: the file.
        actions: `discrete`: the output is the values or logits of the world's actions (on the highway LANE_LEFT, IDLE,
            LANE_RIGHT, FASTER, SLOWER), and the largest is taken; `continuous`: it is [acceleration, steering] in [-1, 1].
        rows: number of rows of its observation, including the ego; None for the world's. Another number is refused.
        features: size of a row: presence and the measured features; None for the world's. A world from a gymnasium environment
            has 1 row, of the values of that environment's observation.
        trained_in: the world of its training, as tables print it: `highway`, or `highway(preset=thesis)`. A file does not say
            it; tables remark on what is unknown, and on a world other than the run's.
    """

    format: ClassVar[str]
    """What the file must be, for errors."""

    path: str
    actions: Literal["discrete", "continuous"] = "discrete"
    rows: Count | None = None
    features: Count | None = None
    trained_in: str = UNKNOWN

    def __post_init__(self) -> None:
        super().__post_init__()
        check_trained_in(self.trained_in)

    @property
    def action_type(self) -> ActionType:
        return self.actions

    @property
    def draws(self) -> bool:
        return False

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        """The policy in the file, for any seed.

        Raises:
            UserError: if the file is missing, cannot be read or does not match the other parameters.
        """
        sha256 = hashed(self.path, "policy")
        refuse_harm(self.path, type(self)._loaded, self, facts, sha256)
        return self._loaded(facts, sha256)

    def _loaded(self, facts: DrivingFacts, sha256: str) -> FilePolicy:
        """The policy, which was tried. Its kernels may crash on a crafted file."""
        self._check_given(facts)
        try:
            policy = self.read(Path(self.path).expanduser(), sha256, facts)
        except UserError:
            raise
        # A truncated file, or one in another format, can fail anywhere in the library that reads it.
        except Exception as error:
            raise UserError(f"{self.path} cannot be read: it is not {self.format}, or a damaged one") from error
        rows, size = Expected(facts=facts, rows=self.rows).shape
        self._try(policy, [rows or math.prod(policy.shape) // size, size])
        return policy

    def _check_given(self, facts: DrivingFacts) -> None:
        """Refuse `rows` and `features` that are not the world's."""
        rows, size = Expected(facts=facts, rows=self.rows).shape
        own = {"rows": rows, "features": size - facts.flat}
        for name, number in own.items():
            if (given := getattr(self, name)) not in (None, number):
                raise UserError(
                    f"victim.{name}={given} is not this world's observation, which has {own['rows'] or 'any number of'} rows of "
                    f"{own['features']} features; leave it out, and train the policy in this world"
                )

    @abstractmethod
    def read(self, path: Path, sha256: str, facts: DrivingFacts) -> FilePolicy:
        """Read the policy from a file.

        Args:
            path: path of the file.
            sha256: hash of its content.
            facts: facts of the world.

        Raises:
            UserError: if it does not match the parameters or the world.
        """

    def width(self, facts: DrivingFacts) -> int:
        """The required size of the output for one observation."""
        return len(facts.actions) if self.action_type == "discrete" else len(facts.controls)

    def fitted(
        self, facts: DrivingFacts, shape: Sequence[int | None], bounds: Bounds | None = None
    ) -> Callable[[Tensor], Tensor] | None:
        """What converts the world's observations for the policy (`Expected.fit`); None if nothing has to.

        Args:
            facts: facts of the world.
            shape: shape of its observations without the batch; None for an axis of any size.
            bounds: its observation space, if the file says it.

        Raises:
            UserError: if it takes other observations than those of the world.
        """
        sides = [side for side in shape if side is not None]
        if len(sides) < len(shape):
            raise UserError(
                f"{self.path} takes observations {['any' if side is None else side for side in shape]}: export it with "
                "fixed sizes of the observation; only the batch size is dynamic"
            )
        return Expected(facts=facts, rows=self.rows).fit(self.path, sides, bounds)

    def _try(self, policy: FilePolicy, observation: Sequence[int]) -> None:
        for batch in TRIED:
            try:
                with torch.no_grad():
                    scores = policy.scores(torch.zeros(batch, *observation), policy.initial(torch.arange(batch)))
            except RefusedError as error:
                raise UserError(f"{self.path} is refused: {error}") from error
            except Exception as error:
                raise UserError(f"{self.path} fails on {_observations(batch)}: {_what(error, batch)}") from error
            wanted = [batch, policy.width]
            if list(scores.shape) != wanted:
                raise UserError(
                    f"{self.path} returns {list(scores.shape)} for {_observations(batch)}, "
                    f"{policy.action_type} actions need {wanted}{self._hint(policy, scores)}"
                )

    def _hint(self, policy: FilePolicy, scores: Tensor) -> str:
        two = scores.shape[-1:] == (2,) and policy.action_type == "discrete"
        return "; if these are acceleration and steering, set victim.actions=continuous" if two else ""


def check_trained_in(world: str) -> None:
    """Refuse what cannot be the name of a world in a table.

    Raises:
        ValueError: in one line.
    """
    if not world.isprintable() or not re.fullmatch(r"[^\s()]+(\(.*\))?", world):
        raise ValueError(
            "trained_in must be the world of the training as tables print it, for instance highway or "
            f"highway(preset=thesis), got {short(world)!r}; leave it out if you do not know it"
        )


def _observations(batch: int) -> str:
    return "1 observation" if batch == TRIED[0] else f"{batch} observations"


def _what(error: Exception, batch: int) -> str:
    """What failed, and what may help."""
    what = failure(error)
    if batch == TRIED[0]:
        return f"{what} fails; if its batch size is fixed, export it with a dynamic one"
    return f"{what} fails, but not on fewer: export it with a dynamic batch size"
