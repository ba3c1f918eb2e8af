"""Writes denoiser.onnx: a small residual denoiser, learned from photographs. Needs the package onnx.

python learned_denoiser.py [SD]     # standard deviation of the noise, of white [default: 0.05]

y = x − W₂ · ReLU(W₁ · x − t). The first layer has the cosines of squares of 5 × 5 pixels, in both signs, each with
two thresholds. The second layer is learned: the linear regression of the noise on 3 × 3 pixels of the first one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnx
from numpy.lib.stride_tricks import sliding_window_view
from onnx import TensorProto, helper, numpy_helper
from skimage import data

SCENES = ("coins", "page", "clock", "cell")
"""Photographs that the denoiser learns from; it is tested on others."""

SIDE, NEAR = 5, 3


def first_layer(noise_sd: float) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (features, 5, 5) and thresholds of the first layer."""
    at = np.cos(np.pi * np.outer(np.arange(SIDE), np.arange(SIDE) + 0.5) / SIDE)
    at /= np.linalg.norm(at, axis=1)[:, None]
    cosines = np.einsum("ai,bj->abij", at, at).reshape(-1, SIDE, SIDE)[1:]
    signed = np.concatenate([cosines, -cosines])
    thresholds = np.repeat([0.0, 2.5 * noise_sd], len(signed))
    return np.tile(signed, (2, 1, 1)).astype(np.float32), thresholds.astype(np.float32)


def learned(noise_sd: float, *, n_pixels: int = 40_000, seed: int = 1) -> dict[str, np.ndarray]:
    """Return the weights of the network."""
    rng = np.random.default_rng(seed)
    cosines, thresholds = first_layer(noise_sd)
    reach = SIDE + NEAR - 1
    features, targets = [], []
    for name in SCENES:
        clean = getattr(data, name)().astype(np.float32) / 255.0
        noise = rng.normal(0.0, noise_sd, clean.shape).astype(np.float32)
        windows = sliding_window_view(clean + noise, (reach, reach)).reshape(-1, reach, reach)
        middle = noise[reach // 2 : -(reach // 2), reach // 2 : -(reach // 2)].ravel()
        chosen = rng.integers(0, len(windows), n_pixels // len(SCENES))
        near = sliding_window_view(windows[chosen], (SIDE, SIDE), axis=(1, 2))
        answers = np.einsum("nyxij,fij->nfyx", near, cosines, optimize=True) - thresholds[:, None, None]
        features.append(np.maximum(answers, 0.0).reshape(len(chosen), -1))
        targets.append(middle[chosen])
    x, y = np.concatenate(features), np.concatenate(targets)
    square = x.T @ x
    square[np.diag_indices_from(square)] += 1e-3 * np.trace(square) / len(square)
    second = np.linalg.solve(square.astype(np.float64), (x.T @ y).astype(np.float64)).astype(np.float32)
    return {
        "w1": cosines[:, None],
        "b1": -thresholds,
        "w2": second.reshape(1, len(cosines), NEAR, NEAR),
    }


def write(path: Path, weights: dict[str, np.ndarray]) -> None:
    """Write the network, for grey frames of any size, as an ONNX file."""
    nodes = [
        helper.make_node("Conv", ["x", "w1", "b1"], ["a"], kernel_shape=[SIDE, SIDE], pads=[SIDE // 2] * 4),
        helper.make_node("Relu", ["a"], ["r"]),
        helper.make_node("Conv", ["r", "w2"], ["noise"], kernel_shape=[NEAR, NEAR], pads=[NEAR // 2] * 4),
        helper.make_node("Sub", ["x", "noise"], ["y"]),
    ]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 1, "h", "w"]) for name in "xy"]
    constants = [numpy_helper.from_array(value, name) for name, value in weights.items()]
    graph = helper.make_graph(nodes, "denoiser", ends[:1], ends[1:], constants)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)


if __name__ == "__main__":
    write(Path("denoiser.onnx"), learned(float(sys.argv[1]) if len(sys.argv) > 1 else 0.05))
