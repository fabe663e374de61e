"""What an attack may not do: nothing it does to its oracle counts, and what it does to the victim or the run is named."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from cavbench.core.contracts import Access, QueryBudgetError
from cavbench.core.pair import choose
from cavbench.driving import DrivingAttack, ObservationThreat, Oracle, access, alarms, blame, forging, rss, traffic
from cavbench.driving.access import Enforcer
from cavbench.driving.drive import SEAL
from cavbench.driving.rollout import rollout
from cavbench.driving.victim import CountedPolicy
from cavbench.errors import UserError
from cavbench.isolation.watch import TamperError
from tests.driving.cheats import CELL, SEEDS, WORLD, Noisy, Victim, drive

FAR = 5.0
FEATURES = WORLD.features


def widen(observation: Tensor, oracle: Oracle) -> Tensor:
    oracle.radius.fill_(FAR)
    oracle.observation.fill_(FAR)
    observation.fill_(FAR)
    oracle._bounds = (observation - FAR, observation + FAR)
    object.__setattr__(oracle.threat, "budget", 2.0)
    object.__setattr__(oracle.threat, "queries", 10**6)
    return oracle.project(observation)


def test_widening_everything_on_the_oracle_leaves_the_perturbation_set_as_it_is() -> None:
    assert drive(widen)["linf_max"].max() <= 0.1 + 1e-6


def blind(observation: Tensor, oracle: Oracle) -> None:
    for name in ("low", "high", "floors"):
        object.__setattr__(oracle.features, name, tuple(1.6 * value for value in getattr(oracle.features, name)))


def loosen(observation: Tensor, oracle: Oracle) -> None:
    object.__setattr__(oracle.threat, "norm", "relative")
    object.__setattr__(oracle.threat, "budget", 0.0)


def reseed(observation: Tensor, oracle: Oracle) -> None:
    for part in oracle.parts:
        part.generator.manual_seed(0)


@pytest.mark.parametrize("deed", [blind, loosen, reseed])
def test_what_an_attack_does_to_what_it_is_given_reaches_neither_the_victim_nor_the_world(
    deed: Callable[[Tensor, Oracle], None],
) -> None:
    before = repr(WORLD.facts)
    found, honest = drive(deed, Reads()), drive(lambda observation, oracle: None, Reads())
    for name in ("action_counts", "linf_max", "linf_m", "safe_progress"):
        assert np.array_equal(found[name], honest[name])
    assert repr(WORLD.facts) == before


class Reads(Victim):
    """A victim that reads the features of the world at every step."""

    def forward(self, observation: Tensor) -> Tensor:
        return super().forward(torch.cat((observation[..., :1], WORLD.features.physical(observation)), -1))


def test_the_dynamics_of_an_attack_are_its_own() -> None:
    world = choose("world", "highway").component
    dynamics = world.dynamics([CELL], "discrete")
    policy = Victim()
    threat = ObservationThreat(access="dynamics")
    enforcer = Enforcer(CountedPolicy(policy), threat, "dynamics", FEATURES, torch.Generator(), dynamics)
    given = enforcer.begin(torch.zeros(1, 2, 3)).dynamics
    object.__setattr__(given.config.features, "low", (0.0,) * 4)
    given.parameters.low[:] = 0.0
    assert world.features.low == (-100.0, -20.0, -40.0, -20.0)
    assert {tuple(row) for row in dynamics.parameters.low.tolist()} == {(-100.0, -20.0, -40.0, -20.0)}


@dataclass(frozen=True, kw_only=True)
class Hoards(DrivingAttack):
    """Remembers on itself, not in its state."""

    access: ClassVar[Access] = "oblivious"
    kept: list[int] = field(default_factory=list)
    hidden: bool

    def perturb(self, observation: Tensor, oracle: Oracle) -> Tensor:
        if self.hidden:
            object.__setattr__(self, "_memo", 1)
        else:
            self.kept.append(1)
        return observation


@pytest.mark.parametrize("hidden", [True, False])
def test_an_attack_that_remembers_on_itself_is_refused_and_forgets(hidden: bool) -> None:
    attack = Hoards(hidden=hidden)
    env = WORLD.make([CELL] * len(SEEDS))
    with pytest.raises(TamperError, match=r"Hoards\.(_memo|kept) changed while it was measured: keep .* in the state"):
        rollout(env, Victim(), attack, ObservationThreat(), SEEDS, facts=WORLD.facts, attack_seed=7)
    assert vars(attack) == {"hidden": hidden, "kept": []}


def test_the_oracle_cannot_begin_a_step() -> None:
    with pytest.raises(AttributeError, match="begin_step"):
        drive(lambda observation, oracle: oracle.begin_step(observation, scale=30))


def test_zeroing_the_counter_forgets_no_query() -> None:
    def forget(observation: Tensor, oracle: Oracle) -> None:
        for _ in range(3):
            oracle.scores(observation)
            oracle.spent.zero_()

    assert set(drive(forget)["queries"].tolist()) == {3.0}


def test_the_budget_holds_however_the_attack_changes_its_oracle() -> None:
    def overspend(observation: Tensor, oracle: Oracle) -> None:
        object.__setattr__(oracle.threat, "queries", 10**6)
        for _ in range(51):
            oracle.scores(observation)

    with pytest.raises(QueryBudgetError, match="allows 50"):
        drive(overspend)


@pytest.mark.parametrize("name", ["_paid", "_answered", "scores", "spent", "forged"])
def test_nothing_that_asks_or_pays_can_be_replaced_on_the_oracle(name: str) -> None:
    def replace(observation: Tensor, oracle: Oracle) -> None:
        object.__setattr__(oracle, name, lambda *asked: None)

    with pytest.raises(AttributeError):
        drive(replace)


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_an_oracle_cannot_be_copied_with_the_victim_behind_it(duplicate: Callable[[Oracle], object]) -> None:
    def duplicates(observation: Tensor, oracle: Oracle) -> None:
        duplicate(oracle)

    with pytest.raises(TypeError, match="cannot be copied"):
        drive(duplicates)


class Sly(Tensor):
    """A tensor that could run code of the attack where it is used."""


def test_a_query_of_another_type_than_a_tensor_is_refused() -> None:
    def ask(observation: Tensor, oracle: Oracle) -> None:
        oracle.scores(observation.as_subclass(Sly))

    with pytest.raises(UserError, match=r"asked about a Sly, not about a torch\.Tensor"):
        drive(ask)


def test_queries_on_the_account_of_another_episode_are_noticed() -> None:
    def move(observation: Tensor, oracle: Oracle) -> None:
        spent = oracle._enforcer.spent
        spent[0], spent[-1] = spent[0] - 10**6, spent[-1] + 10**6

    with pytest.raises(TamperError, match="the counts of its queries"):
        drive(move)


def test_catching_the_refusal_gives_no_answer_and_no_query() -> None:
    answers: list[Tensor] = []

    def insist(observation: Tensor, oracle: Oracle) -> None:
        for _ in range(5):
            try:
                answers.append(oracle.scores(observation.expand(20, *observation.shape)))
            except QueryBudgetError:
                continue

    assert drive(insist)["queries_max"].max() == 40
    assert len(answers) == 2 * 90


def test_a_value_of_the_critic_is_a_query() -> None:
    def ask(observation: Tensor, oracle: Oracle) -> None:
        oracle.value(observation, torch.zeros(len(observation), dtype=torch.int64))

    class Critic(Victim):
        def value(self, observation: Tensor, action: Tensor, state: Any = None) -> Tensor:
            return self.scores(observation).gather(-1, action.unsqueeze(-1)).squeeze(-1)

    assert set(drive(ask, Critic())["queries"].tolist()) == {1.0}


def test_a_loss_gets_no_graph_that_leads_into_the_victim() -> None:
    leaves: list[object] = []

    def look(observation: Tensor, oracle: Oracle) -> None:
        def loss(scores: Tensor) -> Tensor:
            assert scores.grad_fn is not None
            leaves.append([type(one).__name__ for one, _ in scores.grad_fn.next_functions])
            return scores.sum(-1)

        oracle.gradient(observation, loss)

    drive(look)
    assert all(leaf == ["AccumulateGrad"] for leaf in leaves)
    assert leaves


def refused(deed: Callable[[Victim], object], match: str) -> TamperError:
    """Why a run was refused in which the attack got hold of the victim."""
    policy = Victim()
    with pytest.raises(TamperError, match=match) as raised:
        drive(lambda observation, oracle: (deed(policy), None)[1], policy)
    return raised.value


def test_asking_the_network_past_the_oracle_is_refused() -> None:
    refused(lambda policy: policy(torch.zeros(1, 2, 3)), "past the oracle")


@pytest.mark.parametrize("hidden", [False, True])
def test_changing_the_weights_is_refused_and_the_attack_is_named(hidden: bool) -> None:
    error = refused(lambda policy: (policy.weights.data if hidden else policy.weights).mul_(0.5), "weights")
    assert error.sides == (("attack", "defense") if hidden else ("attack",))


def test_a_hook_on_the_victim_is_refused() -> None:
    refused(lambda policy: policy.register_forward_hook(lambda module, inputs, output: -output), "hooks")


def test_removing_the_watch_is_refused() -> None:
    refused(lambda policy: policy._forward_pre_hooks.clear(), "hooks")


def test_changing_the_mode_of_the_victim_is_refused() -> None:
    refused(lambda policy: policy.train(), "mode")


def test_changing_a_method_of_the_victim_is_refused() -> None:
    refused(lambda policy: setattr(policy, "forward", lambda shown: torch.zeros(len(shown), 5)), "methods")


def test_changing_the_runs_own_counters_is_refused() -> None:
    def dig(observation: Tensor, oracle: Oracle) -> None:
        oracle.scores(observation)
        oracle._enforcer.spent.zero_()

    with pytest.raises(TamperError, match="changed the counts"):
        drive(dig)


def test_the_runs_own_truth_and_set_cannot_be_written_to() -> None:
    def dig(observation: Tensor, oracle: Oracle) -> None:
        held = oracle._enforcer._set
        for values in (held._truth, held._low, held._high):
            with pytest.raises(ValueError):
                values[:] = FAR
            with pytest.raises(ValueError):
                values.flags.writeable = True

    drive(dig)


def test_an_oracle_of_another_step_is_refused() -> None:
    kept: list[Oracle] = []

    def hoard(observation: Tensor, oracle: Oracle) -> None:
        kept.append(oracle)
        kept[0].scores(observation)

    with pytest.raises(TamperError, match="oracle of another step"):
        drive(hoard)


@pytest.mark.parametrize("library", ["torch", "numpy", "python"])
def test_seeding_the_process_does_not_fix_a_randomised_defences_draw(library: str) -> None:
    import random

    seed = {"torch": torch.manual_seed, "numpy": np.random.seed, "python": random.seed}[library]

    class Random(Victim):
        def forward(self, observation: Tensor) -> Tensor:
            draw = {
                "torch": lambda: torch.rand(5),
                "numpy": lambda: torch.from_numpy(np.random.rand(5)).float(),  # noqa: NPY002
                "python": lambda: torch.tensor([random.random() for _ in range(5)]),
            }[library]()
            return super().forward(observation) + draw

    def fix(observation: Tensor, oracle: Oracle) -> None:
        seed(0)
        oracle.scores(observation)

    def ask(observation: Tensor, oracle: Oracle) -> None:
        oracle.scores(observation)

    fixed, free = (drive(deed, Random())["action_counts"] for deed in (fix, ask))
    assert np.array_equal(fixed, free)
    answers: list[Tensor] = []
    drive(lambda observation, oracle: (seed(0), answers.append(oracle.scores(observation)))[0] and None, Random())
    assert len({tuple(answer[0].tolist()) for answer in answers}) > 1


def test_a_run_leaves_the_random_generators_of_the_process_alone() -> None:
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002
    expected = torch.rand(1).item(), np.random.rand()  # noqa: NPY002
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002
    drive(lambda observation, oracle: torch.rand(9).sum() and np.random.seed(0), Noisy())  # noqa: NPY002
    assert (torch.rand(1).item(), np.random.rand()) == expected  # noqa: NPY002


def test_a_tensor_that_answers_for_itself_is_refused() -> None:
    with pytest.raises(UserError, match=r"returned a Parameter, not a torch\.Tensor"):
        drive(lambda observation, oracle: nn.Parameter(observation, requires_grad=False))


def test_an_answer_that_is_changed_later_changes_nothing() -> None:
    kept: list[Tensor] = []

    def change(observation: Tensor, oracle: Oracle) -> Tensor:
        for answer in kept:
            answer.fill_(FAR)
        kept.append(observation.clone())
        return kept[-1]

    assert drive(change)["linf_max"].max() == 0


def test_not_a_number_is_refused() -> None:
    with pytest.raises(UserError, match="NaN or infinite"):
        drive(lambda observation, oracle: observation * torch.nan)


def test_a_complex_answer_is_refused() -> None:
    with pytest.raises(UserError, match="perturb returned complex numbers"):
        drive(lambda observation, oracle: observation + 0j)


def test_changing_the_settings_of_torch_reaches_nobody() -> None:
    class Sees(Victim):
        kinds: set[tuple[torch.dtype, bool]] = set()  # noqa: RUF012

        def forward(self, observation: Tensor) -> Tensor:
            self.kinds.add((torch.get_default_dtype(), torch.is_grad_enabled()))
            return super().forward(observation)

    def unsettle(observation: Tensor, oracle: Oracle) -> None:
        torch.set_default_dtype(torch.float64)
        torch.set_grad_enabled(True)

    drive(unsettle, Sees(), entropy=3)
    assert {kind for kind, _ in Sees.kinds} == {torch.float32}


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (access.Enforcer, "project"),
        (forging.Forging, "show"),
        (traffic.Orders, "stacked"),
        (blame.Deeds, "append"),
        (rss, "safe_distance"),
        (alarms.Alarms, "step"),
    ],
)
def test_replacing_a_function_that_enforces_or_measures_is_noticed(
    owner: Any, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    SEAL.check()
    monkeypatch.setattr(owner, name, lambda self, answer: (answer, torch.zeros(len(answer))))
    with pytest.raises(TamperError, match=rf"bench\.driving\..*{name} was replaced"):
        SEAL.check()
