"""The networks of the trained driving policies; they are small, because an attack makes hundreds of queries per step."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from cavbench.driving import Policy, State
from cavbench.driving.fused.network import Fused


class Encoder(nn.Module):
    """The cars around the ego as a set (Zaheer et al. 2017, PointNet's max): [..., V, F] -> [..., F - 1 + `pooled`].

    The same small network reads every other car together with the ego's row, and the outputs are max-pooled over the cars. The
    output does not depend on the order of the rows. With the same training frames it crashes half as often as a plain MLP.
    """

    width, pooled = 32, 32

    def __init__(self, features: int) -> None:
        super().__init__()
        self.car = nn.Linear(features, self.width)
        self.ego = nn.Linear(features - 1, self.width, bias=False)
        self.pair = nn.Linear(self.width, self.pooled)
        self.out_features = features - 1 + self.pooled

    @property
    def layers(self) -> tuple[nn.Linear, nn.Linear, nn.Linear]:
        """The layers of the cars, of the ego and of their pairs."""
        return self.car, self.ego, self.pair

    def forward(self, observation: Tensor) -> Tensor:
        ego, cars = observation[..., 0, 1:], observation[..., 1:, :]
        # One product on contiguous rows is a third faster than one per layer; it dominates the cost of a query.
        rows = torch.cat((cars, ego.unsqueeze(-2).expand(*cars.shape[:-1], -1)), -1)
        weight = torch.cat((self.car.weight, self.ego.weight), 1)
        hidden = nn.functional.linear(rows, weight, self.car.bias).relu_()
        response = (self.pair(hidden) * cars[..., :1]).amax(-2).relu()
        return torch.cat((ego, response), -1)


class QNetwork(nn.Module):
    """Q-values of the actions [..., A] from an observation [..., V, F], as state value plus advantage (Wang et al. 2016)."""

    def __init__(self, features: int, actions: int, hidden: int) -> None:
        super().__init__()
        self.encoder = Encoder(features)
        self.head = _head(self.encoder.out_features, actions + 1, hidden)
        self.fused = Fused(self, layers_of(self.head), encoder=self.encoder.layers, dueling=True)

    def forward(self, observation: Tensor) -> Tensor:
        value, advantage = self.head(self.encoder(observation)).tensor_split([1], -1)
        return value + advantage - advantage.mean(-1, keepdim=True)


class StateValue(nn.Module):
    """V(s) [..., 1] from an observation [..., V, F]."""

    def __init__(self, features: int, hidden: int) -> None:
        super().__init__()
        self.encoder = Encoder(features)
        self.head = _head(self.encoder.out_features, 1, hidden)
        self.fused = Fused(self, layers_of(self.head), encoder=self.encoder.layers)

    def forward(self, observation: Tensor) -> Tensor:
        return self.head(self.encoder(observation))


FEW = 16
"""A matrix product of fewer rows than this may differ in the last bit from the same rows in a product of many."""


def whatever_the_batch(network: nn.Module, observation: Tensor, *more: Tensor) -> Tensor:
    """The output [..., A] of a network for observations [..., V, F], to the last bit the same in every batch.

    Units that are driven together thus have the results that each has alone. A network that is `fused` is one compiled call;
    torch fills up fewer than `FEW` observations.

    Args:
        network: called with all inputs.
        observation: [..., V, F].
        more: further inputs, [..., n] each.
    """
    if torch.compiler.is_exporting():
        # An exported program has one graph for every size of the batch.
        return network(observation, *more)
    fused = getattr(network, "fused", None)
    # A training has torch's numbers, also those of its target networks.
    if isinstance(fused, Fused) and not network.training and fused.fits(observation, *more):
        return fused(observation, *more)
    leading = observation.shape[:-2]
    missing = FEW - leading.numel()
    if not 0 < missing < FEW:
        answer: Tensor = network(observation, *more)
        return answer
    rows = [one.reshape(leading.numel(), *one.shape[len(leading) :]) for one in (observation, *more)]
    full = [torch.cat((one, one[:1].expand(missing, *one.shape[1:]))) for one in rows]
    return whatever_the_batch(network, *full)[: leading.numel()].reshape(*leading, -1)


class QPolicy(Policy):
    """The greedy policy of a Q-network.

    Args:
        features: F, size of an observation row.
        actions: A, number of actions.
        hidden: width of the two hidden layers after the encoder.
    """

    action_type = "discrete"

    def __init__(self, features: int, actions: int, hidden: int) -> None:
        super().__init__()
        self.shape = {"features": features, "actions": actions, "hidden": hidden}
        self.network = QNetwork(features, actions, hidden)

    def forward(self, observation: Tensor) -> Tensor:
        return whatever_the_batch(self.network, observation)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.scores(observation).gather(-1, action.unsqueeze(-1)).squeeze(-1)


def compiled(policy: Policy, observation: Tensor) -> Fused | None:
    """The compiled network whose answers about observations [..., V, F] are the scores of a policy; None if torch answers."""
    if type(policy).scores is not Policy.scores or type(policy).forward is not QPolicy.forward:
        return None
    if "forward" in vars(policy) or "scores" in vars(policy) or policy._forward_pre_hooks or policy._forward_hooks:
        return None
    network: object = policy.network
    if type(network) is not QNetwork or network.training:
        return None
    return network.fused if network.fused.fits(observation) else None


class Actor(nn.Module):
    """mu(s): acceleration and steering [..., 2] within +-limit, from an observation [..., V, F]."""

    def __init__(self, features: int, hidden: int, limit: Tensor) -> None:
        super().__init__()
        self.encoder = Encoder(features)
        self.head = _head(self.encoder.out_features, 2, hidden)
        self.limit: Tensor
        self.register_buffer("limit", limit, persistent=False)
        self.fused = Fused(self, layers_of(self.head, nn.Tanh), encoder=self.encoder.layers, scale=limit)

    def forward(self, observation: Tensor) -> Tensor:
        return self.head(self.encoder(observation)).tanh() * self.limit


class Critic(nn.Module):
    """Q(s, a) [..., 1] from an observation [..., V, F] and an action [..., 2]."""

    def __init__(self, features: int, hidden: int, limit: Tensor) -> None:
        super().__init__()
        self.encoder = Encoder(features)
        self.head = _head(self.encoder.out_features + 2, 1, hidden)
        self.limit: Tensor
        self.register_buffer("limit", limit, persistent=False)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        *hidden, last = self.head
        found = torch.cat((self.encoder(observation), action / self.limit), -1)
        for layer in hidden:
            found = layer(found)
        # The last bit of a product of a matrix and a vector depends on the number of rows; that of these sums does not.
        return (found * last.weight[0]).sum(-1, keepdim=True) + last.bias


def layers_of(head: MLP, last: type[nn.Module] | None = None) -> list[tuple[nn.Linear, type[nn.Module] | None]]:
    """The linear layers of a head, each with the activation after it; `last` follows the last one."""
    linears = [layer for layer in head if isinstance(layer, nn.Linear)]
    return [*((linear, nn.ReLU) for linear in linears[:-1]), (linears[-1], last)]


def _head(inputs: int, outputs: int, hidden: int) -> MLP:
    return MLP(in_features=inputs, out_features=outputs, num_cells=[hidden, hidden], activation_class=nn.ReLU)


class ActorPolicy(Policy):
    """A deterministic actor with the critic of its training.

    Args:
        features: F, size of an observation row.
        hidden: width of the two hidden layers of actor and critic; each has its own encoder.
        steering_limit: largest |steering| of the actor, on the [-1, 1] scale of 45 degrees. At 25 m/s a car that steers more
            leaves its lane within one or two control periods.
    """

    action_type = "continuous"

    def __init__(self, features: int, hidden: int, steering_limit: float) -> None:
        super().__init__()
        self.shape = {"features": features, "hidden": hidden, "steering_limit": steering_limit}
        limit = torch.tensor([1.0, steering_limit])
        self.actor = Actor(features, hidden, limit)
        self.critic = Critic(features, hidden, limit)

    def forward(self, observation: Tensor) -> Tensor:
        return whatever_the_batch(self.actor, observation)

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return whatever_the_batch(self.critic, observation, action).squeeze(-1)
