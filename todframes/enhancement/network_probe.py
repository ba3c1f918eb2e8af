"""Neural networks as ONNX Runtime runs them; a file is tried in a process, which it may crash or never end.

`probe` starts the process, `python -m todframes.enhancement.network_probe`. It reads the model from its standard
input, runs a small picture through it, and writes what it has found as MessagePack.
"""

from __future__ import annotations

import importlib
import math
import os
import re
import signal
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError, TodframesError
from todframes.base.reading import check_keys
from todframes.base.user_code import in_words
from todframes.jobs.start import ENVIRONMENT

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

TIME_LIMIT_S = 120.0
"""Time that reading a model and running the small picture may take."""

RUN_LIMIT_S = 600.0
"""Time that a network may take for a picture."""

N_RUNS = 8
"""Number of times that a classifier gets a picture: one that draws one of four answers gives another, but for
0.25⁷."""

SIDE_PX = 64
"""Smallest side of the picture that a network which takes any size is tried with."""

MOST_TILE_PX = 4096
"""Largest side of the pictures of a network of fixed size."""

MULTIPLE_HINT = "; if its sides have to be multiples of a number, such as 8, give that as multiple_px"

PICTURE_CHANNELS = (1, 3)

CHANNELS = (*PICTURE_CHANNELS, 2, 4)
"""Numbers of channels that a network may take: those of a picture, and another one of one value."""


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
    """A network that has been read: its inputs, the session of ONNX Runtime that runs it, and the thread where."""

    inputs: tuple[Input, ...]
    session: Any
    thread: ThreadPoolExecutor

    def picture_input(self, constants: Mapping[str, float]) -> Input:
        """Return the input that takes the picture: the first that has no constant value."""
        return next(port for port in self.inputs if port.name not in constants)

    def apply(
        self,
        picture: NDArray[np.float32],
        layout: Layout,
        constants: Mapping[str, float],
        constant_channel: float | None,
    ) -> NDArray[np.float32]:
        """Run the network on a picture, (rows, columns, channels), and return the first output, in its layout.
        `constants` are the values of its other inputs; `constant_channel` that of a channel behind those of the
        picture, None: it takes none.
        """
        rows, columns = picture.shape[:2]
        if constant_channel is not None:
            picture = np.concatenate([picture, np.full((rows, columns, 1), constant_channel, np.float32)], axis=2)
        axes = np.moveaxis(picture, 2, 0) if layout == "nchw" else picture
        arrays = {
            port.name: port.filled(constants[port.name], layout, rows, columns)
            for port in self.inputs
            if port.name in constants
        }
        port = self.picture_input(constants)
        arrays[port.name] = np.ascontiguousarray(axes, port.kind)[None]
        options = _imported("onnxruntime").RunOptions()
        options.log_severity_level = 4
        # Signals arrive in this thread while the network runs in another, and end it.
        running = self.thread.submit(self.session.run, None, arrays, options)
        try:
            return np.asarray(running.result(RUN_LIMIT_S)[0], np.float32)
        except TimeoutError:
            raise TimeoutError(f"it was not finished after {RUN_LIMIT_S:g} s") from None
        finally:
            options.terminate = True


def with_weights(content: bytes, folder: Path) -> bytes:
    """Return the bytes of a model with all its weights, also those that lie in files beside it. Raises DataError
    if a file cannot be read, lies elsewhere, or model and weights are too large.
    """
    if not ELSEWHERE.search(content):
        return content
    onnx = _imported("onnx")  # it refuses links, `..` and absolute paths
    n_bytes, helper = len(content), onnx.external_data_helper
    try:
        model = onnx.load_model_from_string(content)
        for tensor in filter(helper.uses_external_data, helper._get_all_tensors(model)):
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
    """Read a network from the bytes of an ONNX file, which has all its weights. A damaged file can crash the
    process, so `probe` tries each file first. Raises DataError if ONNX Runtime cannot read it, or parts of it are
    in other files.
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
            port.name,
            KINDS.get(port.type, port.type),
            tuple(side if isinstance(side, int) and side else None for side in port.shape),
        )
        for port in session.get_inputs()
    )
    return Model(inputs, session, ThreadPoolExecutor(1))


def runtime_version() -> str:
    """Return the version of ONNX Runtime. Raises SettingsError if it is not installed."""
    return str(_imported("onnxruntime").__version__)


def reason(error: BaseException) -> str:
    """Return the message of a library in one line."""
    return in_one_line(in_words(error))


def in_one_line(text: str) -> str:
    """Return a text of a model or a library without letters that cannot be printed, and not too long."""
    text = "".join(letter if letter.isprintable() else "?" for letter in text)
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}…"


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise SettingsError(
            f'networks need the package {name}, which is not installed; run: pip install "todframes[onnx]"'
        ) from None


class ProbeRequest(msgspec.Struct, frozen=True):
    """The settings of a network as far as the user has given them; None: read them from the model."""

    layout: Layout | None = None
    channels: int | None = None
    multiple_px: int = 1
    border_px: int | None = None
    black: float = 0.0
    white: float = 1.0
    inputs: dict[str, float] = {}
    constant_channel: float | None = None
    answers: int = 0
    """Number of values that it gives for a picture, a classifier; 0: it gives a picture."""


class Found(msgspec.Struct, frozen=True):
    """The properties of a network that runs.

    `rows` and `columns` are those of its pictures; None if it takes any size.
    `scale` is the number of output pixels for one input pixel along each axis. `lost_px` is the number of input
    pixels at each side of a picture that have no output. `gives_probabilities` states whether the values of a
    classifier are positive and sum to 1.
    """

    layout: Layout
    channels: int
    rows: int | None
    columns: int | None
    scale: float
    lost_px: int
    gives_probabilities: bool = False


class _Answer(msgspec.Struct, frozen=True):
    """The answer of the process: what was found and the model with its weights, or the problem."""

    found: Found | None = None
    content: bytes = b""
    problem: str = ""
    is_setting: bool = False


def probe(content: bytes, folder: Path, request: ProbeRequest) -> tuple[Found, bytes]:
    """Run a small picture through a model in another process; return its properties and the model with all its
    weights, some of which may lie in files of `folder`. Raises DataError if it cannot be read or run, or does not
    give what is expected for one picture; SettingsError if a setting contradicts the model, or is needed.
    """
    command = [sys.executable, "-m", __name__, msgspec.json.encode(request).decode(), str(folder)]
    try:
        done = subprocess.run(
            command,
            input=content,
            capture_output=True,
            timeout=TIME_LIMIT_S,
            env=os.environ | ENVIRONMENT,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise DataError(f"ONNX Runtime did not finish a small picture within {TIME_LIMIT_S:g} s") from None
    try:
        answer = msgspec.msgpack.decode(done.stdout, type=_Answer)
    except msgspec.MsgspecError:
        raise DataError(f"ONNX Runtime crashes with it ({_end(done.returncode)}); it may be damaged") from None
    if answer.found is None:
        raise (SettingsError if answer.is_setting else DataError)(answer.problem)
    return answer.found, answer.content


def _end(status: int) -> str:
    """Return how a process ended."""
    with suppress(ValueError):
        return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"
    return f"status {status}"


def examine(model: Model, request: ProbeRequest) -> Found:
    """Return the layout, channels and size of a network by its inputs, and the rest by a small picture.

    Raises DataError or SettingsError as `probe` does.
    """
    layout, channels, rows, columns = _shape(model, request)
    n_outputs = len(model.session.get_outputs())
    if n_outputs != 1:
        raise DataError(f"has {n_outputs} outputs, expected one")
    # Unequal sides, and an odd multiple, show a network that exchanges axes, loses borders, or needs even sides.
    multiple = request.multiple_px
    shortest = multiple * (SIDE_PX // multiple // 2 * 2 + 1)
    tried = rows or shortest, columns or shortest + multiple
    shown = (_classes if request.answers else _scale_and_loss)(model, request, layout, channels, *tried)
    return Found(layout, channels, rows, columns, *shown)


def _shape(model: Model, request: ProbeRequest) -> tuple[Layout, int, int | None, int | None]:
    """Return layout, channels, rows and columns of a network's pictures."""
    _check_inputs(model.inputs, request.inputs)
    kind, sides = model.picture_input(request.inputs)[1:]
    if kind not in FLOATS.values():
        raise DataError(f"takes values of {kind}, expected 32-bit numbers")
    if len(sides) != 4 or sides[0] not in (1, None):
        raise DataError(
            f"takes pictures of shape {_shown(sides)}, expected one picture with its channels: 4 sides"
        )
    layout: Layout = request.layout or ("nhwc" if sides[3] in CHANNELS and sides[1] not in CHANNELS else "nchw")
    taken, rows, columns = (sides[1], *sides[2:]) if layout == "nchw" else (sides[3], *sides[1:3])
    asked, n_constant = request.channels, int(request.constant_channel is not None)
    channels = asked if taken is None else taken - n_constant
    if channels is None:
        raise SettingsError("channels: the model does not say how many it takes; give channels as 1 or 3")
    if channels not in PICTURE_CHANNELS:
        hint = "1 or 3; if the last is a noise level, give its value as constant_channel"
        expected = "2 or 4 with constant_channel" if n_constant else hint
        raise DataError(f"takes {channels + n_constant} channels, expected {expected}")
    if asked not in (None, channels):
        raise SettingsError(f"channels: found {asked}, expected {channels} as the model says")
    for side in (rows, columns):
        if side is not None and side > MOST_TILE_PX:
            raise DataError(f"takes pictures of {rows} × {columns}, expected sides of at most {MOST_TILE_PX}")
    return layout, channels, rows, columns


def _check_inputs(inputs: tuple[Input, ...], constants: Mapping[str, float]) -> None:
    """Raise an error unless all inputs of a network but one have constant values that they can take."""
    if not inputs:
        raise DataError("has no inputs, expected one: a picture")
    names = in_one_line(", ".join(port.name for port in inputs))
    check_keys(constants, [port.name for port in inputs], f"inputs: the model takes {names}")
    others = [port for port in inputs if port.name not in constants]
    if not others:
        raise SettingsError(f"inputs: found values for all inputs of the model, {names}; expected one without")
    if len(others) > 1:
        further = in_one_line(others[-1].name)
        raise SettingsError(
            f"inputs: the model takes {names}; expected a value for each but the picture: inputs.{further}=VALUE, "
            f"or in its TOML file a table [inputs] with {further} = VALUE"
        )
    for port in inputs:
        if (value := constants.get(port.name)) is None:
            continue
        name = in_one_line(port.name)
        if port.kind not in KINDS.values():
            raise DataError(f"inputs: {name} takes values of {port.kind}, expected numbers")
        if math.prod(side or 1 for side in port.shape) > MOST_TILE_PX**2:
            shape = _shown(port.shape)
            raise DataError(f"inputs: {name} has shape {shape}, expected at most {MOST_TILE_PX}² values")
        is_whole = port.kind in ("int32", "int64")  # which hold all values up to `MOST_CONSTANT`
        if value != round(value) if is_whole else abs(value) > float(np.finfo(port.kind).max):
            raise SettingsError(f"inputs: {name}: found {value:g}, expected a number that {port.kind} can hold")


def _shown(shape: tuple[int | None, ...]) -> str:
    return " × ".join("any" if side is None else str(side) for side in shape)


def _scale_and_loss(
    model: Model, request: ProbeRequest, layout: Layout, channels: int, rows: int, columns: int
) -> tuple[float, int]:
    """Run a picture and return output pixels for one input pixel, and input pixels that each side loses."""
    shape = _run(model, request, layout, channels, rows, columns).shape
    sides = shape[2:] if layout == "nchw" else shape[1:3]
    if len(shape) != 4 or shape[0] != 1 or shape[1 if layout == "nchw" else 3] not in (1, 3) or 0 in shape:
        raise DataError(
            f"gives shape {shape} for {rows} × {columns} pixels, expected one picture of 1 or 3 channels in the "
            "same layout"
        )
    # Output sides are scale · (side − 2 · lost). Of a square all are possible: a whole scale is the likely one.
    if rows == columns:
        likely = range((request.border_px or 0) + 1)
        lost = next((px for px in likely if 2 * px < rows and sides[0] % (rows - 2 * px) == 0), 0)
    else:
        grown = 2 * (sides[1] - sides[0])
        lost = (rows * sides[1] - columns * sides[0]) / grown if grown else -1
    if lost < 0 or lost != round(lost) or sides[0] * (columns - 2 * lost) != sides[1] * (rows - 2 * lost):
        raise DataError(
            f"gives {sides[0]} × {sides[1]} pixels for {rows} × {columns}, expected the same proportions, but "
            f"for borders of equal width{MULTIPLE_HINT}"
        )
    return sides[0] / (rows - 2 * lost), round(lost)


def _classes(
    model: Model, request: ProbeRequest, layout: Layout, channels: int, rows: int, columns: int
) -> tuple[float, int, bool]:
    """Run a picture through a classifier and return (1, 0, whether its values are probabilities)."""
    values, *others = (_run(model, request, layout, channels, rows, columns) for _ in range(N_RUNS))
    if any(not np.array_equal(values, other, equal_nan=True) for other in others):
        raise DataError(
            "gives other values for the same picture each time, as dropout in training mode and nodes that draw "
            "random numbers do; expected the same ones: export it for inference"
        )
    if values.size != request.answers:
        raise DataError(
            f"gives values of shape {_shown(values.shape)}, expected {request.answers}, one for each answer"
        )
    if not np.isfinite(values).all():
        raise DataError("gives values that are NaN or infinite, expected finite ones")
    return 1.0, 0, bool(values.min() >= 0.0 and abs(float(values.sum()) - 1.0) <= 1e-4)  # of half precision, too


def _run(
    model: Model, request: ProbeRequest, layout: Layout, channels: int, rows: int, columns: int
) -> NDArray[np.float32]:
    """Return what a network gives for a small picture; DataError if it fails."""
    ramp = np.linspace(0.25, 0.75, rows * columns).reshape(rows, columns, 1)
    values = request.black + (request.white - request.black) * np.repeat(ramp, channels, axis=2)
    try:
        return model.apply(values.astype(np.float32), layout, request.inputs, request.constant_channel)
    except MemoryError:
        raise DataError(f"needs more memory than there is for {rows} × {columns} pixels") from None
    except Exception as error:
        raise DataError(f"fails with a picture of {rows} × {columns} ({reason(error)}){MULTIPLE_HINT}") from None


def main() -> None:
    """Read a model from standard input and write what it is to standard output, as MessagePack."""
    output = os.dup(1)
    os.dup2(2, 1)  # libraries may print
    _limit_memory()
    request = msgspec.json.decode(sys.argv[1], type=ProbeRequest)
    try:
        content = with_weights(sys.stdin.buffer.read(), Path(sys.argv[2]))
        answer = _Answer(examine(read_model(content), request), content)
    except TodframesError as error:
        answer = _Answer(problem=str(error), is_setting=isinstance(error, SettingsError))
    except MemoryError:
        answer = _Answer(problem="needs more memory than there is")
    with os.fdopen(output, "wb") as file:
        file.write(msgspec.msgpack.encode(answer))
    os._exit(0)  # nothing of the library runs any more


def _limit_memory() -> None:
    """Keep this process to half of the memory, and from writing its own to a file if it crashes."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        most = int(0.5 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


if __name__ == "__main__":
    main()
