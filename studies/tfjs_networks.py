"""Compares whole graphs of TensorFlow.js, read by cavbench, with TensorFlow.js itself, on one random image each.

npm install --prefix /tmp/tfjs @tensorflow/tfjs@4.22.0
NODE_PATH=/tmp/tfjs/node_modules python studies/tfjs_networks.py [--gradient] nanodet.json ...

With --gradient also the gradient of the sum of the first output, which takes TensorFlow.js a minute or more.
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
  const { file, shape, outputs, gradients } = JSON.parse(process.argv[1]), described = JSON.parse(fs.readFileSync(file));
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
  const gradient = gradients && tf.grad((one) => tf.sum([model.execute(one, [outputs[0]])].flat()[0]))(x);
  process.stdout.write(JSON.stringify([...found, ...(gradients ? [gradient] : [])].map((one) => Array.from(one.dataSync()))));
})();
"""


def compare(path: Path, *, gradients: bool) -> None:
    """Print, for each output, the largest difference and the largest value; and how alike gradients of the first are."""
    file = tfjs_file.read(path, path.name)
    graph = Graph(file)
    shape = [side or 1 for side in graph.shape]
    given = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    outputs = [name for name, _ in file.outputs]
    asked = json.dumps({"file": str(path.resolve()), "shape": shape, "outputs": outputs, "gradients": gradients})
    said = subprocess.run(["node", "-e", ASK, asked], input=given.numpy().tobytes(), stdout=subprocess.PIPE, check=True)
    leaf = given.requires_grad_()
    found = graph(leaf)
    answers = json.loads(said.stdout)
    print(f"{path.name}: {len(graph.steps)} nodes, {shape}")
    for name, own, other in zip(outputs, found, answers[: len(outputs)], strict=True):
        wanted = torch.tensor(other).reshape(own.shape)
        difference, largest = float((own.detach() - wanted).abs().max()), float(wanted.abs().max())
        print(f"  {name} {list(own.shape)}: {difference:.1e} of {largest:.3g}")
    if gradients:
        (own_gradient,) = torch.autograd.grad(found[0].sum(), leaf)
        other = torch.tensor(answers[-1]).reshape(shape)
        cosine = float(torch.cosine_similarity(own_gradient.flatten(), other.flatten(), 0))
        signs = float((own_gradient.sign() == other.sign()).float().mean())
        print(f"  gradient of the sum of {outputs[0]}: cosine {cosine:.3f}, {100 * signs:.1f} % of the signs")


if __name__ == "__main__":
    files = [one for one in sys.argv[1:] if one != "--gradient"]
    for given in files:
        compare(Path(given), gradients=len(files) < len(sys.argv) - 1)
