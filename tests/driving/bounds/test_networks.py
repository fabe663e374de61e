from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from cavbench.core.pair import choose
from cavbench.driving import Policy
from cavbench.driving.bounds.networks import BoundedNetwork
from cavbench.driving.threat import ObservationThreat, bounds
from cavbench.driving.victims.from_file import FilePolicy
from cavbench.driving.victims.networks import ActorPolicy, QPolicy
from cavbench.errors import UserError

WORLD = choose("world", "highway").component
FEATURES = WORLD.facts.features


def seen(count: int, rows: int = 10) -> Tensor:
    """Random observations [count, rows, 5]: some rows are absent."""
    random = torch.Generator().manual_seed(1)
    observation = torch.rand(count, rows, 5, generator=random) * 2 - 1
    there = torch.rand(count, rows, 1, generator=random) < 0.7
    there[:, 0] = True
    observation[..., :1] = 1
    return observation * there


def trained() -> Policy:
    return choose("defense", "sa").component.load(choose("victim", "dqn").component, 0, WORLD.facts)


def from_file(activation: type[nn.Module]) -> Policy:
    torch.manual_seed(3)
    network = nn.Sequential(nn.Flatten(), nn.Sequential(nn.Linear(50, 24), activation(), nn.Linear(24, 5)))
    return FilePolicy(network, (10, 5), "discrete", 5, "")


def fresh() -> Policy:
    torch.manual_seed(2)
    return QPolicy(5, 5, 16).eval().requires_grad_(False)


POLICIES = {
    "trained": trained,
    "fresh": fresh,
    "relu": lambda: from_file(nn.ReLU),
    "tanh": lambda: from_file(nn.Tanh),
}


@pytest.mark.parametrize("name", list(POLICIES))
@pytest.mark.parametrize("budget", [0.0, 0.01, 0.1, 0.5])
def test_no_point_of_the_box_is_outside_of_the_bounds(name: str, budget: float) -> None:
    policy, observation = POLICIES[name](), seen(12)
    low, high = bounds(observation, ObservationThreat(budget=budget).radius(observation, FEATURES))
    corners = torch.rand(200, *observation.shape, generator=torch.Generator().manual_seed(5))
    corners[:100] = corners[:100].round()
    scores = policy.scores(low + (high - low) * corners).double()
    leads = scores[..., :, None] - scores[..., None, :]
    loose = 1e-5 * (1 + scores.abs().max())
    for through in (True, False):
        found = BoundedNetwork(policy).leads(low, high, through=through)
        assert (found.linear >= found.interval).all()
        assert (leads >= found.linear - loose).all()


def test_bounds_of_a_point_are_its_scores() -> None:
    policy, observation = trained(), seen(6)
    scores = policy.scores(observation).double()
    found = BoundedNetwork(policy).leads(observation, observation)
    for lead in found:
        assert torch.allclose(lead, scores[:, :, None] - scores[:, None, :], atol=1e-5)


def test_gradient_descent_from_many_starts_does_not_pass_the_bound() -> None:
    policy, observation = fresh(), seen(4)
    low, high = bounds(observation, ObservationThreat(budget=0.1).radius(observation, FEATURES))
    bound = BoundedNetwork(policy).leads(low, high).linear[:, 0, 1]
    x = low + (high - low) * torch.rand(20, *observation.shape, generator=torch.Generator().manual_seed(5))
    reached = torch.full(bound.shape, torch.inf)
    for _ in range(40):
        x.requires_grad_()
        scores = policy.scores(x)
        lead = scores[..., 0] - scores[..., 1]
        reached = torch.minimum(reached, lead.detach().amin(0))
        (slope,) = torch.autograd.grad(lead.sum(), x)
        x = (x.detach() - 0.1 * (high - low) * slope.sign()).clamp(low, high)
    assert (reached >= bound - 1e-5).all()
    # The bound is of use: it is not far below what an attack reaches.
    interval = BoundedNetwork(policy).leads(low, high).interval[:, 0, 1]
    assert ((reached - bound) < 0.5 * (reached - interval)).all()


def test_linear_bounds_prove_more_than_intervals() -> None:
    policy, observation = trained(), seen(40)
    low, high = bounds(observation, ObservationThreat(budget=0.005).radius(observation, FEATURES))
    interval, linear = BoundedNetwork(policy).possible(policy.scores(observation), low, high)
    assert not (linear & ~interval).any()
    assert (linear.sum(1) == 1).sum() > 2 * (interval.sum(1) == 1).sum()


def test_the_decision_itself_is_always_possible() -> None:
    policy, observation = trained(), seen(20)
    for found in BoundedNetwork(policy).possible(policy.scores(observation), observation, observation):
        assert found.gather(1, policy.decide(observation)[:, None]).all()


def test_other_networks_are_refused_in_a_sentence() -> None:
    with pytest.raises(UserError, match="continuous"):
        BoundedNetwork(ActorPolicy(5, 8, 0.1))
    with pytest.raises(UserError, match="decides alone"):
        BoundedNetwork(choose("defense", "smoothing").component.load(choose("victim", "dqn").component, 0, WORLD.facts))
    with pytest.raises(UserError, match="LSTM"):
        BoundedNetwork(FilePolicy(nn.Sequential(nn.Flatten(), nn.LSTM(50, 5)), (10, 5), "discrete", 5, ""))
    with pytest.raises(UserError, match="ends with a linear layer"):
        BoundedNetwork(FilePolicy(nn.Sequential(nn.Linear(50, 5), nn.ReLU()), (10, 5), "discrete", 5, ""))
