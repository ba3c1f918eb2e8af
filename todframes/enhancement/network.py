"""Neural networks in ONNX files as algorithms: `onnx:MODEL.onnx`, with `MODEL.toml` beside it.

A network takes and returns one picture of 1 or 3 channels; further inputs and one more channel have a constant
value. Its layout, channels and size are read from the model, scale and border by running a small picture; settings
say the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import SETTINGS_SUFFIX, check_keys, convert, read_file, read_toml
from todframes.display.display import REC_709_LUMINANCE_WEIGHTS
from todframes.enhancement.algorithm import Image, algorithm, meaning, parameter
from todframes.enhancement.network_probe import (
    MOST_MODEL_MB,
    MOST_TILE_PX,
    Found,
    Layout,
    Model,
    ProbeRequest,
    probe,
    read_model,
    runtime_version,
)

Picture = NDArray[np.float32]

LEFT_OUT = 0.25
"""Share of the overlap that is left out at the border of a tile."""

WHOLE_PX = 1024
"""Largest side of a frame that a network which takes any size gets whole, if no tile is given."""

MOST_CONSTANT = 1e9
"""Largest magnitude of the value of an input or a channel that is no picture."""

Constant = Annotated[float, msgspec.Meta(ge=-MOST_CONSTANT, le=MOST_CONSTANT)]
Constants = Annotated[dict[Annotated[str, msgspec.Meta(max_length=200)], Constant], msgspec.Meta(max_length=16)]


@dataclass(frozen=True)
class Network:
    """A neural network in an ONNX file.

    It is pickled with its content, the model with all its weights: a worker needs no file, and results in the
    store are those of these bytes. `version` is that of ONNX Runtime. `size` are the rows and columns of its
    pictures, None: any; `lost_px` the input pixels at each side of a picture that have no output.
    """

    name: str
    content: bytes = field(repr=False)
    version: str = ""
    size: tuple[int | None, int | None] = (None, None)
    lost_px: int = 0

    def __reduce__(self) -> tuple[Any, ...]:
        return Network, (self.name, self.content, self.version, self.size, self.lost_px)

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

    @cached_property
    def model(self) -> Model:
        """The network that ONNX Runtime runs; SettingsError if its version is another one."""
        if (found := runtime_version()) != self.version:
            raise SettingsError(f"ONNX Runtime: found version {found}, expected {self.version}")
        return read_model(self.content)


def read_network(path: Path) -> Network:
    """Return the network in a file, which has not been tried. Raises DataError if the file cannot be read."""
    return Network(path.name, read_file(path, most_mb=MOST_MODEL_MB))


def settings_beside(path: Path, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of the given names and types in the TOML file beside a network; empty if there is none.

    Raises SettingsError if it cannot be read, a key is unknown, or a value is not of its type.
    """
    beside = path.with_suffix(SETTINGS_SUFFIX)
    if not beside.exists():
        return {}
    table = read_toml(beside)
    check_keys(table, kinds, str(beside))
    return {name: convert(value, kinds[name], f"{beside}: {name}") for name, value in table.items()}


def examined(
    network: Network, values: Mapping[str, Any], path: Path, where: str, *, answers: int = 0
) -> tuple[Network, Found]:
    """Try a network in another process; return it with all its weights, and what the model has shown.

    `values` are its settings by name, None: as the model has them. Its weights may lie in files beside `path`;
    messages about settings begin with `where`. With `answers` it classifies with so many values. Raises errors as
    `probe` does.
    """
    taken = [name for name in ProbeRequest.__struct_fields__ if name in values]
    shared = {name: values[name] for name in taken} | {"inputs": values["inputs"] or {}, "answers": answers}
    try:
        if values["black"] == values["white"]:
            raise SettingsError(f"black and white: found {values['black']:g} for both, expected two values")
        version = runtime_version()
        properties, content = probe(network.content, path.parent, ProbeRequest(**shared))
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    size = properties.rows, properties.columns
    return replace(network, content=content, version=version, size=size, lost_px=properties.lost_px), properties


def tried(network: Network, values: Mapping[str, Any], path: Path, where: str) -> tuple[Network, dict[str, Any]]:
    """Try a network of pictures as `examined` does, and return it with all settings of `Network.enhanced`."""
    network, properties = examined(network, values, path, where)
    try:
        return network, _resolved(values, properties)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


def _resolved(values: Mapping[str, Any], properties: Found) -> dict[str, Any]:
    """Return all settings of a network; raise SettingsError if one contradicts what the model has shown."""
    scale, lost, multiple = properties.scale, properties.lost_px, values["multiple_px"]
    if values["scale"] not in (None, scale):
        raise SettingsError(f"scale: found {values['scale']:g}, expected {scale:g} as the model gives")
    size, tile = (properties.rows, properties.columns), values["tile_px"]
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
    found = {"layout": properties.layout, "channels": properties.channels, "scale": scale, "tile_px": tile}
    return dict(values) | found | {"overlap_px": overlap, "border_px": border}


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
