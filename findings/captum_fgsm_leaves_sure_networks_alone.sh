#!/usr/bin/env bash
# One guesses: captum.robust's FGSM and PGD take the sign of the gradient, so a network whose scores are multiplied by 300, which decides the
# same, is as weak as before, while its gradient is not zero.
# What happens: a pixel whose gradient is 1e-6 or less is not moved at all, and nothing is said. The surer a network is, the fewer of its images
# are attacked: 64 % are returned as they were and count as withstood. By signs of the same gradient none withstands.
# For whom it matters: robust accuracy rises with the sureness of the network. Training longer, or a lower temperature, looks like a defence.
# Versions: captum 0.9.0 (robust/_core/fgsm.py, FGSM._perturb), torch 2.13.0. The attribute `zero_thresh` is named in the docstring of FGSM, not in
# its equation, nor in that of PGD, which holds the attack as `fgsm`. Set to 0 there, none withstands.
# Source: attacks of several libraries on one network with scaled scores.
source "$(dirname "$0")/fresh.sh"
fresh captum==0.9.0 torch==2.13.0 numpy
see <<'P'
import captum
import torch
from captum.robust import PGD

torch.manual_seed(0)
images = torch.rand(256, 3, 8, 8) * 0.5 + 0.25
scores = torch.nn.Linear(192, 4, bias=False)
labels = scores(images.flatten(1)).argmax(1)
loss = torch.nn.CrossEntropyLoss(reduction="none")
RADIUS, STEP, STEPS = 0.1, 0.02, 10


def by_signs(network):
    """Ten steps along the signs of the gradient, and how many images have no gradient at the first."""
    moved, without = images, []
    for _ in range(STEPS):
        moved = moved.detach().requires_grad_()
        (gradient,) = torch.autograd.grad(loss(network(moved), labels).sum(), moved)
        without.append((gradient == 0).flatten(1).all(1).sum().item())
        moved = (moved + STEP * gradient.sign()).clamp(images - RADIUS, images + RADIUS).clamp(0, 1).detach()
    return moved, without[0]


seen = {}
for scale in (1.0, 100.0, 300.0):

    def network(x, scale=scale):
        return scale * scores(x.flatten(1))

    attack = PGD(network, loss, lower_bound=0.0, upper_bound=1.0)
    attacked = {"captum": attack.perturb(images, RADIUS, STEP, STEPS, labels)}
    attack.fgsm.zero_thresh = 0.0
    attacked["threshold 0"] = attack.perturb(images, RADIUS, STEP, STEPS, labels)
    attacked["by signs"], without = by_signs(network)
    assert without == 0
    seen[int(scale)] = {name: round((network(x).argmax(1) == labels).double().mean().item(), 2) for name, x in attacked.items()}
    seen[int(scale)]["unmoved"] = round((attacked["captum"] == images).flatten(1).all(1).double().mean().item(), 2)
print(f"captum {captum.__version__}: robust accuracy of one network by the factor of its scores: {seen}")
raise SystemExit(
    not (
        all(found["by signs"] == found["threshold 0"] == 0 for found in seen.values())
        and seen[1]["captum"] == 0
        and 0.05 < seen[100]["captum"] < 0.3
        and seen[300]["captum"] > 0.5
        and all(found["unmoved"] == found["captum"] for found in seen.values())
    )
)
P
