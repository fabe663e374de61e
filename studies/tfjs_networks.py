"""Compares whole graphs of TensorFlow.js, read by cavbench, with TensorFlow.js itself, on one random image each.

npm install --prefix /tmp/tfjs @tensorflow/tfjs@4.22.0
NODE_PATH=/tmp/tfjs/node_modules python studies/tfjs_networks.py nanodet.json ...
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import torch

from cavbench.formats import tfjs_file
from cavbench.formats.tfjs_graph import Graph

ASK = """
const fs = require("fs"), path = require("path"), tf = require("@tensorflow/tfjs");
(async () => {
  await tf.setBackend("cpu");
  const { file, shape, outputs } = JSON.parse(process.argv[1]), described = JSON.parse(fs.readFileSync(file));
  const beside = (one) => fs.readFileSync(path.join(path.dirname(file), one));
  const parts = described.weightsManifest.flatMap((group) => group.paths.map(beside));
  const weights = Buffer.concat(parts), given = fs.readFileSync(0);
  const model = await tf.loadGraphModel({ load: async () => ({
    modelTopology: described.modelTopology, format: described.format, signature: described.signature,
    weightSpecs: described.weightsManifest.flatMap((group) => group.weights),
    weightData: weights.buffer.slice(weights.byteOffset, weights.byteOffset + weights.length),
  }) });
  const x = tf.tensor(new Float32Array(given.buffer.slice(given.byteOffset, given.byteOffset + given.length)), shape);
  const found = [model.execute(x, outputs)].flat();
  process.stdout.write(JSON.stringify(found.map((one) => Array.from(one.dataSync()))));
})();
"""


def compare(path: Path) -> None:
    """Print, for each output of a graph, the largest difference and the largest value."""
    file = tfjs_file.read(path, path.name)
    graph = Graph(file)
    shape = [side or 1 for side in graph.shape]
    given = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    outputs = [name for name, _ in file.outputs]
    asked = json.dumps({"file": str(path.resolve()), "shape": shape, "outputs": outputs})
    said = subprocess.run(["node", "-e", ASK, asked], input=given.numpy().tobytes(), stdout=subprocess.PIPE, check=True)
    with torch.no_grad():
        found = graph(given)
    print(f"{path.name}: {len(graph.steps)} nodes, {shape}")
    for name, own, other in zip(outputs, found, json.loads(said.stdout), strict=True):
        wanted = torch.tensor(other).reshape(own.shape)
        difference, largest = float((own - wanted).abs().max()), float(wanted.abs().max())
        print(f"  {name} {list(own.shape)}: {difference:.1e} of {largest:.3g}")


if __name__ == "__main__":
    for given in sys.argv[1:]:
        compare(Path(given))
