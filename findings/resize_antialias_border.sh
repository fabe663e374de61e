#!/usr/bin/env bash
# One guesses: a Resize with mode=linear and antialias=1 is Pillow's bilinear resize, up to rounding.
# What happens: inside the image they agree to 1e-4, at the border they differ by about 11 of 255. ONNX repeats the
# pixels at the border, Pillow (and torch) leave them out and weigh the others more. What was trained behind Pillow
# and is exported with the Resize inside sees another frame around each image.
# Versions: onnxruntime 1.32.0, Pillow 13.0.0. Source: onnx.reference has the border of ONNX Runtime;
# exclude_outside=1 gives Pillow's to 2e-5.
source "$(dirname "$0")/fresh.sh"
fresh numpy==2.4.6 onnx==1.23.2 onnxruntime==1.32.0 pillow==13.0.0
see <<'P'
import numpy as np
from PIL import Image
from onnx_model import model, onnx_runtime

shrink = model(
    "Resize", [("x", [1, 1, 64, 64])], [("y", [1, 1, 16, 16])], {"size": np.array([1, 1, 16, 16])}, 18,
    names=["x", "", "", "size"], mode="linear", antialias=1,
)
x = np.random.default_rng(0).integers(0, 256, (64, 64)).astype(np.float32)
own = onnx_runtime(shrink, x=x[None, None])[0][0, 0]
pillow = np.asarray(Image.fromarray(x).resize((16, 16), Image.BILINEAR))
difference = abs(own - pillow)
inside, border = float(difference[2:-2, 2:-2].max()), float(difference.max())
print(f"largest difference inside {inside:.1e}, at the border {border:.1f} of 255")
assert inside < 1e-3
assert border > 3
P
