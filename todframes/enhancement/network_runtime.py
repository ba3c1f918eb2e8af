"""Neural networks of ONNX files as ONNX Runtime runs them, and the inputs that it reports."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError
from todframes.base.user_code import in_words

Layout = Literal["nchw", "nhwc"]

MOST_MODEL_MB = 1024
"""Largest size of a model with its weights, in units of 2**20 bytes."""

LONGEST_REASON = 200
"""Number of characters of a library's message that are shown."""

ELSEWHERE = re.compile(rb"[\x00\x08]location")
"""Key of a tensor whose values are in another file, behind its length in one byte or in several."""

FLOATS = {"tensor(float)": "float32", "tensor(float16)": "float16"}

KINDS = FLOATS | {"tensor(double)": "float64", "tensor(int32)": "int32", "tensor(int64)": "int64"}
"""NumPy's names of the types that an input may have."""


class Input(NamedTuple):
    """An input of a network: name, NumPy's name of its type, and shape, None for each side that is free."""

    name: str
    kind: str
    shape: tuple[int | None, ...]

    def filled(self, value: float, layout: Layout, rows: int, columns: int) -> NDArray[Any]:
        """Return an array for this input that holds one value.

        A free side is that of a picture if the input has four sides, as a picture has. All other free sides are 1.
        """
        free = {"nchw": (1, 1, rows, columns), "nhwc": (1, rows, columns, 1)}[layout]
        sides = free if len(self.shape) == len(free) else (1,) * len(self.shape)
        shape = [known or side for known, side in zip(self.shape, sides, strict=True)]
        return np.full(shape, value, self.kind)


class Model(NamedTuple):
    """A network that has been read; `run` takes the arrays of all inputs by their names and returns the first
    output."""

    inputs: tuple[Input, ...]
    n_outputs: int
    run: Callable[[Mapping[str, NDArray[Any]]], NDArray[np.float32]]

    def picture_input(self, constants: Mapping[str, float]) -> Input:
        """Return the input that takes the picture: the first that has no constant value."""
        return next(one for one in self.inputs if one.name not in constants)

    def apply(
        self,
        picture: NDArray[np.float32],
        layout: Layout,
        constants: Mapping[str, float],
        constant_channel: float | None,
    ) -> NDArray[np.float32]:
        """Run the network on a picture, (rows, columns, channels) in the values that it takes.

        `constants` are the values of its other inputs; `constant_channel` is the value of a channel that it takes
        behind those of the picture, None: it takes none. Returns the first output, in the same layout.
        """
        rows, columns = picture.shape[:2]
        if constant_channel is not None:
            picture = np.concatenate([picture, np.full((rows, columns, 1), constant_channel, np.float32)], axis=2)
        axes = np.moveaxis(picture, 2, 0) if layout == "nchw" else picture
        arrays: dict[str, NDArray[Any]] = {
            one.name: one.filled(constants[one.name], layout, rows, columns)
            for one in self.inputs
            if one.name in constants
        }
        arrays[self.picture_input(constants).name] = np.ascontiguousarray(axes, np.float32)[None]
        return self.run(arrays)


def with_weights(content: bytes, folder: Path) -> bytes:
    """Return the bytes of a model with all its weights, also those that lie in files beside it.

    Files are read from the folder alone: the package onnx refuses links, `..` and absolute paths. Raises DataError
    if a file cannot be read, lies elsewhere, or model and weights are too large, and SettingsError if the package
    onnx is not installed.
    """
    if not ELSEWHERE.search(content):
        return content
    onnx = _imported("onnx")
    n_bytes, helper = len(content), onnx.external_data_helper
    try:
        model = onnx.load_model_from_string(content)
        for tensor in helper._get_all_tensors(model):
            if helper.uses_external_data(tensor):
                helper.load_external_data_for_tensor(tensor, str(folder))
                del tensor.external_data[:]
                tensor.data_location = onnx.TensorProto.DEFAULT
                n_bytes += len(tensor.raw_data)
            if n_bytes > MOST_MODEL_MB * 2**20:  # thousands of tensors may name the same file
                raise DataError(f"is longer than {MOST_MODEL_MB} MB with its weights, the limit for such files")
        return bytes(model.SerializeToString())
    except (MemoryError, DataError):
        raise
    except Exception as error:
        raise DataError(
            "its weights in other files cannot be read, expected them in its folder and no links "
            f"({reason(error)})"
        ) from None


def read_model(content: bytes) -> Model:
    """Read a network from the bytes of an ONNX file, which has all its weights.

    A damaged file can crash the process: `network_probe` reads each file in a process of its own first. Raises
    DataError if ONNX Runtime cannot read it, or parts of it are in other files, and SettingsError if ONNX Runtime
    is not installed.
    """
    if ELSEWHERE.search(content):
        # ONNX Runtime might read any file that a model names, and a picture could show what the file holds.
        raise DataError("keeps values other than weights in another file, expected all in one")
    library = _imported("onnxruntime")
    options = library.SessionOptions()
    # The same numbers and times in workers, which share the processors, and without them.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    options.use_deterministic_compute = True
    options.add_session_config_entry("session.load_model_format", "ONNX")  # its own format is checked less
    try:
        session = library.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise DataError(f"ONNX Runtime cannot read it ({reason(error)})") from None
    inputs = tuple(
        Input(
            one.name,
            KINDS.get(one.type, one.type),
            tuple(side if isinstance(side, int) and side else None for side in one.shape),
        )
        for one in session.get_inputs()
    )
    kinds = {one.name: one.kind for one in inputs}

    def run(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        given = {name: values.astype(kinds[name], copy=False) for name, values in arrays.items()}
        return np.asarray(session.run(None, given)[0], np.float32)

    return Model(inputs, len(session.get_outputs()), run)


def runtime_version() -> str:
    """Return the version of ONNX Runtime. Raises SettingsError if it is not installed."""
    return str(_imported("onnxruntime").__version__)


def reason(error: BaseException) -> str:
    """Return the message of a library in one line."""
    return in_one_line(in_words(error))


def in_one_line(text: str) -> str:
    """Return a text of a model or a library without letters that cannot be printed, and not too long."""
    text = "".join(one if one.isprintable() else "?" for one in text)
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}…"


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise SettingsError(
            f'networks need the package {name}, which is not installed; run: pip install "todframes[onnx]"'
        ) from None
