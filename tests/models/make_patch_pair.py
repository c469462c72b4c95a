#!/usr/bin/env python3
"""Makes patch_pair_160x96.onnx, a "dense two-view network" whose truth is known: a pixel is described by its own patch.

    pip install onnx numpy && python3 tests/models/make_patch_pair.py

24 fixed random filters of 11 x 11 px without a mean answer at each pixel of both images; the answers, divided by their
length, are the descriptor, and the length is the confidence: a pixel without texture has none.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

WIDTH, HEIGHT, CHANNELS, SIDE = 160, 96, 24, 11


def main():
    filters = np.random.default_rng(0).standard_normal((CHANNELS, 1, SIDE, SIDE)).astype(np.float32)
    filters -= filters.mean(axis=(2, 3), keepdims=True)
    filters /= np.sqrt((filters**2).sum(axis=(2, 3), keepdims=True))
    initializers = [numpy_helper.from_array(filters, "filters"), numpy_helper.from_array(np.float32(1e-3), "floor")]
    nodes, inputs, outputs = [], [], []
    for view in "01":
        image, answers, length, divisor = (f"{name}{view}" for name in ("image", "answers", "conf", "divisor"))
        pads = [SIDE // 2] * 4
        nodes += [
            helper.make_node("Conv", [image, "filters"], [answers], kernel_shape=[SIDE, SIDE], pads=pads),
            helper.make_node("ReduceL2", [answers], [length], axes=[1], keepdims=1),
            helper.make_node("Add", [length, "floor"], [divisor]),
            helper.make_node("Div", [answers, divisor], [f"desc{view}"]),
        ]
        inputs.append(helper.make_tensor_value_info(image, TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH]))
        for name, channels in ((f"desc{view}", CHANNELS), (length, 1)):
            outputs.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, channels, HEIGHT, WIDTH]))
    graph = helper.make_graph(nodes, "patch_pair", inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, Path(__file__).resolve().parent / "patch_pair_160x96.onnx")


if __name__ == "__main__":
    main()
