#!/usr/bin/env python3
"""Makes "LPIPS networks" whose truth is known: the mean of the squared differences of two pictures.

    pip install onnx numpy && python3 tests/models/make_picture_difference.py

In the small one red counts three times and blue not at all, so that a test notices channels that arrive in another order;
in the other all count alike, so that it says what the PSNR says.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

# Width, height, what red, green and blue count: for a small map, and for the simulated street.
NETWORKS = [(32, 16, [3.0, 1.0, 0.0]), (416, 128, [1.0, 1.0, 1.0])]


def make(width, height, weights):
    weights = np.array(weights, dtype=np.float32).reshape(1, 3, 1, 1)
    images = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, height, width]) for name in ("image0", "image1")
    ]
    distance = helper.make_tensor_value_info("distance", TensorProto.FLOAT, [1, 1, 1, 1])
    nodes = [
        helper.make_node("Sub", ["image0", "image1"], ["difference"]),
        helper.make_node("Mul", ["difference", "difference"], ["squared"]),
        helper.make_node("Mul", ["squared", "weights"], ["weighted"]),
        helper.make_node("ReduceMean", ["weighted"], ["distance"], axes=[1, 2, 3], keepdims=1),
    ]
    graph = helper.make_graph(
        nodes, "picture_difference", images, [distance], [numpy_helper.from_array(weights, "weights")]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, Path(__file__).resolve().parent / f"picture_difference_{width}x{height}.onnx")


if __name__ == "__main__":
    for network in NETWORKS:
        make(*network)
