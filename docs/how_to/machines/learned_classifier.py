"""Learns which way triangles point from datasets: python learned_classifier.py NETWORK.onnx DATASET [DATASET …].

Two convolutions and a linear layer, by NumPy alone; a minute. Seeds are fixed. NETWORK.toml beside the network has
the code value that is white to it.
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices gain nothing from threads

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view
from onnx import TensorProto, helper, numpy_helper

import todframes as tod

SIDE, CHANNELS, STEPS, BATCH, RATE = 32, (12, 24), 4000, 64, 2e-3
GREY = 50.0  # luminance of the background, a code value of these frames, which the network gets as 0.5


def pictures(folder):
    """Parts of the frames about their triangles, in contrast, and the numbers of quarter turns."""
    data, found = tod.load_dataset(folder), []
    for trial in data.trials:
        frame = tod.read_frame(Path(folder) / trial.frames[0].path).values[..., 0] / GREY - 1.0
        wide = np.pad(frame, SIDE)  # beyond the frame there is background
        top, left = (int(np.ceil(at - SIDE / 2)) + SIDE for at in (trial.y_px, trial.x_px))
        found.append(wide[top : top + SIDE, left : left + SIDE])
    return np.array(found, np.float32), np.array([trial.orientation.quarter_turns for trial in data.trials])


def patches(images, side):
    """Windows at every second pixel of (n, channels, rows, columns), flat along the last axis."""
    windows = sliding_window_view(images, (side, side), axis=(2, 3))[:, :, ::2, ::2].transpose(0, 2, 3, 1, 4, 5)
    return windows.reshape(*windows.shape[:3], -1)


def spread(gradient, shape, side):
    """Gradient of images from that of their `patches`."""
    images, rows, columns = np.zeros(shape, np.float32), *gradient.shape[1:3]
    parts = gradient.reshape(len(gradient), rows, columns, shape[1], side, side)
    for y, x in np.ndindex(side, side):
        images[:, :, y : y + 2 * rows : 2, x : x + 2 * columns : 2] += parts[..., y, x].transpose(0, 3, 1, 2)
    return images


def learned(images, turns):
    """Weights of both convolutions and of the linear layer, by Adam on the cross entropy."""
    rng = np.random.default_rng(1)
    shapes = [(25, CHANNELS[0]), (9 * CHANNELS[0], CHANNELS[1]), (36 * CHANNELS[1], 4)]
    weights = [rng.normal(0.0, np.sqrt(2.0 / shape[0]), shape).astype(np.float32) for shape in shapes]
    weights += [np.zeros(n, np.float32) for n in (*CHANNELS, 4)]
    weights[2] *= 0.1
    mean, square = ([np.zeros_like(values) for values in weights] for _ in range(2))
    for step in range(1, STEPS + 1):
        chosen = rng.integers(len(images), size=BATCH)
        turn, is_mirrored = rng.integers(4), rng.integers(2)
        x, label = np.rot90(images[chosen], -turn, axes=(1, 2)), (turns[chosen] + turn) % 4
        if is_mirrored:
            x, label = x[:, :, ::-1], -label % 4
        first = patches(4.0 * x[:, None], 5)
        a = np.maximum(first @ weights[0] + weights[3], 0.0).transpose(0, 3, 1, 2)
        second = patches(a, 3)
        b = np.maximum(second @ weights[1] + weights[4], 0.0).transpose(0, 3, 1, 2)
        flat = b.reshape(BATCH, -1)
        scores = flat @ weights[2] + weights[5]
        p = np.exp(scores - scores.max(axis=1, keepdims=True))
        p /= p.sum(axis=1, keepdims=True)
        if step % 500 == 0:
            print(step, "cross entropy", -np.log(p[np.arange(BATCH), label]).mean())
        of_scores = (p - np.eye(4, dtype=np.float32)[label]) / BATCH
        of_b = ((of_scores @ weights[2].T).reshape(b.shape) * (b > 0)).transpose(0, 2, 3, 1)
        of_a = (spread(of_b @ weights[1].T, a.shape, 3) * (a > 0)).transpose(0, 2, 3, 1)
        pairs = (first, of_a), (second, of_b)
        gradients = [given.reshape(-1, given.shape[3]).T @ of.reshape(-1, of.shape[3]) for given, of in pairs]
        gradients += [
            flat.T @ of_scores,
            of_a.sum(axis=(0, 1, 2)),
            of_b.sum(axis=(0, 1, 2)),
            of_scores.sum(axis=0),
        ]
        rate = RATE * (1.0 - step / (STEPS + 1))
        for k, gradient in enumerate(gradients):
            mean[k] += 0.1 * (gradient - mean[k])
            square[k] += 0.001 * (gradient**2 - square[k])
            weights[k] -= rate * mean[k] / (1 - 0.9**step) / (np.sqrt(square[k] / (1 - 0.999**step)) + 1e-8)
    return weights


def save(path, weights):
    """Write the network, from pictures whose background is 0.5, and the settings beside it."""
    kernels = [weights[0].T.reshape(-1, 1, 5, 5), weights[1].T.reshape(-1, CHANNELS[0], 3, 3)]
    arrays = {
        "half": np.float32(0.5),
        "eight": np.float32(8.0),
        "k1": kernels[0],
        "k2": kernels[1],
        "w": weights[2],
    }
    arrays |= {f"b{k}": weights[2 + k] for k in (1, 2, 3)}
    nodes = [
        helper.make_node("Sub", ["x", "half"], ["about"]),
        helper.make_node("Mul", ["about", "eight"], ["given"]),
        helper.make_node("Conv", ["given", "k1", "b1"], ["c1"], strides=[2, 2]),
        helper.make_node("Relu", ["c1"], ["r1"]),
        helper.make_node("Conv", ["r1", "k2", "b2"], ["c2"], strides=[2, 2]),
        helper.make_node("Relu", ["c2"], ["r2"]),
        helper.make_node("Flatten", ["r2"], ["flat"]),
        helper.make_node("Gemm", ["flat", "w", "b3"], ["y"]),
    ]
    ends = [("x", [1, 1, SIDE, SIDE]), ("y", [1, 4])]
    ports = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in ends]
    constants = [numpy_helper.from_array(value, name) for name, value in arrays.items()]
    graph = helper.make_graph(nodes, "classifier", ports[:1], ports[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, path)
    Path(path).with_suffix(".toml").write_text(f"white = {0.5 / GREY}\n", encoding="utf-8")


if __name__ == "__main__":
    images, turns = map(np.concatenate, zip(*map(pictures, sys.argv[2:]), strict=True))
    save(sys.argv[1], learned(images, turns))
