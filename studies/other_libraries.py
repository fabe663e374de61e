"""Do policies of skrl, Tianshou, RLlib and CleanRL decide in cavbench as they do by themselves? The table in docs/libraries.md.

    pip install skrl==2.1.1 tianshou==2.0.1 'ray[rllib]==2.60.0'     # beside cavbench[gym]
    python studies/other_libraries.py skrl                           # or tianshou, rllib, cleanrl

Each trains for some hundred steps in the highway. Decisions on 500 observations are compared with the library's own most
likely actions, controls to 1e-6. Results of 2026-11-28, torch 2.13.0, two cores, a minute each: equal on 500 of 500 for all.
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import nn

import cavbench
from cavbench.driving.victims.in_process import in_process
from cavbench.envs.highway.world import HighwayWorld

COUNT = 500
WHERE: dict[str, Any] = {"lanes": 3, "density": 1, "weather": "clear"}
PAGE = (Path(__file__).parents[1] / "docs" / "libraries.md").read_text()
TYPED: dict[str, Any] = {}
exec(next(one for one in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class Skrl" in one), TYPED)


def made(action_type: str = "discrete") -> gymnasium.Env[Any, Any]:
    return gymnasium.wrappers.FlattenObservation(
        cavbench.gym.make("highway", **WHERE, max_steps=60, action_type=action_type)
    )


def observed() -> torch.Tensor:
    """Observations [500, 10, 5] of episodes with random actions."""
    env, seen, seed = cavbench.gym.make("highway", **WHERE), [], 1
    shown, _ = env.reset(seed=seed)
    env.action_space.seed(0)
    while len(seen) < COUNT:
        seen.append(shown)
        shown, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            seed += 1
            shown, _ = env.reset(seed=seed)
    return torch.from_numpy(np.stack(seen))


SEEN = observed()
FLAT = SEEN.flatten(1)


def compared(name: str, network: nn.Module, own: np.ndarray[Any, Any]) -> None:
    decided = in_process([network], HighwayWorld().facts, SEEN, None).load(0, HighwayWorld().facts).decide(SEEN).numpy()
    same = np.isclose(decided, own, rtol=0, atol=1e-6).reshape(COUNT, -1).all(-1).sum()
    print(f"{name}: {same} of {COUNT} equal, {len(np.unique(own, axis=0))} different ones")


def skrl() -> None:
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import CategoricalMixin, DeterministicMixin, Model
    from skrl.resources.preprocessors.torch import RunningStandardScaler
    from skrl.trainers.torch import SequentialTrainer

    def model(mixin: Any, outputs: int) -> Any:
        class Made(mixin, Model):  # type: ignore[misc]
            def __init__(self) -> None:
                Model.__init__(
                    self, observation_space=env.observation_space, action_space=env.action_space, device="cpu"
                )
                mixin.__init__(self)
                self.net = nn.Sequential(nn.Linear(50, 64), nn.ELU(), nn.Linear(64, outputs))

            def compute(self, inputs: Any, role: str) -> Any:
                return self.net(inputs["observations"]), {}

        return Made()

    env = wrap_env(made())
    config = PPO_CFG()
    config.rollouts, config.learning_epochs, config.mini_batches = 64, 2, 2
    config.observation_preprocessor = RunningStandardScaler
    config.observation_preprocessor_kwargs = {"size": env.observation_space, "device": "cpu"}
    config.experiment.write_interval = config.experiment.checkpoint_interval = 0
    agent = PPO(
        models={"policy": model(CategoricalMixin, 5), "value": model(DeterministicMixin, 1)},
        memory=RandomMemory(memory_size=64, num_envs=1, device="cpu"),
        cfg=config,
        observation_space=env.observation_space,
        action_space=env.action_space,
        device="cpu",
    )
    settings = {"timesteps": 600, "headless": True, "disable_progressbar": True}
    SequentialTrainer(cfg=settings, env=env, agents=agent).train()
    with torch.no_grad():
        agent.policy.act({"observations": agent._observation_preprocessor(FLAT, train=False)}, role="policy")
    compared("skrl PPO", TYPED["Skrl"](agent), agent.policy.distribution(role="policy").probs.argmax(-1).numpy())


def tianshou() -> None:
    from tianshou.algorithm import DQN, PPO
    from tianshou.algorithm.modelfree.dqn import DiscreteQLearningPolicy
    from tianshou.algorithm.modelfree.reinforce import DiscreteActorPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory
    from tianshou.data import Batch, Collector, VectorReplayBuffer
    from tianshou.env import DummyVectorEnv
    from tianshou.trainer import OffPolicyTrainerParams, OnPolicyTrainerParams
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.discrete import DiscreteActor, DiscreteCritic

    envs, space, batch = DummyVectorEnv([made] * 2), made().action_space, Batch(obs=FLAT.numpy(), info={})
    common = {"test_collector": None, "max_epochs": 1, "test_step_num_episodes": 0}
    policy = DiscreteQLearningPolicy(
        model=Net(state_shape=(50,), action_shape=5, hidden_sizes=[64, 64]), action_space=space, eps_training=0.3
    )
    dqn = DQN(policy=policy, optim=AdamOptimizerFactory(lr=1e-3), gamma=0.9, target_update_freq=100)
    gathered = Collector(dqn, envs, VectorReplayBuffer(2000, 2), exploration_noise=True)
    dqn.run_training(
        OffPolicyTrainerParams(
            training_collector=gathered, epoch_num_steps=600, collection_step_num_env_steps=20, batch_size=32, **common
        )
    )
    compared("Tianshou DQN", TYPED["Tianshou"](policy.model), policy.eval()(batch).act)
    net = Net(state_shape=(50,), hidden_sizes=[64, 64])
    actor = DiscreteActorPolicy(
        actor=DiscreteActor(preprocess_net=net, action_shape=5, softmax_output=False), action_space=space
    )
    ppo = PPO(policy=actor, critic=DiscreteCritic(preprocess_net=net), optim=AdamOptimizerFactory(lr=3e-4))
    gathered = Collector(ppo, envs, VectorReplayBuffer(2000, 2))
    ppo.run_training(
        OnPolicyTrainerParams(
            training_collector=gathered,
            epoch_num_steps=400,
            collection_step_num_env_steps=100,
            batch_size=64,
            update_step_num_repetitions=1,
            **common,
        )
    )
    compared("Tianshou PPO", TYPED["Tianshou"](actor.actor), actor.eval()(batch).dist.probs.argmax(-1).numpy())


def rllib() -> None:
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.rl_module import RLModule
    from ray.tune.registry import register_env

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    for kind, outputs in (("discrete", 5), ("continuous", 2)):
        register_env(kind, lambda config, kind=kind: made(kind))
        config = PPOConfig().environment(kind).env_runners(num_env_runners=0)
        algorithm = config.training(train_batch_size=400, minibatch_size=100, num_epochs=2).build_algo()
        algorithm.train()
        with tempfile.TemporaryDirectory() as folder:
            algorithm.save_to_path(folder)
            module = RLModule.from_checkpoint(f"{folder}/learner_group/learner/rl_module/default_policy")
        algorithm.stop()
        with torch.no_grad():
            given = module.forward_inference({"obs": FLAT})["action_dist_inputs"]
        own = module.get_inference_action_dist_cls().from_logits(given).to_deterministic().sample()
        own = own.clamp(-1, 1) if kind == "continuous" else own
        compared(f"RLlib PPO, {kind}", TYPED["RLlib"](module, outputs), own.numpy())


def cleanrl() -> None:
    """The networks of its scripts dqn.py, ppo.py and ppo_continuous_action.py, written anew."""

    def layers(outputs: int) -> nn.Sequential:
        return nn.Sequential(nn.Linear(50, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs))

    torch.manual_seed(0)
    with torch.no_grad():
        values, actor, mean = layers(5), layers(5), layers(2)
        compared("CleanRL DQN", values, values(FLAT).argmax(-1).numpy())
        own = torch.distributions.Categorical(logits=actor(FLAT)).probs.argmax(-1).numpy()
        compared("CleanRL PPO, discrete", actor, own)
        compared("CleanRL PPO, continuous", mean, mean(FLAT).clamp(-1, 1).numpy())


if __name__ == "__main__":
    chosen: dict[str, Callable[[], None]] = {"skrl": skrl, "tianshou": tianshou, "rllib": rllib, "cleanrl": cleanrl}
    torch.set_num_threads(1)
    torch.manual_seed(0)
    chosen[sys.argv[1]]()
