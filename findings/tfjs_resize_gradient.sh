#!/usr/bin/env bash
# One guesses: the gradient of resizeBilinear in TensorFlow.js is that of what it computes.
# What happens: with halfPixelCenters the gradient is computed as if pixels were counted from their corners. It
# differs from finite differences by up to half of its size; without halfPixelCenters both agree. A patch that is
# optimised in TensorFlow.js through a detector with such an upsampling (NanoDet has four) follows other directions
# than those that lower the score most.
# Versions: @tensorflow/tfjs 4.22.0 on the CPU. Source: kernels/ResizeBilinearGrad of tfjs-backend-cpu, which knows no
# half pixels.
source "$(dirname "$0")/fresh.sh"
fresh_node @tensorflow/tfjs@4.22.0
see_node <<'P'
const tf = require("@tensorflow/tfjs");
// No advertisement.
tf.env().set("IS_TEST", true);
tf.setBackend("cpu");
const assert = require("assert");

function differences(half) {
  const weights = tf.reshape(tf.range(0, 49), [1, 7, 7, 1]);
  const f = (x) => tf.sum(tf.mul(tf.image.resizeBilinear(x, [7, 7], false, half), weights));
  const x = tf.randomUniform([1, 4, 4, 1], 0, 1, "float32", 3), values = x.dataSync();
  const stated = tf.grad(f)(x).dataSync();
  let largest = 0, size = 0;
  for (let i = 0; i < 16; i++) {
    const moved = (step) => tf.tensor(values.map((value, j) => value + (i === j ? step : 0)), [1, 4, 4, 1]);
    const [more, less] = [0.25, -0.25].map((step) => f(moved(step)).dataSync()[0]);
    largest = Math.max(largest, Math.abs(stated[i] - (more - less) / 0.5));
    size = Math.max(size, Math.abs((more - less) / 0.5));
  }
  return largest / size;
}
const [corners, centres] = [differences(false), differences(true)];
const said = `from corners ${corners.toExponential(1)}, from centres ${centres.toFixed(2)} of the largest`;
console.log(`TensorFlow.js ${tf.version["tfjs-core"]}: gradient minus finite differences, ${said}`);
assert(corners < 1e-3);
assert(centres > 0.1);
P
