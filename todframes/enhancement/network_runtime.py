"""Neural networks of ONNX files, as OpenCV or ONNX Runtime runs them, and what each reports of their inputs.

OpenCV 5 does not compare the shape of a picture with that of a model: with another number of channels a
convolution reads beyond its memory. So nothing may be run whose number of channels is not known.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError
from todframes.base.user_code import in_words

Runtime = Literal["opencv", "onnxruntime"]
Layout = Literal["nchw", "nhwc"]

NAMES: dict[Runtime, str] = {"opencv": "OpenCV", "onnxruntime": "ONNX Runtime"}

LONGEST_REASON = 200
"""Number of characters of a library's message that are shown."""

ELSEWHERE = re.compile(rb"[\x00\x08]location")
"""Key of a tensor whose values are in another file, behind its length in one byte or in several."""

_GRAPH_INPUTS = re.compile(r"main_graph: \{.*?inputs: \[(.*?)\n\s*\],?\n\s*outputs:", re.DOTALL)
_INPUT = re.compile(r'^\s*"(.*)",? // <Input> (\S+?)(?:C1)?(?: \[([^\]]*)\])?$', re.MULTILINE)
"""Name, type and shape of an input in the text of `cv2.dnn.Net.dump`, OpenCV 5."""

FLOATS = {"CV_32F": "float32", "CV_16F": "float16", "tensor(float)": "float32", "tensor(float16)": "float16"}

KINDS = FLOATS | {
    "CV_64F": "float64",
    "CV_32S": "int32",
    "CV_64S": "int64",
    "tensor(double)": "float64",
    "tensor(int32)": "int32",
    "tensor(int64)": "int64",
}
"""NumPy's names of the types that an input may have."""


class Input(NamedTuple):
    """An input of a network: name, NumPy's name of its type, and shape, None for each side that is free."""

    name: str
    kind: str
    shape: tuple[int | None, ...]

    def filled(self, value: float, layout: Layout, rows: int, columns: int) -> NDArray[Any]:
        """Return an array for this input that holds one value.

        A free side is that of a picture of the given rows and columns if the input has four sides, as a picture
        has. All other free sides are 1.
        """
        free = {"nchw": (1, 1, rows, columns), "nhwc": (1, rows, columns, 1)}[layout]
        sides = free if len(self.shape) == len(free) else (1,) * len(self.shape)
        shape = [known or side for known, side in zip(self.shape, sides, strict=True)]
        return np.full(shape, value, self.kind)


class Model(NamedTuple):
    """A network that has been read.

    Attributes
    ----------
    inputs : tuple of Input or None
        None if the library does not report them.
    n_outputs : int
    run : callable
        Function of the arrays of all inputs by their names that returns the first output. The name of a single
        input may be empty.
    """

    inputs: tuple[Input, ...] | None
    n_outputs: int
    run: Callable[[Mapping[str, NDArray[Any]]], NDArray[np.float32]]

    def picture_input(self, constants: Mapping[str, float]) -> Input:
        """Return the input that takes the picture: the first that has no constant value."""
        return next(one for one in self.inputs or [Input("", "float32", (None,) * 4)] if one.name not in constants)

    def apply(
        self,
        picture: NDArray[np.float32],
        layout: Layout,
        constants: Mapping[str, float],
        constant_channel: float | None,
    ) -> NDArray[np.float32]:
        """Run the network on a picture.

        Parameters
        ----------
        picture : ndarray, shape (rows, columns, channels)
            In the values that the network takes.
        layout : {"nchw", "nhwc"}
        constants : mapping
            Values of its other inputs.
        constant_channel : float or None
            Value of a channel that it takes behind those of the picture; None: it takes none.

        Returns
        -------
        ndarray
            The first output, in the same layout.
        """
        rows, columns = picture.shape[:2]
        if constant_channel is not None:
            picture = np.concatenate([picture, np.full((rows, columns, 1), constant_channel, np.float32)], axis=2)
        axes = np.moveaxis(picture, 2, 0) if layout == "nchw" else picture
        arrays: dict[str, NDArray[Any]] = {
            one.name: one.filled(constants[one.name], layout, rows, columns)
            for one in self.inputs or ()
            if one.name in constants
        }
        arrays[self.picture_input(constants).name] = np.ascontiguousarray(axes, np.float32)[None]
        return self.run(arrays)


def read_model(content: bytes, runtime: Runtime) -> Model:
    """Read a network from the bytes of an ONNX file.

    A damaged file can crash the process: `network_probe` reads each file in a process of its own first.

    Raises
    ------
    DataError
        If the library cannot read it, or parts of it are in other files.
    SettingsError
        If ONNX Runtime is not installed.
    """
    if ELSEWHERE.search(content):
        # OpenCV reads any file that a model names: one might show what the file holds.
        raise DataError(
            "keeps its weights in another file, expected all in one; write it again with "
            "onnx.save(onnx.load(FILE), NEW_FILE)"
        )
    return {"opencv": _by_opencv, "onnxruntime": _by_onnx_runtime}[runtime](content)


def runtime_version(runtime: Runtime) -> str:
    """Return the version of a library. Raises SettingsError if it is not installed."""
    if runtime == "opencv":
        import cv2

        return str(cv2.__version__)
    return str(_onnx_runtime().__version__)


def has_onnx_runtime() -> bool:
    """Return whether ONNX Runtime is installed."""
    try:
        _onnx_runtime()
    except SettingsError:
        return False
    return True


def reason(error: BaseException) -> str:
    """Return the message of a library in one line, without the places in its own code."""
    said = getattr(error, "err", None)
    return in_one_line(" ".join(str(said).split()) if said else in_words(error))


def in_one_line(text: str) -> str:
    """Return a text of a model or a library without letters that cannot be printed, and not too long."""
    text = "".join(one if one.isprintable() else "?" for one in text)
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}…"


def _by_opencv(content: bytes) -> Model:
    import cv2

    with _quiet():
        try:
            net = cv2.dnn.readNetFromONNX(np.frombuffer(content, np.uint8))
            names = net.getUnconnectedOutLayersNames()
        except (cv2.error, SystemError, UnicodeDecodeError) as error:
            raise DataError(f"OpenCV cannot read it ({reason(error)})") from None
        inputs = None
        with suppress(cv2.error, UnicodeDecodeError):  # of OpenCV 4, which needs a picture first
            inputs = _reported(net.dump())

    def run(arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
        with _quiet():
            for name, values in arrays.items():
                values = values.astype(np.float32) if values.dtype == np.float16 else values
                net.setInput(values, name if len(arrays) > 1 else "")
            return np.asarray(net.forward())

    return Model(inputs, len(names), run)


def _reported(text: str) -> tuple[Input, ...] | None:
    """Return the inputs in a network's description by OpenCV; None if it has none, as before OpenCV 5."""
    found = _GRAPH_INPUTS.search(text)
    if found is None:
        return None
    return tuple(
        Input(name, KINDS.get(kind, kind), tuple(_side(one) for one in shape.split(" x ") if shape))
        for name, kind, shape in _INPUT.findall(found[1])
    )


def _side(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdigit() and int(text) else None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep OpenCV from writing errors to the terminal that are raised as well."""
    import cv2

    # OpenCV 4 has the function elsewhere than OpenCV 5.
    set_level = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
    before = set_level(0)
    try:
        yield
    finally:
        set_level(before)


def _onnx_runtime() -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise SettingsError(
            "runtime: ONNX Runtime is not installed; install todframes with the extra: pip install "
            '"todframes[onnx]"'
        ) from None
    return onnxruntime


def _by_onnx_runtime(content: bytes) -> Model:
    import cv2

    library = _onnx_runtime()
    options = library.SessionOptions()
    # Workers have one thread, and OpenCV knows it.
    options.intra_op_num_threads, options.inter_op_num_threads = max(1, cv2.getNumThreads()), 1
    options.log_severity_level = 4
    options.use_deterministic_compute = True
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
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
