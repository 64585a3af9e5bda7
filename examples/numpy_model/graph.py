"""Reads data.npz and makes graph.onnx: a linear model of the taxels, fitted with numpy, without metadata."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

data = np.load("data.npz")
train = data["split"] == 0
inputs = data["frames"][train].reshape(-1, 784)
targets = np.eye(4)[data["level"][train] - 1]
weights, bias = np.zeros((784, 4)), np.zeros(4)
for _ in range(2000):
    logits = inputs @ weights + bias
    odds = np.exp(logits - logits.max(axis=1, keepdims=True))
    error = odds / odds.sum(axis=1, keepdims=True) - targets
    weights -= inputs.T @ error / len(inputs)
    bias -= error.mean(axis=0)

graph = helper.make_graph(
    [
        helper.make_node("Flatten", ["frame"], ["taxels"]),
        helper.make_node("Gemm", ["taxels", "weights", "bias"], ["logits"]),
        helper.make_node("Softmax", ["logits"], ["probabilities"], axis=1),
    ],
    "linear",
    [helper.make_tensor_value_info("frame", TensorProto.FLOAT, [1, 1, 28, 28])],
    [
        helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, 4]),
        helper.make_tensor_value_info("probabilities", TensorProto.FLOAT, [1, 4]),
    ],
    [
        numpy_helper.from_array(weights.astype(np.float32), "weights"),
        numpy_helper.from_array(bias.astype(np.float32), "bias"),
    ],
)
opsets = [helper.make_opsetid("", 17)]
onnx.save(helper.make_model(graph, opset_imports=opsets, ir_version=8), "graph.onnx")
