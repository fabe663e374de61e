"""Running sums over a batch of episodes, and the measurements computed from them."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from cavbench.driving.alarms import Alarms
from cavbench.driving.attacker import Shown
from cavbench.driving.features import DrivingFacts
from cavbench.driving.forging import Used
from cavbench.driving.metrics import safe_progress
from cavbench.driving.policy import State, rows_of
from cavbench.driving.strings import Strings
from cavbench.driving.victim import CountedPolicy
from cavbench.isolation.modes import kept
from cavbench.isolation.streams import put_back

CHANGED = 0.1
"""A continuous action counts as changed if it differs by more than this on its [-1, 1] scale."""

Columns = dict[str, NDArray[np.generic]]


class Meter:
    """Running sums over a batch of episodes; an episode is counted until it is done.

    Uses NumPy because a step is about forty operations on [B] numbers, where the call overhead dominates.

    Args:
        subject: the victim.
        facts: facts of the world.
        start_x: [B] place along the road before the first step, in m.
        forges: whether the threat model allows more than changed values.
    """

    FORGED = ("hidden", "invented", "age", "acted", "false_messages")
    SUMS = ("steps", "return", "progress", "mean_speed", "changed", "linf", "l2", "linf_m", "linf_mps", "attack_ms")

    def __init__(self, subject: CountedPolicy, facts: DrivingFacts, start_x: Tensor, *, forges: bool = False) -> None:
        batch = len(start_x)
        self.subject, self.facts = subject, facts
        features = facts.features
        self.half_range = features.half_range().numpy()
        self.positions, self.speeds = (np.array([unit == wanted for unit in features.units]) for wanted in ("m", "m/s"))
        self.sums = np.zeros((len(self.SUMS), batch))
        self.linf_max, self.excess_max = np.zeros(batch, np.float32), np.zeros(batch, np.float32)
        self.min_ttc = np.full(batch, np.inf, np.float32)
        self.crashed, self.offroad = np.zeros(batch, np.bool_), np.zeros(batch, np.bool_)
        self.start_x = start_x.numpy().copy()
        self.end_x = self.start_x.copy()
        self.gradients, self.zero_gradients, self.nan_gradients = np.zeros((3, batch))
        self.assured = np.zeros(batch)
        self.watched = Alarms(subject.policy, batch, 1 / facts.decision_hz)
        self.strings = Strings(batch, 1 / facts.decision_hz)
        self.used = np.full((len(self.FORGED), batch), 0.0 if forges else np.nan)
        self.queries: list[NDArray[np.int64]] = []
        self.actions: list[NDArray[np.int64]] = []

    def unattacked(
        self, truth: Tensor, shown: Shown, driven: Tensor, state: State, numbers: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Which running episodes the attack changes, int64 [R], and what the victim would decide there without it, [R] or [R, 2].

        A random victim draws for this what it draws while it drives: else its noise would count as a success of the attack. So it
        is asked before it drives.

        Args:
            truth: the true observation [B, V, F].
            shown: the observation that the victim is about to receive.
            driven: bool [B], the episodes that are running.
            state: the victim's state before the step.
            numbers: for the draws of the step, int64 [B].
        """
        touched = driven & (shown.observation != truth)[..., 1:].flatten(1).any(1)
        rows = touched.nonzero().squeeze(1)
        if not len(rows):
            return rows, rows
        # Counted as a question: what an episode draws later stays what it is in the records so far.
        self.subject.numbers(rows)
        if self.subject.shares:
            # The generators of the process know no episode: only the same batch draws the same.
            with put_back():
                return rows, self.subject.decided(truth, state, numbers)[rows]
        own = None if numbers is None else numbers[rows]
        return rows, self.subject.decided(truth[rows], rows_of(state, rows), own)

    def step(
        self,
        truth: Tensor,
        shown: Shown,
        unattacked: tuple[Tensor, Tensor],
        action: Tensor,
        driven: Tensor,
        state: State,
        after: TensorDictBase,
    ) -> None:
        """Count one step.

        Args:
            truth: the true observation [B, V, F].
            shown: the observation that the victim received, and its cost.
            unattacked: of this step.
            action: the victim's action.
            driven: bool [B], the episodes that were running before the step.
            state: the victim's state before the step.
            after: the environment's output.
        """
        running = driven.numpy()
        info = {name: value.squeeze(-1).numpy() for name, value in after["info"].items()}
        offset = (shown.observation - truth).abs().numpy()[..., 1:]
        physical = offset * self.half_range
        linf = offset.max((1, 2))
        measured = (
            np.ones(len(running)),
            after["reward"].squeeze(-1).numpy(),
            info["progress"],
            info["speed"],
            self._changed(*unattacked, action),
            linf,
            np.sqrt(np.square(offset).sum((1, 2))),
            physical[..., self.positions].max((1, 2), initial=0.0),
            physical[..., self.speeds].max((1, 2), initial=0.0),
            np.full(len(running), shown.milliseconds / max(running.sum(), 1)),
        )
        self.sums += np.where(running, np.stack(measured), 0.0)
        np.maximum(self.linf_max, linf, out=self.linf_max, where=running)
        np.maximum(self.excess_max, shown.excess.numpy(), out=self.excess_max)
        np.minimum(self.min_ttc, info["ttc"], out=self.min_ttc, where=running)
        self.crashed |= info["crashed"] & running
        self.offroad |= info["offroad"] & running
        np.copyto(self.end_x, info["x"], where=running)
        self.strings.step(info, running)
        with kept("defense"):
            assured = self.subject.policy.assured(shown.observation, state)
        self.assured += np.nan if assured is None else np.where(running, assured.numpy(), 0.0)
        self.watched.step(shown.observation, state, running, running & (linf > 0))
        self.gradients += shown.gradients.numpy()
        self.zero_gradients += shown.zero_gradients.numpy()
        self.nan_gradients += shown.nan_gradients.numpy()
        self.queries.append(np.where(running, shown.queries.numpy(), -1))
        if self.subject.action_type == "discrete":
            self.actions.append(np.where(running, action.numpy(), -1))

    def forged(self, used: Used | None, executed: Tensor, action: Tensor, driven: Tensor) -> None:
        """Count what was used of the other sets of the threat model in a step.

        Args:
            used: cars hidden and invented, and the age of the frame.
            executed: what the cars executed.
            action: what the victim decided.
            driven: bool [B], the episodes that were running before the step.
        """
        if used is None:
            return
        acted = executed is not action and (executed != action).reshape(len(action), -1).any(1).numpy()
        counted = (used.hidden.numpy(), used.invented.numpy(), used.age.numpy(), acted, used.messages.numpy())
        self.used += np.where(driven.numpy(), np.stack(np.broadcast_arrays(*counted)), 0.0)

    def _changed(self, rows: Tensor, clean: Tensor, action: Tensor) -> NDArray[np.float64]:
        """[B] 1 where the attack changed the victim's decision; arguments as `unattacked` returns them."""
        changed, taken, places = np.zeros(len(action)), action[rows], rows.numpy()
        if self.subject.action_type == "discrete":
            changed[places] = (clean != taken).numpy()
        elif len(rows):
            changed[places] = ((clean - taken).abs().amax(-1) > CHANGED).numpy()
        return changed

    def columns(self) -> Columns:
        """The measurements of each episode."""
        sums = dict(zip(self.SUMS, self.sums, strict=True))
        steps = np.maximum(sums["steps"], 1)
        failed = self.crashed | self.offroad
        queries = np.stack(self.queries).astype(np.float64)
        queries[queries < 0] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # An episode that was never driven has no queries.
            mean, median = np.nanmean(queries, 0), np.nanquantile(queries, 0.5, 0, method="lower")
        return {
            "steps": sums["steps"].astype(np.int32),
            "return": sums["return"],
            "safe_progress": safe_progress(sums["progress"], failed, self.facts.max_steps),
            "crashed": self.crashed,
            "offroad": self.offroad,
            "distance_m": (self.end_x - self.start_x).astype(np.float64),
            "min_ttc_s": self.min_ttc.astype(np.float64),
            "queries": mean,
            "queries_median": median,
            "queries_max": np.nan_to_num(queries).max(0),
            "linf_max": self.linf_max.astype(np.float64),
            "excess_max": self.excess_max.astype(np.float64),
            **{name: sums[name] / steps for name in self.SUMS[3:]},
            "action_counts": self._action_counts(),
            "assured": self.assured / steps,
            **self.watched.columns(),
            **self.strings.columns(),
            "gradient_queries": self.gradients / steps,
            "zero_gradients": self._share_of_gradients(self.zero_gradients),
            "nan_gradients": self._share_of_gradients(self.nan_gradients),
            **dict(zip(self.FORGED, self.used / steps, strict=True)),
        }

    def _share_of_gradients(self, count: NDArray[np.float64]) -> NDArray[np.float64]:
        """[B] a count of gradients as a share of all of them; NaN where there were none."""
        return np.where(self.gradients > 0, count / np.maximum(self.gradients, 1), np.nan)

    def _action_counts(self) -> NDArray[np.generic]:
        """[B, A] how often each discrete action was taken; [B, 0] for continuous actions."""
        if not self.actions:
            return np.zeros((len(self.crashed), 0), np.int32)
        actions = np.stack(self.actions, 1)
        count = max(int(actions.max()) + 1, len(self.facts.actions))
        return np.stack([(actions == a).sum(1) for a in range(count)], 1).astype(np.int32)
