#!/usr/bin/env python3
"""Makes plane_depth_64x48.onnx, a "depth network" whose truth is known: the depth of a level road from the pixel's row.

    pip install onnx numpy && python3 tests/models/make_plane_depth.py

A camera 1.5 m above the road, looking along it with a focal length of 40 px and the horizon in row 16, sees the road at
40 * 1.5 / (row + 0.5 - 16) m; above the horizon the network says -1. A bright image (mean above one half) is seen twice as
far, so that a test notices an image that does not arrive.
"""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

WIDTH, HEIGHT, HORIZON, FOCAL_TIMES_HEIGHT = 64, 48, 16.0, 60.0


def main():
    rows = np.arange(HEIGHT, dtype=np.float32) + 0.5 - HORIZON
    depth = np.where(rows > 0, FOCAL_TIMES_HEIGHT / np.maximum(rows, 0.1), -1.0).astype(np.float32)
    plane = np.repeat(depth.reshape(1, 1, HEIGHT, 1), WIDTH, axis=3)
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH])
    found = helper.make_tensor_value_info("depth", TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH])
    numbers = {"plane": plane, "half": np.float32(0.5), "one": np.float32(1.0)}
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Greater", ["mean", "half"], ["is_bright"]),
        helper.make_node("Cast", ["is_bright"], ["bright"], to=TensorProto.FLOAT),
        helper.make_node("Add", ["bright", "one"], ["times"]),
        helper.make_node("Mul", ["plane", "times"], ["depth"]),
    ]
    initializers = [numpy_helper.from_array(np.asarray(value), name) for name, value in numbers.items()]
    graph = helper.make_graph(nodes, "plane_depth", [image], [found], initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, Path(__file__).resolve().parent / "plane_depth_64x48.onnx")


if __name__ == "__main__":
    main()
