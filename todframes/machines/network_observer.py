"""Neural networks that classify as observers: `onnx:CLASSIFIER.onnx`, with `CLASSIFIER.toml` beside it.

A network takes a picture about the triangle and gives four values, one for each direction of the apex. The softmax
of these are the probabilities of its answers. `todframes.enhancement.network` reads, tries and runs the file.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import Positive, check_values, settings_of
from todframes.display.display import Display
from todframes.enhancement.enhanced_frame import AlgorithmDisplay
from todframes.enhancement.network import (
    MOST_TILE_PX,
    SIDE_PX,
    Constant,
    Constants,
    Layout,
    Network,
    examined,
    read_network,
    reason,
    settings_beside,
)
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import CIRCLE_PER_SIZE, ORIENTATIONS, Centre, Orientation, Stimulus

Apex = Literal["up", "right", "down", "left"]

Value = Annotated[float, Meta(ge=-1e6, le=1e6)]

PITCH_MRAD = 0.1

N_CODES = 2**14 + 1
"""Number of code values between which the inverse of a display's function is interpolated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NetworkSettings:
    """Settings of a network that classifies, see docs/how_to/machines.md; those that are None are read from the
    model or from the dataset. `network` and `display` are what it runs and looks at, no settings of a user.
    """

    answers: tuple[Apex, Apex, Apex, Apex] = ("up", "right", "down", "left")
    gives: Literal["scores", "probabilities"] | None = None
    temperature: Annotated[float, Meta(ge=0.0, le=1e6)] = 1.0
    centre: Centre = "centroid"
    layout: Layout | None = None
    channels: Annotated[int, Meta(ge=1, le=3)] | None = None
    black: Value = 0.0
    white: Value = 1.0
    multiple_px: Annotated[int, Meta(ge=1, le=1024)] = 1
    width_sizes: Annotated[float, Meta(ge=2.0, le=100.0)] = 4.0
    inputs: Constants | None = None
    constant_channel: Constant | None = None
    pitch_mrad: Positive | None = None
    background_luminance_cd_m2: Positive | None = None
    network: Network = field(default=Network("", b""), repr=False)
    display: Display | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_values(self)
        if len(set(self.answers)) < len(self.answers):
            found = ", ".join(self.answers)
            raise SettingsError(f"answers: found {found}, expected each of up, right, down and left once")
        if self.black == self.white:
            raise SettingsError(f"black and white: found {self.black:g} for both, expected two values")


class NetworkObserver(Observer):
    """A neural network in an ONNX file that gives a value for each direction of the triangle's apex.

    `read` makes it from a file; without a display, a pixel is 0.1 mrad and the background 0.5 of white.
    """

    settings_type: ClassVar[type[NetworkSettings]] = NetworkSettings
    settings: NetworkSettings

    @classmethod
    def read(cls, path: Path | str, **changes: Any) -> NetworkObserver:
        """Read a network and the settings beside it, changed by name, and try it.

        DataError if the file cannot be read or run, or does not give four finite values for a picture;
        SettingsError if a setting is unknown, out of range, or contradicts the model.
        """
        path, where = Path(path), f"observer 'onnx:{path}'"
        kinds = {setting.name: kind for setting, kind in settings_of(NetworkSettings) if setting.repr}
        content = read_network(path)
        try:
            asked = NetworkSettings(**settings_beside(path, kinds) | changes)
        except SettingsError as error:
            raise SettingsError(f"{where}: {error}") from None
        values = {name: getattr(asked, name) for name in kinds}
        network, shown = examined(content, values, path, where, n_answers=4)
        read = {name: getattr(shown, name) for name in ("layout", "channels")}
        gives = asked.gives or ("probabilities" if shown.gives_probabilities else "scores")
        return cls(replace(asked, network=network, gives=gives, **read))

    @property
    def own_name(self) -> str:
        """Name in results: `onnx:` and the file."""
        return f"onnx:{self.settings.network.name}"

    def pixel_offset(self, stimulus: Stimulus) -> tuple[float, float] | None:
        """Return half a pixel along even sides; None if its pixels are not those of the display."""
        display = self.settings.display
        if display is None or self.settings.pitch_mrad != display.pitch_mrad:
            return None
        rows, columns = self._sides(stimulus)
        return 0.5 * (columns % 2 == 0), 0.5 * (rows % 2 == 0)

    def on_display(self, display: Any, find_background: Callable[[], float]) -> NetworkObserver:
        """Return the network as it looks at the code values of a display."""
        background = self.settings.background_luminance_cd_m2 or find_background()
        pitch_mrad = self.settings.pitch_mrad or display.pitch_mrad
        if display.lut is not None and (np.diff(display.lut.luminance_cd_m2) <= 0.0).any():
            raise SettingsError("lut: luminance_cd_m2 does not rise from row to row, as code values need")
        changed = {"display": display, "pitch_mrad": pitch_mrad, "background_luminance_cd_m2": background}
        return type(self)(self.settings, **changed)

    def _sides(self, stimulus: Stimulus) -> tuple[int, int]:
        """Return the rows and columns of the picture; SettingsError if it does not hold the triangle."""
        settings, size = self.settings, self.settings.network.size
        in_pixels = stimulus.size_mrad / (settings.pitch_mrad or PITCH_MRAD)
        multiple = settings.multiple_px
        side = math.ceil(max(settings.width_sizes * in_pixels, SIDE_PX) / multiple) * multiple
        rows, columns = (known or side for known in size)
        if min(rows, columns) <= 2.0 * CIRCLE_PER_SIZE * in_pixels or max(rows, columns) > MOST_TILE_PX:
            raise SettingsError(
                f"observer {self.own_name!r}: found pictures of {rows} × {columns} pixels and a triangle of "
                f"{stimulus.size_mrad:g} mrad, {in_pixels:.3g} pixels; expected pictures that hold it, with sides "
                f"of at most {MOST_TILE_PX}"
            )
        return rows, columns

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the grid of the picture's pixels, with another at each side, as it may move by one; SettingsError
        if the picture does not hold the triangle.
        """
        return RetinaGrid(max(self._sides(stimulus)) // 2 * 2 + 3, self.settings.pitch_mrad or PITCH_MRAD)

    def picture(self, contrast: FloatArray, stimulus: Stimulus) -> FloatArray:
        """Return the code values about the middle of a retina image, (rows, columns); 0 and 1 are black and white.

        Along even sides, the middle is the first pixel beyond the half.
        """
        middle = len(contrast) // 2
        rows, columns = (slice(middle - n // 2, middle - n // 2 + n) for n in self._sides(stimulus))
        relative, display = 1.0 + contrast[rows, columns], self.settings.display
        if display is None:
            return np.asarray(np.clip(0.5 * relative, 0.0, 1.0))
        light = (self.settings.background_luminance_cd_m2 or 0.0) * relative
        low, high = AlgorithmDisplay(display).code_range
        codes = np.linspace(low, high, N_CODES)
        luminance = display.luminance(codes[:, None, None])[:, 0]
        if display.eotf == "linear":  # frames may have values beyond black and white
            return np.asarray((light - luminance[0]) / (luminance[-1] - luminance[0]))
        return np.interp(light, luminance, codes)

    def expected_answers(self, contrast: FloatArray, stimulus: Stimulus) -> FloatArray:
        """Return the softmax of the network's values; DataError if it fails, or they are not four finite ones."""
        settings, picture = self.settings, self.picture(contrast, stimulus)
        assert settings.layout and settings.channels  # `read` has found them
        values = settings.black + (settings.white - settings.black) * picture[..., None]
        given = np.repeat(values, settings.channels, axis=2).astype(np.float32)
        run, more = settings.network.model.apply, (settings.inputs or {}, settings.constant_channel)
        try:
            scores = run(given, settings.layout, *more).reshape(-1).astype(np.float64)
        except Exception as error:  # whatever the library raises
            shape = " × ".join(map(str, picture.shape))
            raise DataError(f"{self.own_name}: fails with a picture of {shape} ({reason(error)})") from None
        if len(scores) != len(ORIENTATIONS) or not np.isfinite(scores).all():
            raise DataError(f"{self.own_name}: gave {scores[:5].tolist()}, expected four finite values")
        if settings.gives == "probabilities":
            scores = np.log(np.maximum(scores, np.finfo(np.float32).tiny))
        below = scores - scores.max()
        likelihood = np.exp(below / settings.temperature) if settings.temperature else (below == 0.0) * 1.0
        in_order = [settings.answers.index(orientation.value) for orientation in ORIENTATIONS]
        return np.asarray(likelihood[in_order] / likelihood.sum())

    def respond(self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        """Draw an answer with the probabilities of `expected_answers`."""
        return ORIENTATIONS[int(rng.choice(len(ORIENTATIONS), p=self.expected_answers(contrast, stimulus)))]
