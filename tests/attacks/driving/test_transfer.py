"""Transfer: the lies of surrogates, which are never the victim itself."""

from __future__ import annotations

import pytest
import torch

from cavbench.attacks.driving.noise import Noise
from cavbench.attacks.driving.pgd import PGD
from cavbench.attacks.driving.surrogates import Surrogates
from cavbench.attacks.driving.transfer import Transfer
from cavbench.core.pair import choose
from cavbench.driving import ActionType, ObservationThreat
from cavbench.errors import UserError
from tests.attacks.driving.victims import FEATURES, observations, perturb, victim
from tests.cli.test_cli import assert_one_line
from tests.command import Bench


@pytest.mark.parametrize("action_type", ["discrete", "continuous"])
def test_on_the_victim_itself_it_does_about_what_pgd_does_and_asks_nothing(action_type: ActionType) -> None:
    policy, seen = victim(action_type, 3), observations(40, 3)
    itself = Transfer(objective="margin").armed(Surrogates([policy]))
    shown, queries, *_ = perturb(itself, policy, seen)
    by_pgd, by_noise = (perturb(attack, policy, seen)[0] for attack in (PGD(objective="margin"), Noise()))
    clean = policy.scores(seen)

    def changed(points: torch.Tensor) -> float:
        if action_type == "continuous":
            return float((policy.scores(points) - clean).norm(dim=-1).mean())
        return float((policy.decide(points) != clean.argmax(-1)).float().mean())

    assert float(torch.as_tensor(queries).sum()) == 0
    assert changed(shown) > changed(by_noise)
    assert changed(shown) >= 0.7 * changed(by_pgd)
    radius = ObservationThreat(budget=0.2).radius(seen, FEATURES)
    assert bool(((shown - seen).abs() <= radius + 1e-6).all())


def test_of_two_surrogates_neither_counts_for_more_because_its_values_are_larger() -> None:
    small, seen = victim("discrete", 1), observations(60, 1)
    large = victim("discrete", 2)
    scaled = victim("discrete", 2)
    with torch.no_grad():
        last = scaled.network.head[-1]
        last.weight.mul_(1000.0)
        last.bias.mul_(1000.0)
    both, other = (
        perturb(Transfer(objective="margin").armed(Surrogates([small, one])), small, seen)[0] for one in (large, scaled)
    )
    torch.testing.assert_close(both, other, atol=1e-4, rtol=0)


def test_surrogates_are_of_other_training_seeds_than_the_victims() -> None:
    world, nothing = choose("world", "highway").component, choose("defense", "none").component
    dqn = choose("victim", "dqn").component
    for seed in (0, 9):
        found = Transfer(surrogates="dqn+ddpg", seeds=2).load(dqn, nothing, seed, world.facts)
        own = dqn.load(seed, world.facts).weights_sha256
        hashes = [policy.weights_sha256 for policy in found.policies]
        assert len(set(hashes)) == 4
        assert own not in hashes
    assert hashes[:2] == [dqn.load(other, world.facts).weights_sha256 for other in (0, 1)]


@pytest.mark.parametrize("name", ["idm", "planner", "yolov5"])
def test_a_surrogate_that_is_no_trained_policy_is_refused(name: str) -> None:
    world, nothing = choose("world", "highway").component, choose("defense", "none").component
    with pytest.raises(UserError, match="is no trained driving policy; allowed are dqn, ddpg, ppo and sac"):
        Transfer(surrogates=name).load(choose("victim", "dqn").component, nothing, 0, world.facts)


def test_there_is_nothing_to_train(bench: Bench) -> None:
    said = bench("train", "attack=transfer", "victim=dqn", "seeds=0")
    assert_one_line(said, "nothing to train: its surrogates are victims")
