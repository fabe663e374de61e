#!/usr/bin/env bash
# One guesses: stridedSlice with steps that also drops an axis returns what numpy's x[0:1, ::2, 1::2, 2] returns.
# What happens: it returns other elements, of the right shape: steps and begins are taken for the wrong axes once an
# axis is dropped. Without the dropped axis it is right. Graphs that pick a coordinate of every second cell have this.
# Versions: @tensorflow/tfjs 4.22.0 on the CPU. Source: kernels/StridedSlice of tfjs-backend-cpu, which uses
# finalShapeSparse.
source "$(dirname "$0")/fresh.sh"
fresh_node @tensorflow/tfjs@4.22.0
see_node <<'P'
const tf = require("@tensorflow/tfjs");
// No advertisement.
tf.env().set("IS_TEST", true);
tf.setBackend("cpu");
const assert = require("assert");

const x = tf.reshape(tf.range(0, 120), [1, 5, 6, 4]), [begin, end, steps] = [[0, 0, 1, 2], [1, 5, 6, 3], [1, 2, 2, 1]];
const [kept, dropped] = [0, 8].map((mask) => Array.from(tf.stridedSlice(x, begin, end, steps, 0, 0, 0, 0, mask).dataSync()));
console.log(`TensorFlow.js ${tf.version["tfjs-core"]}: with the axis ${kept}; with it dropped ${dropped}`);
assert.deepStrictEqual(kept, [6, 14, 22, 54, 62, 70, 102, 110, 118]);
assert.notDeepStrictEqual(dropped, kept);
P
