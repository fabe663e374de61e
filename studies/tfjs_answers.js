// What TensorFlow.js itself answers on small graphs: tests/formats/tfjs_answers.json, which the reader is compared with.
//
//     python -m tests.formats.tfjs_graphs /tmp/graphs
//     npm install --prefix /tmp/tfjs @tensorflow/tfjs@4.22.0
//     NODE_PATH=/tmp/tfjs/node_modules node studies/tfjs_answers.js /tmp/graphs > tests/formats/tfjs_answers.json
const fs = require("fs"), path = require("path"), tf = require("@tensorflow/tfjs");

async function answer(folder, given) {
  const model = JSON.parse(fs.readFileSync(path.join(folder, "model.json")));
  const weights = fs.readFileSync(path.join(folder, "weights.bin"));
  const loaded = await tf.loadGraphModel({ load: async () => ({
    modelTopology: model.modelTopology, format: model.format,
    weightSpecs: model.weightsManifest.flatMap((group) => group.weights),
    weightData: weights.buffer.slice(weights.byteOffset, weights.byteOffset + weights.length),
  }) });
  const found = loaded.execute(given, "answer");
  return { shape: found.shape, values: Array.from(found.dataSync()).map((value) => Number(Number(value).toPrecision(7))) };
}

(async () => {
  await tf.setBackend("cpu");
  const root = process.argv[2], bytes = fs.readFileSync(path.join(root, "input.f32"));
  const given = tf.tensor(new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length)), [1, 5, 6, 4]);
  const answers = {};
  for (const name of fs.readdirSync(root).sort()) {
    if (fs.statSync(path.join(root, name)).isDirectory()) {
      try { answers[name] = await answer(path.join(root, name), given); }
      catch (error) { console.error(name, error.message); }
    }
  }
  const lines = Object.entries(answers).map(([name, found]) => JSON.stringify(name) + ": " + JSON.stringify(found));
  process.stdout.write("{\n" + lines.join(",\n") + "\n}\n");
})();
