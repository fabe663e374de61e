#!/usr/bin/env bash
# One guesses: `data * scale` with a scale for each of five features scales the last axis, as for the tensors in it.
# What happens: it is matched with the batch: each row gets its factor. With as many rows as features nothing raises.
# Versions: tensordict 0.14.3, torch 2.13.0. Source: observations that were rescaled as a whole tensordict.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 tensordict==0.14.3 numpy
see <<'P'
import tensordict
import torch
from tensordict import TensorDict

scale = torch.tensor([1.0, 2.0, 3.0])
cars = TensorDict({"car": torch.ones(3, 3)}, [3])
whole, alone = (cars * scale)["car"].tolist(), (cars["car"] * scale).tolist()
print(f"tensordict {tensordict.__version__}: three rows of ones times (1, 2, 3): as a tensordict {whole}, as a tensor {alone}")
raise SystemExit(not (whole == [[1.0] * 3, [2.0] * 3, [3.0] * 3] and alone == [[1.0, 2.0, 3.0]] * 3))
P
