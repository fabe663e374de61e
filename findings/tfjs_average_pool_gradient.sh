#!/usr/bin/env bash
# One guesses: an average pool with padding "same" and its gradient divide by the same number of pixels.
# What happens: forward, TensorFlow.js leaves out what lies beyond the border, so ones stay ones; the gradient divides
# by the whole window. At the border it is too small: here all of it sums to less than the number of outputs.
# Versions: @tensorflow/tfjs 4.22.0 on the CPU. Source: avgMultiplier in kernels/AvgPoolGrad of tfjs-backend-cpu.
source "$(dirname "$0")/fresh.sh"
fresh_node @tensorflow/tfjs@4.22.0
see_node <<'P'
const tf = require("@tensorflow/tfjs");
// No advertisement.
tf.env().set("IS_TEST", true);
tf.setBackend("cpu");
const assert = require("assert");

const ones = tf.ones([1, 4, 4, 1]), pool = (x) => tf.avgPool(x, 3, 2, "same");
const forward = Array.from(pool(ones).dataSync()), gradient = tf.sum(tf.grad((x) => tf.sum(pool(x)))(ones)).dataSync()[0];
const said = `ones become ${forward}; the gradient of their sum adds up to ${gradient.toFixed(3)}, not 4`;
console.log(`TensorFlow.js ${tf.version["tfjs-core"]}: ${said}`);
assert(forward.every((value) => Math.abs(value - 1) < 1e-6));
assert(Math.abs(gradient - 25 / 9) < 1e-3);
P
