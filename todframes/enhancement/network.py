"""Neural networks in ONNX files as algorithms: `onnx:MODEL.onnx`, with `MODEL.toml` beside it.

A network takes and returns one picture of 1 or 3 channels; further inputs and one more channel have a constant
value. Its layout, channels and size are read from the model, scale and border by running a small picture; settings
say the rest.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import SETTINGS_SUFFIX, check_keys, convert, read_file, read_toml
from todframes.base.safe_text import one_line
from todframes.base.user_code import in_words
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS
from todframes.enhancement.algorithm import Image, algorithm, meaning, parameter

Picture = NDArray[np.float32]

Layout = Literal["nchw", "nhwc"]

MOST_MODEL_MB = 1024
"""Largest size of a model, in units of 2**20 bytes."""

LONGEST_REASON = 200
"""Number of characters of a library's message that are shown."""

ELSEWHERE = re.compile(rb"[\x00\x08]location")
"""Key of a tensor whose values are in another file, behind its length in one byte or in several."""

FLOATS = {"tensor(float)": "float32", "tensor(float16)": "float16"}

KINDS = FLOATS | {"tensor(double)": "float64", "tensor(int32)": "int32", "tensor(int64)": "int64"}
"""NumPy's names of the types that an input may have."""

N_RUNS = 8
"""Number of times that a classifier gets a picture: one that draws one of four answers gives another, but for
0.25⁷."""

SIDE_PX = 64
"""Smallest side of the picture that a network which takes any size is tried with."""

MOST_TILE_PX = 4096
"""Largest side of the pictures of a network of fixed size."""

MULTIPLE_HINT = "; if its sides have to be multiples of a number, such as 8, give that as multiple_px"

CHANNELS = (1, 3, 2, 4)
"""Numbers of channels that a network may take: those of a picture, and another one of one value."""

LEFT_OUT = 0.25
"""Share of the overlap that is left out at the border of a tile."""

WHOLE_PX = 1024
"""Largest side of a frame that a network which takes any size gets whole, if no tile is given."""

MOST_CONSTANT = 1e9
"""Largest magnitude of the value of an input or a channel that is no picture."""

Constant = Annotated[float, msgspec.Meta(ge=-MOST_CONSTANT, le=MOST_CONSTANT)]
Constants = Annotated[dict[Annotated[str, msgspec.Meta(max_length=200)], Constant], msgspec.Meta(max_length=16)]


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
        running = self.thread.submit(self.session.run, None, arrays, options)
        try:
            return np.asarray(running.result()[0], np.float32)
        finally:  # signals arrive in this thread while the network runs in the other, and end it
            options.terminate = True


def with_weights(content: bytes, folder: Path) -> bytes:
    """Return the bytes of a model with all its weights, also those that lie in files beside it."""
    if not ELSEWHERE.search(content):
        return content
    onnx = _imported("onnx")  # it refuses links, `..` and absolute paths
    helper = onnx.external_data_helper
    try:
        model = onnx.load_model_from_string(content)
        for tensor in filter(helper.uses_external_data, helper._get_all_tensors(model)):
            helper.load_external_data_for_tensor(tensor, str(folder))
            del tensor.external_data[:]
            tensor.data_location = onnx.TensorProto.DEFAULT
        return bytes(model.SerializeToString())
    except Exception as error:
        raise DataError(
            "its weights in other files cannot be read, expected them in its folder and no links "
            f"({reason(error)})"
        ) from None


@lru_cache(maxsize=8)
def read_model(content: bytes) -> Model:
    """Read a network from the bytes of an ONNX file, which has all its weights."""
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
    """Return the message of a library in one line, not too long."""
    text = one_line(in_words(error))
    return text if len(text) <= LONGEST_REASON else f"{text[:LONGEST_REASON]}…"


def _imported(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError:
        raise SettingsError(
            f'networks need the package {name}, which is not installed; run: pip install "todframes[onnx]"'
        ) from None


class Found(NamedTuple):
    """The properties of a network that runs.

    `size` are the rows and columns of its pictures; None: any. `scale` is the number of output pixels for one
    input pixel along each axis. `lost_px` is the number of input pixels at each side of a picture that have no
    output. `gives_probabilities` states whether the values of a classifier are positive and sum to 1.
    """

    layout: Layout
    channels: int
    size: tuple[int | None, int | None]
    scale: float = 1.0
    lost_px: int = 0
    gives_probabilities: bool = False


@dataclass(frozen=True)
class Network:
    """A neural network in an ONNX file. It has its content, the model with all its weights: a worker needs no
    file, and kept results are those of these bytes. `version` is that of ONNX Runtime; `size` and `lost_px` are
    those of `Found`.
    """

    name: str
    content: bytes = field(repr=False)
    version: str = ""
    size: tuple[int | None, int | None] = (None, None)
    lost_px: int = 0

    @algorithm(writes=False, magnification="scale", library="ONNX Runtime")
    def enhanced(
        self,
        image: Image,
        *,
        layout: Annotated[Layout, meaning("order of its axes: channels first or last")] | None = None,
        channels: Annotated[int, parameter(1, 3, what="channels that it takes, 1 or 3")] | None = None,
        order: Annotated[Literal["rgb", "bgr"], meaning("of three channels")] = "rgb",
        black: Annotated[float, parameter(-1e6, 1e6, what="value that it takes as black")] = 0.0,
        white: Annotated[float, parameter(-1e6, 1e6, what="value that it takes as white")] = 1.0,
        scale: Annotated[float, parameter(0.1, 16.0, what="output pixels for one along each axis")] | None = None,
        tile_px: Annotated[int, parameter(0, MOST_TILE_PX, unit="px", what="side of tiles; 0: none")]
        | None = None,
        overlap_px: Annotated[int, parameter(0, 1024, unit="px", what="overlap of tiles")] | None = None,
        multiple_px: Annotated[int, parameter(1, 1024, unit="px", what="divisor of all sides")] = 1,
        border_px: Annotated[int, parameter(0, 512, unit="px", what="mirrored pixels around each picture")]
        | None = None,
        inputs: Annotated[Constants, meaning("values of its other inputs by their names")] | None = None,
        constant_channel: Annotated[Constant, meaning("value of one more channel that it takes")] | None = None,
    ) -> Image:
        """Neural network of an ONNX file."""
        assert layout and channels and scale and border_px is not None  # `tried` has found them
        trimmed = round(scale * (border_px - self.lost_px))

        def run(picture: Picture) -> Picture:
            taken = picture[..., ::-1] if order == "bgr" else picture
            given = np.asarray(black + (white - black) * taken, np.float32)
            (answer,) = self.model.apply(given, layout, inputs or {}, constant_channel)
            found = (np.moveaxis(answer, 0, 2) if layout == "nchw" else answer) - np.float32(black)
            found = found[trimmed : len(found) - trimmed, trimmed : found.shape[1] - trimmed]
            return np.asarray((found[..., ::-1] if order == "bgr" else found) / np.float32(white - black))

        pictures = [image[..., None]] if image.ndim == 2 else [image]
        if channels == 3:
            pictures = [np.repeat(grey, 3, axis=2) if grey.shape[2] == 1 else grey for grey in pictures]
        else:
            pictures = [colour[..., k : k + 1] for colour in pictures for k in range(colour.shape[2])]
        whole = [-(-(length + 2 * border_px) // multiple_px) * multiple_px for length in image.shape[:2]]
        sides = [
            fixed or (min(tile_px, length) if tile_px else length)
            for fixed, length in zip(self.size, whole, strict=True)
        ]
        found = [
            _apply(
                run, picture, (sides[0], sides[1]), overlap_px=overlap_px or 0, scale=scale, border_px=border_px
            )
            for picture in pictures
        ]
        if image.ndim == 3 and channels == 3:
            return found[0]
        # The luminance of a coloured picture to first order in its colours, and exactly so on a linear display.
        weights = REC_709_LUMINANCE_WEIGHTS.astype(np.float32)
        greys = [after[..., 0] if after.shape[2] == 1 else np.asarray(after @ weights) for after in found]
        return greys[0] if len(greys) == 1 else np.stack(greys, axis=-1)

    @property
    def model(self) -> Model:
        """The network that ONNX Runtime runs; SettingsError if its version is another one."""
        if (found := runtime_version()) != self.version:
            raise SettingsError(f"ONNX Runtime: found version {found}, expected {self.version}")
        return read_model(self.content)


def read_network(path: Path) -> Network:
    """Return the network in a file, which has not been tried. Raises DataError if the file cannot be read."""
    return Network(path.name, read_file(path, most_mb=MOST_MODEL_MB))


def settings_beside(path: Path, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the given names and types in the TOML file beside a network, if there is one."""
    beside = path.with_suffix(SETTINGS_SUFFIX)
    if not beside.exists():
        return {}
    table = read_toml(beside)
    check_keys(table, kinds, str(beside))
    return {name: convert(value, kinds[name], f"{beside}: {name}") for name, value in table.items()}


def examined(
    network: Network, values: Mapping[str, Any], path: Path, where: str, *, n_answers: int = 0
) -> tuple[Network, Found]:
    """Run a small picture through a network; return it with all its weights, and what the model has shown.

    `values` are its settings by name, None: as the model has them. Its weights may lie in files beside `path`;
    messages about settings begin with `where`. With `n_answers` it classifies with so many values.
    """
    try:
        if values["black"] == values["white"]:
            raise SettingsError(f"black and white: found {values['black']:g} for both, expected two values")
        version = runtime_version()
        content = with_weights(network.content, path.parent)
        found = examine(read_model(content), {**values, "inputs": values["inputs"] or {}}, n_answers)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    return replace(network, content=content, version=version, size=found.size, lost_px=found.lost_px), found


def tried(network: Network, values: Mapping[str, Any], path: Path, where: str) -> tuple[Network, dict[str, Any]]:
    """Try a network of pictures as `examined` does, and return it with all settings of `Network.enhanced`."""
    network, found = examined(network, values, path, where)
    try:
        return network, _resolved(values, found)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


def _resolved(values: Mapping[str, Any], found: Found) -> dict[str, Any]:
    """Return all settings of a network; raise SettingsError if one contradicts what the model has shown."""
    scale, lost, multiple = found.scale, found.lost_px, values["multiple_px"]
    if values["scale"] not in (None, scale):
        raise SettingsError(f"scale: found {values['scale']:g}, expected {scale:g} as the model gives")
    size, tile = found.size, values["tile_px"]
    if tile is not None and any(side not in (tile, None) for side in size):
        taken = " × ".join("any" if side is None else str(side) for side in size)
        raise SettingsError(f"tile_px: found {tile}, but the model takes pictures of {taken} only")
    if None not in size:
        tile = size[0] if size[0] == size[1] else None
    elif tile is None:
        tile = WHOLE_PX // multiple * multiple
    if tile and tile % multiple:
        raise SettingsError(f"tile_px: found {tile}, expected a multiple of {multiple}")
    border = lost if values["border_px"] is None else values["border_px"]
    if border < lost:
        raise SettingsError(f"border_px: found {border}, but the model loses {lost} px a side")
    trimmed = scale * (border - lost)
    if abs(trimmed - round(trimmed)) > 1e-9:  # rounding of the scale
        makes = f"of which the model's scale of {scale:g} makes {trimmed:g} output pixels"
        raise SettingsError(f"border_px: found {border}, {makes}, expected a whole number")
    side = min(side or tile or MOST_TILE_PX for side in size)
    smallest = side - 2 * border
    if smallest <= 0:
        raise SettingsError(f"border_px: found {border}, expected less than half a tile of {side} px")
    # Overlaps of tiles that are large enough have 64 pixels.
    overlap = min(64, smallest // 4) if values["overlap_px"] is None else values["overlap_px"]
    if overlap > smallest // 2:
        raise SettingsError(f"overlap_px: found {overlap}, expected at most half a tile, {smallest // 2}")
    read = {"layout": found.layout, "channels": found.channels, "scale": scale, "tile_px": tile}
    return dict(values) | read | {"overlap_px": overlap, "border_px": border}


def _apply(
    run: Callable[[Picture], Picture],
    image: Picture,
    side: tuple[int, int],
    *,
    overlap_px: int,
    scale: float,
    border_px: int,
) -> Picture:
    """Apply a function of pictures of one size to an image: in tiles if it is larger.

    The image is mirrored at its ends as far as the function loses a border or needs a larger picture.
    """
    around = [
        (border_px, max(border_px, needed - length - border_px))
        for needed, length in zip(side, image.shape[:2], strict=True)
    ]
    wide = np.pad(image, [*around, (0, 0)], mode="reflect") if any(map(any, around)) else image
    rows, columns = (round(scale * length) for length in image.shape[:2])
    if wide.shape[:2] == side:
        return run(wide)[:rows, :columns]
    if scale != round(scale):
        raise ValueError(
            f"a frame of {image.shape[0]} × {image.shape[1]} needs tiles, and they a whole scale, found {scale:g}"
            "; if the network loses a border, give border_px"
        )
    return in_tiles(run, wide, tile=side, overlap_px=overlap_px, scale=round(scale), border_px=border_px)[
        :rows, :columns
    ]


def in_tiles(
    function: Callable[[Picture], Picture],
    image: Picture,
    *,
    tile: tuple[int, int],
    overlap_px: int,
    scale: int = 1,
    border_px: int = 0,
) -> Picture:
    """Apply a function of neighbourhoods to an image, at least as large as a tile, in tiles without seams.

    The function takes a picture, (*tile, channels), and returns it `scale` times as large, without its border.
    Neighbouring tiles overlap by `overlap_px` at least. The outer quarter of each overlap is left out, because a
    tile's border is in view there; between the two quarters one tile fades into the next.
    """
    lengths = [length - 2 * border_px for length in image.shape[:2]]
    inner = [side - 2 * border_px for side in tile]
    rows, columns = (_spans(*axis, overlap_px, scale) for axis in zip(lengths, inner, strict=True))
    result: Picture | None = None
    for row, of_rows in rows:
        for column, of_columns in columns:
            found = function(np.ascontiguousarray(image[row : row + tile[0], column : column + tile[1]]))
            if result is None:
                result = np.zeros((scale * lengths[0], scale * lengths[1], found.shape[2]), np.float32)
            y, x = (slice(scale * at, scale * (at + side)) for at, side in zip((row, column), inner, strict=True))
            result[y, x] += found * np.outer(of_rows, of_columns)[..., None].astype(np.float32)
    assert result is not None  # there is one tile at least
    return result


def _spans(length: int, side: int, overlap_px: int, scale: int) -> list[tuple[int, NDArray[np.float64]]]:
    """Return the first pixel of each tile along an axis, and the weights of its output pixels: they sum to 1."""
    step = side - overlap_px
    n_tiles = max(1, -(-(length - overlap_px) // step))
    starts = [min(number * step, length - side) for number in range(n_tiles)]
    at, total, spans = (np.arange(scale * side) + 0.5) / scale, np.zeros(scale * length), []
    for start in starts:
        weights = np.ones(len(at))
        if start != starts[0]:
            weights = np.minimum(weights, _fade(at, overlap_px))
        if start != starts[-1]:
            weights = np.minimum(weights, _fade(side - at, overlap_px))
        spans.append((slice(scale * start, scale * (start + side)), weights))
        total[spans[-1][0]] += weights
    return [(start, weights / total[pixels]) for start, (pixels, weights) in zip(starts, spans, strict=True)]


def _fade(depth_px: NDArray[np.float64], overlap_px: int) -> NDArray[np.float64]:
    """Return weights from 0 to 1 over the middle of an overlap, by the distance from the tile's border."""
    out = LEFT_OUT * overlap_px
    return np.asarray(np.clip((depth_px - out) / max(overlap_px - 2 * out, 1e-9), 0.0, 1.0))


def examine(model: Model, values: Mapping[str, Any], n_answers: int) -> Found:
    """Return the layout, channels and size of a network by its inputs, and the rest by a small picture."""
    layout, channels, size = _shape(model, values)
    n_outputs = len(model.session.get_outputs())
    if n_outputs != 1:
        raise DataError(f"has {n_outputs} outputs, expected one")
    # Unequal sides, and an odd multiple, show a network that exchanges axes, loses borders, or needs even sides.
    multiple = values["multiple_px"]
    shortest = multiple * (SIDE_PX // multiple // 2 * 2 + 1)
    rows, columns = size[0] or shortest, size[1] or shortest + multiple
    ramp = np.linspace(0.25, 0.75, rows * columns).reshape(rows, columns, 1)
    shown = values["black"] + (values["white"] - values["black"]) * np.repeat(ramp, channels, axis=2)
    asked = shown.astype(np.float32), layout, values["inputs"], values["constant_channel"]
    try:
        answers = [model.apply(*asked) for _ in range(N_RUNS if n_answers else 1)]
    except Exception as error:
        raise DataError(f"fails with a picture of {rows} × {columns} ({reason(error)}){MULTIPLE_HINT}") from None
    if n_answers:
        return Found(layout, channels, size, gives_probabilities=_gives_probabilities(answers, n_answers))
    return Found(
        layout, channels, size, *_scale_and_loss(answers[0].shape, layout, rows, columns, values["border_px"] or 0)
    )


def _shape(model: Model, values: Mapping[str, Any]) -> tuple[Layout, int, tuple[int | None, int | None]]:
    """Return layout, channels, and rows and columns of a network's pictures."""
    _check_inputs(model.inputs, values["inputs"])
    kind, sides = model.picture_input(values["inputs"])[1:]
    if kind not in FLOATS.values():
        raise DataError(f"takes values of {kind}, expected 32-bit numbers")
    if len(sides) != 4 or sides[0] not in (1, None):
        raise DataError(
            f"takes pictures of shape {_shown(sides)}, expected one picture with its channels: 4 sides"
        )
    layout: Layout = values["layout"] or ("nhwc" if sides[3] in CHANNELS and sides[1] not in CHANNELS else "nchw")
    taken, rows, columns = (sides[1], *sides[2:]) if layout == "nchw" else (sides[3], *sides[1:3])
    asked, n_constant = values["channels"], int(values["constant_channel"] is not None)
    channels = asked if taken is None else taken - n_constant
    if channels is None:
        raise SettingsError("channels: the model does not say how many it takes; give channels as 1 or 3")
    if channels not in (1, 3):
        hint = "1 or 3; if the last is a noise level, give its value as constant_channel"
        expected = "2 or 4 with constant_channel" if n_constant else hint
        raise DataError(f"takes {channels + n_constant} channels, expected {expected}")
    if asked not in (None, channels):
        raise SettingsError(f"channels: found {asked}, expected {channels} as the model says")
    if max(rows or 0, columns or 0) > MOST_TILE_PX:
        raise DataError(f"takes pictures of {rows} × {columns}, expected sides of at most {MOST_TILE_PX}")
    return layout, channels, (rows, columns)


def _check_inputs(inputs: tuple[Input, ...], constants: Mapping[str, float]) -> None:
    """Raise an error unless all inputs of a network but one have constant values that they can take."""
    names = one_line(", ".join(port.name for port in inputs))
    check_keys(constants, [port.name for port in inputs], f"inputs: the model takes {names}")
    others = [port for port in inputs if port.name not in constants]
    if not others:
        raise SettingsError(f"inputs: the model takes {names or 'none'}; expected one without a value: a picture")
    if len(others) > 1:
        further = one_line(others[-1].name)
        raise SettingsError(
            f"inputs: the model takes {names}; expected a value for each but the picture: inputs.{further}=VALUE, "
            f"or in its TOML file a table [inputs] with {further} = VALUE"
        )
    for port in inputs:
        if (value := constants.get(port.name)) is None:
            continue
        name = one_line(port.name)
        if port.kind not in KINDS.values():
            raise DataError(f"inputs: {name} takes values of {port.kind}, expected numbers")
        is_whole = port.kind in ("int32", "int64")  # which hold all values up to `MOST_CONSTANT`
        if value != round(value) if is_whole else abs(value) > float(np.finfo(port.kind).max):
            raise SettingsError(f"inputs: {name}: found {value:g}, expected a number that {port.kind} can hold")


def _shown(shape: tuple[int | None, ...]) -> str:
    return " × ".join("any" if side is None else str(side) for side in shape)


def _scale_and_loss(
    shape: tuple[int, ...], layout: Layout, rows: int, columns: int, border_px: int
) -> tuple[float, int]:
    """Return output pixels for one input pixel, and input pixels that each side loses, from an output's shape."""
    sides = shape[2:] if layout == "nchw" else shape[1:3]
    if len(shape) != 4 or shape[0] != 1 or shape[1 if layout == "nchw" else 3] not in (1, 3) or 0 in shape:
        raise DataError(
            f"gives shape {shape} for {rows} × {columns} pixels, expected one picture of 1 or 3 channels in the "
            "same layout"
        )
    # Output sides are scale · (side − 2 · lost). Of a square all are possible: a whole scale is the likely one.
    if rows == columns:
        likely = range(border_px + 1)
        lost: float = next((px for px in likely if 2 * px < rows and sides[0] % (rows - 2 * px) == 0), 0)
    else:
        grown = 2 * (sides[1] - sides[0])
        lost = (rows * sides[1] - columns * sides[0]) / grown if grown else -1
    if lost < 0 or lost != round(lost) or sides[0] * (columns - 2 * lost) != sides[1] * (rows - 2 * lost):
        raise DataError(
            f"gives {sides[0]} × {sides[1]} pixels for {rows} × {columns}, expected the same proportions, but "
            f"for borders of equal width{MULTIPLE_HINT}"
        )
    return sides[0] / (rows - 2 * lost), round(lost)


def _gives_probabilities(answers: list[Picture], n_answers: int) -> bool:
    """Return whether the values of a classifier are probabilities; DataError if they are no good values."""
    values, *others = answers
    if any(not np.array_equal(values, other, equal_nan=True) for other in others):
        raise DataError(
            "gives other values for the same picture each time, as dropout in training mode and nodes that draw "
            "random numbers do; expected the same ones: export it for inference"
        )
    if values.size != n_answers:
        raise DataError(f"gives values of shape {_shown(values.shape)}, expected {n_answers}, one for each answer")
    if not np.isfinite(values).all():
        raise DataError("gives values that are NaN or infinite, expected finite ones")
    return bool(values.min() >= 0.0 and abs(float(values.sum()) - 1.0) <= 1e-4)  # of half precision, too
