#!/usr/bin/env bash
# One guesses: PGD of secml-torch is one attack, and backend="native" or "foolbox" only says whose code runs it. Ten steps are ten steps.
# What happens: the native L1 attack looks for the largest gradient in the whole batch, so only one image of a batch is moved. All norms have a
# step less than asked: what the last one reaches is not looked at. One step returns the images as they were.
# For whom it matters: under L1 a network that foolbox fools on every image keeps 97 % in batches of 32. Larger batches look more robust.
# Versions: secml-torch 1.5 (optimization/gradient_processing.py, lin_proj_l1; adv/evasion/modular_attacks/modular_attack_fixed_eps.py, _run_loop),
# foolbox 3.3.4, torch 2.13.0. Source: a comparison of backends, batches and numbers of steps.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchvision==0.28.0 secml-torch==1.5 foolbox==3.3.4 numpy
see <<'P'
from importlib.metadata import version

import torch
from secmlt.adv.backends import Backends
from secmlt.adv.evasion.perturbation_models import LpPerturbationModels
from secmlt.adv.evasion.pgd import PGD
from torch import nn
from torch.utils.data import DataLoader, TensorDataset

torch.manual_seed(0)
network = nn.Sequential(nn.Flatten(), nn.Linear(48, 64), nn.Tanh(), nn.Linear(64, 5)).eval()
images = torch.rand(32, 3, 4, 4) * 0.6 + 0.2
labels = network(images).argmax(1)
BUDGETS = {
    "Linf": (LpPerturbationModels.LINF, 0.1, 0.02),
    "L2": (LpPerturbationModels.L2, 0.5, 0.1),
    "L1": (LpPerturbationModels.L1, 3.0, 1.0),
}


def attacked(norm, steps, backend, batch=32):
    """The attacked images, how many of them moved, and the share that keeps its label."""
    model, epsilon, step = BUDGETS[norm]
    attack = PGD(perturbation_model=model, epsilon=epsilon, num_steps=steps, step_size=step, random_start=False, backend=backend)
    found = torch.cat([one for one, _ in attack(network, DataLoader(TensorDataset(images, labels), batch_size=batch))])
    moved = int(((found - images).abs().flatten(1).amax(1) > 1e-6).sum())
    return found, moved, round(float((network(found).argmax(1) == labels).float().mean()), 2)


l1 = {f"{backend}, batches of {batch}": attacked("L1", 40, backend, batch)[1:] for backend in (Backends.NATIVE, Backends.FOOLBOX) for batch in (4, 32)}
one = {f"{backend}, {norm}": attacked(norm, 1, backend)[1] for backend in (Backends.NATIVE, Backends.FOOLBOX) for norm in BUDGETS}
late = {
    norm: all(
        torch.allclose(attacked(norm, steps + 1, Backends.NATIVE)[0], attacked(norm, steps, Backends.FOOLBOX)[0], atol=1e-5) for steps in (1, 2, 3)
    )
    for norm in ("Linf", "L2")
}
print(f"secml-torch {version('secml-torch')}, foolbox {version('foolbox')}: images of 32 that 40 steps of L1 moved, and the share that keeps its label: "
      f"{l1}; images that one step moved: {one}; native with 2, 3 and 4 steps is foolbox with 1, 2 and 3: {late}")
raise SystemExit(
    l1["native, batches of 4"][0] != 8
    or l1["native, batches of 32"] != (1, 0.97)
    or any(l1[f"foolbox, batches of {batch}"] != (32, 0.0) for batch in (4, 32))
    or any(moved != (0 if name.startswith("native") else 32) for name, moved in one.items())
    or late != {"Linf": True, "L2": True}
)
P
