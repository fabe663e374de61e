#!/usr/bin/env bash
# One guesses: an actor of TorchRL, exported by the names of its entries as TorchRL's tutorial does, takes `dynamic_shapes` like any module.
# What happens: every spelling of dynamic_shapes raises. Given by its place, the same observation can have a dynamic batch.
# Versions: torch 2.13.0, torchrl 0.14.1, tensordict 0.14.3. Source: met while exporting policies for a benchmark.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 torchrl==0.14.1 tensordict==0.14.3 numpy
see <<'P'
import torch
import torchrl
from torchrl.data import Categorical
from torchrl.modules import MLP, QValueActor

actor = QValueActor(MLP(in_features=6, out_features=3), in_keys=["observation"], spec=Categorical(3))
observation, batch = torch.rand(2, 6), {0: torch.export.Dim("batch")}
raised = []
for shapes in ({"observation": batch}, {"kwargs": {"observation": batch}}, [{"observation": batch}]):
    try:
        torch.export.export(actor, (), {"observation": observation}, dynamic_shapes=shapes, strict=False)
    except Exception as error:
        raised.append(type(error).__name__)
program = torch.export.export(actor, (observation,), dynamic_shapes=[batch], strict=False).module()
sizes = [len(program(torch.rand(size, 6))[0]) for size in (1, 7)]
print(f"torchrl {torchrl.__version__}, torch {torch.__version__}: by name {', '.join(raised)}; by place batches of {sizes}")
raise SystemExit(not (len(raised) == 3 and sizes == [1, 7]))
P
