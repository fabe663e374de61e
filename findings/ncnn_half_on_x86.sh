#!/usr/bin/env bash
# One guesses: on x86 ncnn computes in float32, because half precision is for Arm and Vulkan; a fully connected layer
# is exact to 1e-6.
# What happens: where the processor has F16C, the weights of InnerProduct are rounded to half precision by default,
# and the answer is 3e-4 of its range away. Convolutions are not. use_fp16_storage and use_fp16_packed off make it
# exact. The classes of a detector with a fully connected head differ from all other runtimes.
# Versions: ncnn 1.0.20261020. On a processor without F16C nothing is rounded; then this prints so and passes. Source:
# the options of ncnn.Net, one by one.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 ncnn==1.0.20261020
see <<'P'
import ncnn
import numpy as np

rng = np.random.default_rng(0)
weights, x = rng.normal(size=(64, 256)).astype(np.float32), rng.normal(size=256).astype(np.float32)
text = f"7767517\n2 2\nInput x 0 1 x 0=256\nInnerProduct layer 1 1 x y 0=64 1=0 2={weights.size}\n"
open("net.param", "w").write(text)
# The first word says that the weights are float32.
open("net.bin", "wb").write(bytes(4) + weights.tobytes())


def answer(**options):
    network = ncnn.Net()
    network.opt.num_threads = 1
    for name, value in options.items():
        setattr(network.opt, name, value)
    network.load_param("net.param")
    network.load_model("net.bin")
    extractor = network.create_extractor()
    extractor.input("x", ncnn.Mat(x).clone())
    return np.array(extractor.extract("y")[1])


wanted = weights @ x
half, single = (
    float(abs(one - wanted).max() / abs(wanted).max())
    for one in (answer(), answer(use_fp16_storage=False, use_fp16_packed=False, use_fp16_arithmetic=False))
)
f16c = "f16c" in open("/proc/cpuinfo").read()
print("ncnn", ncnn.__version__, f"largest error {half:.1e} by default, {single:.1e} without half precision; F16C: {f16c}")
assert single < 1e-6
assert half > 1e-4 if f16c else half < 1e-6
P
