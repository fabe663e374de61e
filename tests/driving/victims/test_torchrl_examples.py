"""Policies trained with TorchRL as its example scripts do it drive in a run as they drive in TorchRL's own rollout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.collectors import Collector
from torchrl.data import Composite, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import (
    Compose,
    EnvBase,
    ExplorationType,
    FlattenObservation,
    InitTracker,
    RewardSum,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import set_exploration_type
from torchrl.modules import (
    MLP,
    ActorValueOperator,
    EGreedyModule,
    GRUModule,
    LSTMModule,
    ProbabilisticActor,
    QValueActor,
    QValueModule,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss, DQNLoss, SoftUpdate
from torchrl.objectives.value import GAE

import cavbench
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld

WORLD = HighwayWorld(max_steps=40)
WHERE: dict[str, Any] = {"lanes": 3, "density": 2, "weather": "clear"}
CELL = WORLD.axes.cell(lanes=3, density=2.0, weather="clear")


def environment(action_type: Any = "discrete", *more: Any, episodes: int = 4) -> EnvBase:
    """The world as a TorchRL environment with the transforms of the examples."""
    env = WORLD.make([CELL] * episodes, action_type=action_type)
    # A TransformedEnv passes on what is in the state of its environment; other entries of a reset are lost.
    env.full_state_spec = Composite(seed=Unbounded((episodes,), dtype=torch.int64), shape=(episodes,))
    return TransformedEnv(
        env, Compose(FlattenObservation(-2, -1, in_keys=["observation"]), RewardSum(), StepCounter(), *more)
    )


def frames(env: EnvBase, policy: TensorDictModuleBase) -> Collector:
    return Collector(env, policy, frames_per_batch=64, total_frames=256, init_random_frames=-1)


def dqn() -> TensorDictModuleBase:
    """As in `sota-implementations/dqn`: a QValueActor of an MLP, epsilon-greedy, a target network."""
    env = environment()
    spec = env.action_spec_unbatched
    net = MLP(in_features=50, out_features=spec.space.n, num_cells=[120, 84], activation_class=nn.ReLU)
    model = QValueActor(net, spec=Composite(action=spec), in_keys=["observation"])
    greedy = EGreedyModule(annealing_num_steps=200, eps_init=1.0, eps_end=0.05, spec=spec)
    loss = DQNLoss(model, loss_function="l2", delay_value=True)
    loss.make_value_estimator(gamma=0.9)
    target, adam = SoftUpdate(loss, eps=0.9), torch.optim.Adam(loss.parameters(), lr=1e-2)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(256), batch_size=32)
    for data in frames(env, TensorDictSequential(model, greedy)):
        buffer.extend(data.reshape(-1))
        greedy.step(data.numel())
        for _ in range(4):
            adam.zero_grad()
            loss(buffer.sample())["loss"].backward()
            adam.step()
            target.step()
    return model


def ppo(actor: ProbabilisticActor, critic: TensorDictModuleBase, env: EnvBase) -> None:
    """The training of `sota-implementations/ppo`."""
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01, critic_coeff=0.5)
    advantage, adam = GAE(gamma=0.9, lmbda=0.9, value_network=critic), torch.optim.Adam(loss.parameters(), lr=1e-2)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(64), sampler=SamplerWithoutReplacement(), batch_size=32)
    for data in frames(env, actor):
        with torch.no_grad():
            data = advantage(data)
        buffer.extend(data.reshape(-1))
        for batch in buffer:
            found = loss(batch)
            adam.zero_grad()
            sum(found[name] for name in ("loss_critic", "loss_objective", "loss_entropy")).backward()
            adam.step()


def ppo_discrete() -> TensorDictModuleBase:
    """As in the example for Atari: an ActorValueOperator with shared layers and a categorical head."""
    env = environment()
    shared = MLP(in_features=50, out_features=32, num_cells=[], activate_last_layer=True, activation_class=nn.ReLU)
    common = TensorDictModule(shared, in_keys=["observation"], out_keys=["common_features"])
    head = MLP(in_features=32, out_features=5, num_cells=[])
    actor = ProbabilisticActor(
        TensorDictModule(head, in_keys=["common_features"], out_keys=["logits"]),
        in_keys=["logits"],
        spec=Composite(action=env.action_spec_unbatched),
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    value = ValueOperator(MLP(in_features=32, out_features=1, num_cells=[]), in_keys=["common_features"])
    both = ActorValueOperator(common, actor, value)
    ppo(both.get_policy_operator(), both.get_value_operator(), env)
    return both


def ppo_continuous() -> TensorDictModuleBase:
    """As in the example for MuJoCo: a TanhNormal within the range of the actions, whose scale is a parameter."""
    env = environment("continuous")
    space = env.action_spec_unbatched.space
    net = MLP(in_features=50, out_features=2, num_cells=[64, 64], activation_class=nn.Tanh)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(net, AddStateIndependentNormalScale(2, scale_lb=1e-8)),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=Composite(action=env.action_spec_unbatched),
        distribution_class=TanhNormal,
        distribution_kwargs={"low": space.low, "high": space.high, "tanh_loc": False},
        return_log_prob=True,
        default_interaction_type=ExplorationType.RANDOM,
    )
    critic = ValueOperator(MLP(in_features=50, out_features=1, num_cells=[64]), in_keys=["observation"])
    ppo(actor, critic, env)
    return actor


def recurrent(kind: type[Any]) -> TensorDictModuleBase:
    """As in the tutorial on recurrent DQN: an embedding, an LSTM or a GRU, an MLP and a QValueModule."""
    torch.manual_seed(1)
    memory = kind(input_size=16, hidden_size=12, num_layers=2, in_key="embed", out_key="embed")
    values = MLP(in_features=12, out_features=5, num_cells=[16])
    with torch.no_grad():
        for weight in (*memory.parameters(), *values.parameters()):
            weight.mul_(3)
    model = TensorDictSequential(
        TensorDictModule(nn.Linear(50, 16), in_keys=["observation"], out_keys=["embed"]),
        memory,
        TensorDictModule(values, in_keys=["embed"], out_keys=["action_value"]),
        QValueModule(spec=environment().action_spec_unbatched),
    )
    env = environment("discrete", InitTracker(), get_primers_from_module(model))
    loss = DQNLoss(model, action_space=env.action_spec, delay_value=True)
    adam = torch.optim.Adam(model.parameters(), lr=1e-3)
    for data in frames(env, model):
        with set_recurrent_mode(True):
            adam.zero_grad()
            loss(data)["loss"].backward()
            adam.step()
    return model


POLICIES: dict[str, tuple[Callable[[], TensorDictModuleBase], Any]] = {
    "DQN": (dqn, "discrete"),
    "PPO, discrete": (ppo_discrete, "discrete"),
    "PPO, continuous": (ppo_continuous, "continuous"),
    "recurrent DQN, LSTM": (lambda: recurrent(LSTMModule), "discrete"),
    "recurrent DQN, GRU": (lambda: recurrent(GRUModule), "discrete"),
}


def own_rollout(actor: TensorDictModuleBase, action_type: Any, seeds: Tensor) -> TensorDict:
    """TorchRL's rollout of the actor, without exploration, in these scenarios."""
    memory = get_primers_from_module(actor, warn=False)
    env = environment(action_type, InitTracker(), *([memory] if memory else []), episodes=len(seeds))
    start = env.reset(TensorDict({"seed": seeds}, batch_size=env.batch_size))
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(WORLD.max_steps, actor, auto_reset=False, tensordict=start, break_when_all_done=True)


@pytest.mark.parametrize("name", POLICIES)
def test_it_has_the_same_return_and_the_same_crash_in_every_scenario(name: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    make, action_type = POLICIES[name]
    actor = make()
    scores = cavbench.score(actor, "none", world=WORLD, episodes=6, baselines=False, out=tmp_path, **WHERE)
    records = scores.records
    found = own_rollout(actor, action_type, torch.tensor(records["seed"].to_numpy()))
    last = found["next", "done"].squeeze(-1).int().argmax(-1)
    rows = torch.arange(len(last))
    torch.testing.assert_close(
        torch.tensor(records["return"].to_numpy()).float(),
        found["next", "episode_reward"].squeeze(-1)[rows, last],
        rtol=0,
        atol=1e-4,
    )
    crashed = found["next", "info", "crashed"].squeeze(-1)[rows, last]
    assert records["crashed"].tolist() == crashed.tolist()
    assert records["steps"].tolist() == (last + 1).tolist()


@pytest.mark.parametrize("kind", [LSTMModule, GRUModule])
def test_what_a_recurrent_actor_remembers_is_its_state(kind: type[Any]) -> None:
    actor = recurrent(kind)
    seeds = torch.arange(3)
    found = own_rollout(actor, "discrete", seeds)
    shown = found["observation"].unflatten(-1, (10, 5))
    policy = in_process([actor], WORLD.facts, shown[:, 0], None).load(0, WORLD.facts)
    state = policy.initial(seeds)
    for step in range(10):
        many = shown[:, step].expand(4, 3, 10, 5)
        torch.testing.assert_close(policy.scores(shown[:, step], state), found["action_value"][:, step])
        assert state is not None
        repeated = state.expand(4, 3)
        torch.testing.assert_close(policy.scores(many, repeated)[2], found["action_value"][:, step])
        state = policy.advance(shown[:, step], found["action"][:, step], state)
    gradient = torch.autograd.functional.jacobian(lambda x: policy.scores(x, state).sum(0), shown[:, 10])
    assert gradient.abs().sum() > 0
