"""Small neural networks, written with the package onnx, for tests, campaigns and benchmarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Side = int | str

ANY: tuple[Side, ...] = ("n", 1, "h", "w")


def save(
    path: Path,
    nodes: Sequence[onnx.NodeProto],
    weights: Mapping[str, np.ndarray] | None = None,
    *,
    shape: Sequence[Side] = ANY,
    others: Mapping[str, tuple[int, Sequence[Side]]] | None = None,
    outputs: Sequence[str] = ("y",),
    kind: int = TensorProto.FLOAT,
    tensors: Sequence[TensorProto] = (),
    opset: int = 13,
) -> Path:
    """Write a network from x, of a shape, and from other inputs of their types and shapes, to y."""
    taken = {"x": (kind, shape), **(others or {})}
    ports = [helper.make_tensor_value_info(name, *one) for name, one in taken.items()]
    ends = [helper.make_tensor_value_info(name, kind, [f"side {k}" for k in range(4)]) for name in outputs]
    constants = [numpy_helper.from_array(np.asarray(value), name) for name, value in (weights or {}).items()]
    graph = helper.make_graph(list(nodes), "network", ports, ends, [*constants, *tensors])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def node(kind: str, sources: str, target: str, **attributes: object) -> onnx.NodeProto:
    return helper.make_node(kind, sources.split(" "), target.split(" "), **attributes)


def convolution(source: str, weights: str, target: str, side: int, *, pads: int | None = None) -> onnx.NodeProto:
    """Make a convolution that keeps the size, or pads by another number of pixels."""
    around = side // 2 if pads is None else pads
    return node("Conv", f"{source} {weights}", target, kernel_shape=[side, side], pads=[around] * 4)


def of_each_channel(kernel: np.ndarray, channels: int) -> np.ndarray:
    """Return the weights of a convolution that filters each channel by itself."""
    weights = np.zeros((channels, channels, *kernel.shape), np.float32)
    weights[range(channels), range(channels)] = kernel
    return weights


def identity(path: Path, *, channels: int = 1, layout: str = "nchw") -> Path:
    shape = ("n", channels, "h", "w") if layout == "nchw" else ("n", "h", "w", channels)
    return save(path, [node("Identity", "x", "y")], shape=shape)


def blur(
    path: Path, kernel: np.ndarray, *, channels: int = 1, mirrored: bool = False, size: Sequence[Side] = ("h", "w")
) -> Path:
    """Write a network that convolves: with zeros beyond the borders, or what is mirrored there."""
    side, weights = len(kernel), {"k": of_each_channel(kernel, channels)}
    nodes = [convolution("x", "k", "y", side)]
    if mirrored:
        around = [0, 0, side // 2, side // 2] * 2
        nodes = [node("Pad", "x around", "wide", mode="reflect"), convolution("wide", "k", "y", side, pads=0)]
        weights["around"] = np.array(around, np.int64)
    return save(path, nodes, weights, shape=("n", channels, *size))


def box(side: int = 3) -> np.ndarray:
    return np.full((side, side), 1.0 / side**2, np.float32)


def denoiser(path: Path, *, features: int = 8, layers: int = 2, size: Sequence[Side] = ("h", "w")) -> Path:
    """Write a residual denoiser: y = x − f(x), f of 3 × 3 convolutions with ReLU between them.

    Its first layer has the differences of a pixel from its neighbours, in both signs, so it is a soft filter by
    hand; further layers are random.
    """
    rng = np.random.default_rng(1)
    first = np.zeros((features, 1, 3, 3), np.float32)
    for k in range(features):
        neighbour = np.unravel_index((k // 2) * 2 % 9, (3, 3))
        first[k, 0, 1, 1] += (-1) ** k
        first[k, 0, neighbour[0], neighbour[1]] -= (-1) ** k
    weights = {"w0": first}
    for k in range(1, layers - 1):
        weights[f"w{k}"] = rng.normal(0.0, 0.2, (features, features, 3, 3)).astype(np.float32)
    last = np.zeros((1, features, 3, 3), np.float32)
    last[0, :, 1, 1] = [(-1) ** k / features for k in range(features)]
    weights[f"w{layers - 1}"] = last
    nodes, source = [], "x"
    for k in range(layers):
        nodes.append(convolution(source, f"w{k}", f"c{k}", 3))
        source = f"c{k}"
        if k < layers - 1:
            nodes.append(node("Relu", source, f"r{k}"))
            source = f"r{k}"
    return save(path, [*nodes, node("Sub", f"x {source}", "y")], weights, shape=("n", 1, *size))


def less_noise(path: Path, kind: int, shape: Sequence[Side], *, of_picture: Sequence[Side] = ANY) -> Path:
    """Write a network of a picture x and another input s: y = x − s / 2."""
    nodes = [
        node("Cast", "s", "level", to=TensorProto.FLOAT),
        node("Mul", "level half", "part"),
        node("Sub", "x part", "y"),
    ]
    return save(path, nodes, {"half": np.float32(0.5)}, shape=of_picture, others={"s": (kind, shape)})


def weighted(path: Path, weights: Sequence[Sequence[float]], *, layout: str = "nchw") -> Path:
    """Write a network whose output channels are weighted sums of its input channels."""
    kernel = np.asarray(weights, np.float32)[..., None, None]
    if layout == "nchw":
        return save(path, [convolution("x", "k", "y", 1)], {"k": kernel}, shape=("n", kernel.shape[1], "h", "w"))
    nodes = [
        node("Transpose", "x", "first", perm=[0, 3, 1, 2]),
        convolution("first", "k", "mixed", 1),
        node("Transpose", "mixed", "y", perm=[0, 2, 3, 1]),
    ]
    return save(path, nodes, {"k": kernel}, shape=("n", "h", "w", kernel.shape[1]))


def finer(
    path: Path, factor: int = 2, *, size: Sequence[Side] = ("h", "w"), side: int = 3, pads: int | None = None
) -> Path:
    """Write a network that repeats every pixel of the mean of a square."""
    weights = np.repeat(of_each_channel(box(side), 1), factor**2, axis=0)
    nodes = [convolution("x", "k", "c", side, pads=pads), node("DepthToSpace", "c", "y", blocksize=factor)]
    return save(path, nodes, {"k": weights}, shape=("n", 1, *size))


def halving(path: Path, times: int = 2) -> Path:
    """Write a network that halves a picture, doubles it again and adds it: sides must be multiples of 2**times."""
    nodes = [
        node("MaxPool", "x" if k == 0 else f"p{k}", f"p{k + 1}", kernel_shape=[2, 2], strides=[2, 2])
        for k in range(times)
    ]
    nodes += [node("Resize", f"p{times} empty factors", "up", mode="nearest"), node("Add", "x up", "y")]
    weights = {"empty": np.zeros(0, np.float32), "factors": np.array([1, 1, 2**times, 2**times], np.float32)}
    return save(path, nodes, weights)


def with_weights_in(path: Path, location: str, *, length: str = "36", offset: str = "0") -> Path:
    """Write a network of one convolution, whose 3 × 3 weights are those of another file."""
    tensor = TensorProto(
        name="k", data_type=TensorProto.FLOAT, dims=[1, 1, 3, 3], data_location=TensorProto.EXTERNAL
    )
    for key, value in (("location", location), ("offset", offset), ("length", length)):
        tensor.external_data.add(key=key, value=value)
    return save(path, [convolution("x", "k", "y", 3)], tensors=[tensor])


def correlator(
    path: Path, templates: np.ndarray, *, layout: str = "nchw", channels: int = 1, last: str = ""
) -> Path:
    """Write a network whose values are inner products of a picture with templates, (n, rows, columns)."""
    n, rows, columns = templates.shape
    weights = np.repeat(templates[:, None] / channels, channels, axis=1)
    shape = (1, channels, rows, columns)
    if layout == "nhwc":
        weights, shape = np.moveaxis(weights, 1, 3), (1, rows, columns, channels)
    nodes = [node("Reshape", "x shape", "flat"), node("MatMul", "flat w", "s" if last else "y")]
    nodes += [node(last, "s", "y")] if last else []
    values = {"shape": np.array([1, -1]), "w": weights.reshape(n, -1).T.astype(np.float32)}
    return save(path, nodes, values, shape=shape)


def searching(path: Path, templates: np.ndarray) -> Path:
    """Write a network for pictures of any size: the largest magnitude of each template's correlation."""
    nodes = [node("Conv", "x k", "c", kernel_shape=templates.shape[1:]), node("Abs", "c", "a")]
    nodes += [node("GlobalMaxPool", "a", "m"), node("Flatten", "m", "y")]
    return save(path, nodes, {"k": templates[:, None].astype(np.float32)})
