"""A driving policy with a memory: a gated recurrent unit between the encoder and the head of a DQN."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.modules import MLP

from cavbench.driving import Policy, State
from cavbench.driving.fused.recurrent import Recurrent
from cavbench.driving.victims.networks import Encoder, QPolicy, layers_of, whatever_the_batch


class RecurrentNetwork(nn.Module):
    """Logits [..., A] and the memory after an observation [..., M], from the observation [..., V, F] and the memory before it.

    The memory is a GRU (Cho et al. 2014) on the encoded observation; the head reads both. Arguments as of `RecurrentPolicy`.
    """

    def __init__(self, features: int, actions: int, hidden: int, memory: int) -> None:
        super().__init__()
        self.encoder = Encoder(features)
        size = self.encoder.out_features
        self.cell = nn.GRUCell(size, memory)
        self.head = MLP(
            in_features=size + memory, out_features=actions, num_cells=[hidden, hidden], activation_class=nn.ReLU
        )
        self.fused = Recurrent(self, self.encoder.layers, self.cell, layers_of(self.head))

    def forward(self, observation: Tensor, memory: Tensor) -> Tensor:
        """Both in one tensor [..., A + M]."""
        encoded = self.encoder(observation)
        after = self.cell(encoded.flatten(0, -2), memory.flatten(0, -2)).unflatten(0, memory.shape[:-1])
        return torch.cat((self.head(torch.cat((encoded, after), -1)), after), -1)

    def unrolled(self, observation: Tensor, memory: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """The logits [B, T, A] of T decisions in a row, and the memory after each [B, T, M].

        Args:
            observation: what is shown, [B, T, V, F].
            memory: the memory before the first of them, [B, M].
            first: bool [B, T], whether an episode begins with this observation; the memory is then empty.
        """
        encoded, kept, after = self.encoder(observation), ~first.unsqueeze(-1), []
        for step, goes_on in zip(encoded.unbind(1), kept.unbind(1), strict=True):
            memory = self.cell(step, memory * goes_on)
            after.append(memory)
        memories = torch.stack(after, 1)
        return self.head(torch.cat((encoded, memories), -1)), memories


class RecurrentPolicy(Policy):
    """The greedy policy of a recurrent network. Its state is the memory before the observation.

    Args:
        features: F, size of an observation row.
        actions: A, number of actions.
        hidden: width of the two hidden layers of the head.
        memory: M, size of the memory.
    """

    action_type = "discrete"

    def __init__(self, features: int, actions: int, hidden: int, memory: int) -> None:
        super().__init__()
        self.shape = {"features": features, "actions": actions, "hidden": hidden, "memory": memory}
        self.network = RecurrentNetwork(features, actions, hidden, memory)

    @classmethod
    @torch.no_grad()
    def continuing(cls, start: QPolicy, memory: int, temperature: float) -> RecurrentPolicy:
        """A policy that decides like `start`: its logits are the advantages over `temperature`, without weight on the memory."""
        policy = cls(**start.shape, memory=memory)
        network, given = policy.network, start.network
        network.encoder.load_state_dict(given.encoder.state_dict())
        for own, old in zip(list(network.head)[::2], list(given.head)[::2], strict=True):
            # The first output of the Q-network is the value of the state.
            own.bias.copy_(old.bias[-own.out_features :])
            own.weight[:, : old.in_features].copy_(old.weight[-own.out_features :])
        network.head[0].weight[:, network.encoder.out_features :].zero_()
        for values in (network.head[-1].weight, network.head[-1].bias):
            values.div_(temperature)
        return policy

    def initial(self, episodes: Tensor) -> State:
        return TensorDict({"memory": torch.zeros(len(episodes), self.shape["memory"])}, batch_size=episodes.shape)

    def scores(self, observation: Tensor, state: State = None) -> Tensor:
        return self._answer(observation, state)[..., : self.shape["actions"]]

    def advance(self, observation: Tensor, action: Tensor, state: State) -> State:
        memory = self._answer(observation, state)[..., self.shape["actions"] :]
        return TensorDict({"memory": memory}, batch_size=memory.shape[:-1])

    def value(self, observation: Tensor, action: Tensor, state: State = None) -> Tensor:
        return self.scores(observation, state).gather(-1, action.unsqueeze(-1)).squeeze(-1)

    def _answer(self, observation: Tensor, state: State) -> Tensor:
        assert state is not None
        return whatever_the_batch(self.network, observation, state["memory"])
