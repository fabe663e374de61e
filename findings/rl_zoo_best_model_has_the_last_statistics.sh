#!/usr/bin/env bash
# One guesses: best_model.zip and vecnormalize.pkl, which the training of rl_zoo3 leaves in one folder, belong together.
# What happens: the statistics are saved with each new best model, and written over by those of the end of the training. The best model is
# loaded with statistics that it never saw.
# Versions: rl_zoo3 2.9.2, torch 2.13.0. Source: met while reading such folders as they are.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 rl_zoo3==2.9.2 numpy
see <<'P'
import contextlib, glob, io, pickle, sys
from importlib.metadata import version
settings = "normalize:True n_envs:1 n_steps:64 batch_size:64 n_epochs:1"
words = f"--algo ppo --env CartPole-v1 -n 640 --eval-freq 300 --eval-episodes 1 --log-folder logs --seed 1 --device cpu --verbose 0 -params {settings}"
sys.argv = ["train", *words.split()]

from rl_zoo3.train import train
with contextlib.redirect_stdout(io.StringIO()):
    train()
from stable_baselines3 import PPO
(folder,) = glob.glob("logs/ppo/CartPole-v1_1")
best = PPO.load(f"{folder}/best_model.zip", device="cpu").num_timesteps
final = PPO.load(f"{folder}/CartPole-v1.zip", device="cpu").num_timesteps
with open(f"{folder}/CartPole-v1/vecnormalize.pkl", "rb") as file:
    count = round(pickle.load(file).obs_rms.count)
print(f"rl_zoo3 {version('rl_zoo3')}: best_model.zip after {best} steps, the final model after {final}; vecnormalize.pkl has seen {count} observations")
raise SystemExit(not (best == 600 or best == 300) or not (count > final >= 640 and best < final))
P
