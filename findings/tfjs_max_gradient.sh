#!/usr/bin/env bash
# One guesses: the gradient of a maximum with ties is shared by them or goes to one, as in torch (amax, max): it adds
# up to 1.
# What happens: each of the equal values gets all of it, so it adds up to their number. A loss that takes the largest
# score of a detector on a flat patch is scaled by the number of ties. (Max pooling gives it to the first of a window,
# as torch does.)
# Versions: @tensorflow/tfjs 4.22.0 on the CPU. Source: gradients/min_max_grad_util of tfjs-core.
source "$(dirname "$0")/fresh.sh"
fresh_node @tensorflow/tfjs@4.22.0
see_node <<'P'
const tf = require("@tensorflow/tfjs");
// No advertisement.
tf.env().set("IS_TEST", true);
tf.setBackend("cpu");
const assert = require("assert");

const flat = tf.fill([6], 0.5), gradient = Array.from(tf.grad((x) => tf.max(x))(flat).dataSync());
console.log(`TensorFlow.js ${tf.version["tfjs-core"]}: the gradient of max of six equal values is ${gradient}`);
assert.deepStrictEqual(gradient, [1, 1, 1, 1, 1, 1]);
P
