#!/usr/bin/env bash
# One guesses: TensorDict.half(), .bfloat16() and .to(torch.float16) cast floats alone, as those of a torch.nn.Module do.
# What happens: integers and booleans become floats, too. Step counts and indices above 2048 are rounded, also after `.to(torch.int64)`, and
# `done` is no mask any more.
# Versions: tensordict 0.14.3, torch 2.13.0. Source: a replay buffer in half precision.
source "$(dirname "$0")/fresh.sh"
fresh torch==2.13.0 tensordict==0.14.3 numpy
see <<'P'
import tensordict
import torch
from tensordict import TensorDict

data = TensorDict({"step": torch.tensor([2047, 2049]), "done": torch.tensor([True, False]), "x": torch.ones(2)}, [2])
module = torch.nn.Module()
for name, value in data.items():
    module.register_buffer(name, value)
kinds = {"half": data.half(), "to": data.to(torch.float16)}
seen = {name: {key: str(value.dtype).removeprefix("torch.") for key, value in cast.items()} for name, cast in kinds.items()}
modules = {key: str(value.dtype).removeprefix("torch.") for key, value in module.half().named_buffers()}
back = data.half()["step"].to(torch.int64).tolist()
print(f"tensordict {tensordict.__version__}: {seen}, steps 2047 and 2049 come back as {back}; a module has {modules}")
floats = dict.fromkeys(("step", "done", "x"), "float16")
raise SystemExit(not (seen == {"half": floats, "to": floats} and back == [2047, 2048] and modules["step"] == "int64"))
P
