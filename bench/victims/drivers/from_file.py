"""The base classes of drivers loaded from a user's file, independent of the file format."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from bench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from bench.errors import UserError
from bench.plugins.ranges import Count
from bench.victims.files.trial import RefusedError, failure, hashed, refuse_harm

CONTROLS = 2
"""Size of a continuous action: acceleration and steering."""
TRIED = (1, 2, 1500)
"""Batch sizes on which a policy is tested: attacks query many points of many episodes at once."""


class FilePolicy(Policy):
    """A driving policy whose network comes from a file, or from another library.

    Args:
        network: maps observations [N, *shape] to scores [N, A], or to actions [N, 2], which are clipped to [-1, 1].
        shape: input shape: [V, F] or, flattened, [V * F]; with flat facts [F - 1].
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
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> FilePolicy:
        """Stay in eval mode: an exported network has only the mode in which it was exported."""
        self.training = False
        return self

    def forward(self, observation: Tensor) -> Tensor:
        leading = observation.shape[:-2]
        if not leading.numel():
            return observation.new_zeros(*leading, self.width)
        output = self.network(self._native(observation).reshape(-1, *self.shape))
        output = output if self.action_type == "discrete" else output.clamp(-1, 1)
        return output.reshape(*leading, output.shape[-1])

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        if self.critic is None:
            return super().value(observation, action, state)
        entries = self._native(observation).reshape(*observation.shape[:-2], -1)
        return self.critic(torch.cat((entries, action), -1)).squeeze(-1)

    def _native(self, observation: Tensor) -> Tensor:
        return observation if self.native is None else self.native(observation)


@dataclass(frozen=True, kw_only=True)
class FileDriver(DrivingVictim):
    """A driver from a file.

    Args:
        path: the file.
        actions: `discrete`: the output is the values or logits of the world's actions (on the highway LANE_LEFT, IDLE,
            LANE_RIGHT, FASTER, SLOWER), and the largest is taken; `continuous`: it is [acceleration, steering] in [-1, 1].
        rows: number of rows of its observation, including the ego; the world must have the same number.
        features: size of a row: presence and the measured features. A world from a gymnasium environment has 1 row, of the
            values of that environment's observation.
    """

    format: ClassVar[str]
    """What the file must be, for errors."""

    path: str
    actions: Literal["discrete", "continuous"] = "discrete"
    rows: Count = 10
    features: Count = 5

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
        width = len(facts.actions) if self.action_type == "discrete" else CONTROLS
        try:
            policy = self.read(Path(self.path).expanduser(), sha256, width)
        except UserError:
            raise
        # A truncated file, or one in another format, can fail anywhere in the library that reads it.
        except Exception as error:
            raise UserError(f"{self.path} cannot be read: it is not {self.format}, or a damaged one") from error
        policy.native = facts.native if facts.flat else None
        self._try(policy, [self.rows, self.features + facts.flat])
        return policy

    @abstractmethod
    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        """Read the policy from a file.

        Args:
            path: path of the file.
            sha256: hash of its content.
            width: required size of the output for one observation.

        Raises:
            UserError: if it does not match the parameters.
        """

    def check_observation(self, shape: Sequence[object]) -> None:
        """Raise UserError unless `shape`, [V, F] or [V * F], matches `rows` and `features`."""
        if list(shape) not in ([self.rows, self.features], [self.rows * self.features]):
            wanted = f"[{self.rows}, {self.features}] or [{self.rows * self.features}]"
            raise UserError(
                f"{self.path} takes observations {list(shape)}, victim.rows and victim.features say {wanted}; "
                "they must match each other and the world"
            )

    def _try(self, policy: FilePolicy, observation: Sequence[int]) -> None:
        for batch in TRIED:
            try:
                with torch.no_grad():
                    scores = policy.scores(torch.zeros(batch, *observation))
            except RefusedError as error:
                raise UserError(f"{self.path} is refused: {error}") from error
            except Exception as error:
                raise UserError(f"{self.path} fails on {_observations(batch)}: {_what(error, batch)}") from error
            wanted = [batch, policy.width]
            if list(scores.shape) != wanted:
                raise UserError(
                    f"{self.path} returns {list(scores.shape)} for {_observations(batch)}, "
                    f"{self.action_type} actions need {wanted}"
                )


def _observations(batch: int) -> str:
    return "1 observation" if batch == TRIED[0] else f"{batch} observations"


def _what(error: Exception, batch: int) -> str:
    """What failed, and what may help."""
    what = failure(error)
    if batch == TRIED[0]:
        return f"{what} fails; if its batch size is fixed, export it with a dynamic one"
    return f"{what} fails, but not on fewer: export it with a dynamic batch size"
