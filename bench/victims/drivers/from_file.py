"""What drivers that come in a user's file have in common, whatever the file holds."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn

from bench.driving import ActionType, DrivingFacts, DrivingVictim, Policy, State
from bench.errors import UserError, reason
from bench.plugins.ranges import Count

CONTROLS = 2
"""Numbers of a continuous action: acceleration and steering."""
TRIED = (1, 2, 1500)
"""Batches that a policy is tried on: attacks ask about many points of many episodes at once."""


class FilePolicy(Policy):
    """A network of a file at the wheel.

    Args:
        network: from observations [N, *shape] to [N, A] scores, or [N, 2] actions, which are clipped to [-1, 1].
        shape: of what it takes: [V, F] or, flattened, [V * F].
        action_type: what it decides.
        width: numbers it gives for an observation.
        sha256: of the file.
        critic: from (observations, actions) to [N, 1] values, for white-box attacks on continuous actions; None if there is none.
    """

    def __init__(
        self,
        network: Callable[[Tensor], Tensor],
        shape: Sequence[int],
        action_type: ActionType,
        width: int,
        sha256: str,
        critic: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.network, self.critic = network, critic
        self.shape, self.width = tuple(shape), width
        self.action_type, self.weights_sha256 = action_type, sha256
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> FilePolicy:
        """Into eval mode and no other: an exported network has one mode only, that of its export."""
        self.training = False
        return self

    def forward(self, observation: Tensor) -> Tensor:
        leading = observation.shape[:-2]
        if not leading.numel():
            return observation.new_zeros(*leading, self.width)
        answer = self.network(observation.reshape(-1, *self.shape))
        answer = answer if self.action_type == "discrete" else answer.clamp(-1, 1)
        return answer.reshape(*leading, answer.shape[-1])

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        if self.critic is None:
            return super().value(observation, action, state)
        return self.critic(torch.cat((observation.flatten(-2), action), -1)).squeeze(-1)


@dataclass(frozen=True, kw_only=True)
class FileDriver(DrivingVictim):
    """A driver from a file.

    Args:
        path: the file.
        actions: `discrete`: it gives values or logits of the world's actions (on the highway LANE_LEFT, IDLE, LANE_RIGHT,
            FASTER, SLOWER), and the largest is done; `continuous`: it gives [acceleration, steering] in [-1, 1].
        rows: of the observation it was trained on, the ego's own among them; the world must show as many.
        features: numbers in a row: presence and the measured ones.
    """

    path: str
    actions: Literal["discrete", "continuous"] = "discrete"
    rows: Count = 10
    features: Count = 5

    @property
    def action_type(self) -> ActionType:
        return self.actions

    def load(self, seed: int, facts: DrivingFacts) -> Policy:
        """The policy in the file, whatever the seed.

        Raises:
            UserError: if the file is not there, cannot be read or does not fit the other parameters.
        """
        path = Path(self.path).expanduser()
        if not path.is_file():
            raise UserError(f"there is no file {self.path}; say victim.path=… where it is")
        try:
            width = len(facts.actions) if self.action_type == "discrete" else CONTROLS
            policy = self.read(path, hashlib.sha256(path.read_bytes()).hexdigest(), width)
        except UserError:
            raise
        # A file that is cut short or of another kind can fail anywhere in the library that reads it.
        except Exception as error:
            raise UserError(f"{self.path} cannot be read: {reason(error)}") from error
        self._try(policy)
        return policy

    @abstractmethod
    def read(self, path: Path, sha256: str, width: int) -> FilePolicy:
        """The policy in a file.

        Args:
            path: of the file.
            sha256: of its content.
            width: numbers that the policy must give for an observation.

        Raises:
            UserError: if it is not what the parameters say.
        """

    def check_observation(self, shape: Sequence[object]) -> None:
        """Raise UserError unless observations of the shape [V, F] or [V * F] are those of `rows` and `features`."""
        if list(shape) not in ([self.rows, self.features], [self.rows * self.features]):
            wanted = f"[{self.rows}, {self.features}] or [{self.rows * self.features}]"
            raise UserError(
                f"{self.path} takes observations {list(shape)}, victim.rows and victim.features say {wanted}; "
                "the world must show the same"
            )

    def _try(self, policy: FilePolicy) -> None:
        for batch in TRIED:
            try:
                with torch.no_grad():
                    answer = policy.scores(torch.zeros(batch, self.rows, self.features))
            except Exception as error:
                raise UserError(
                    f"{self.path} takes no batch of {batch}: export it with a batch of any size ({reason(error)})"
                ) from error
            wanted = [batch, policy.width]
            if list(answer.shape) != wanted:
                raise UserError(
                    f"{self.path} gives {list(answer.shape)} for {batch} observations, {self.action_type} actions are {wanted}"
                )
