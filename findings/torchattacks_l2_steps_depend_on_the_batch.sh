#!/usr/bin/env bash
# One guesses: torchattacks' PGDL2 moves each image by its step, whatever images are beside it: gradients are normalised one by one.
# What happens: the loss is a mean over the batch, and 1e-10 is added to the norm. Gradients of a sure network are as small, so a step of 0.1
# is shorter in a large batch. A sure network looks more robust with batches of 256 than image by image.
# Versions: torchattacks 3.5.1, torch 2.13.0. Source: robust accuracies that depended on the batch size.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchattacks==3.5.1 numpy
see <<'P'
import torch
import torchattacks

torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 2, bias=False)).eval()
image = torch.rand(1, 3, 8, 8) * 0.5 + 0.25
with torch.no_grad():
    logits = network(image)[0]
    network[1].weight.mul_(21.0 / (logits.max() - logits.min()))
label = network(image).argmax(1)


def step(batch):
    """How far the first of equal images moves in one step of 0.1."""
    attack = torchattacks.PGDL2(network, eps=1.0, alpha=0.1, steps=1, random_start=False)
    return (attack(image.expand(batch, -1, -1, -1), label.expand(batch))[0] - image[0]).norm().item()


seen = {batch: round(step(batch), 3) for batch in (1, 16, 256)}
other = network(image).softmax(1).min().item()
print(f"torchattacks {torchattacks.__version__}: a step of 0.1 in batches of so many equal images: {seen}; the other class has {other:.0e}")
raise SystemExit(not (seen[1] > 0.095 and seen[16] < seen[1] and seen[256] < 0.8 * seen[1]))
P
