"""Datasets of triangles on recorded frames: `scenes`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from todframes import __version__
from todframes.backdrops.views import (
    TURNS,
    Background,
    Encoder,
    Layout,
    PlannedTrial,
    balanced,
    draw_backgrounds,
    local_luminance,
    open_scenes,
    own_orientation,
    plan,
    turned,
    turned_place,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.output import new_folder
from todframes.base.reading import MOST_TRIALS, check_whole, checked, distinct_numbers
from todframes.base.safe_text import csv_text, in_utf8, one_line
from todframes.base.seeds import Rng, seed_of
from todframes.display.display import Display, find_display, table_of_display
from todframes.frames.dataset import BACKGROUND_COLUMN, SCENE_COLUMNS, Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.frames.files import write_frame
from todframes.importing.trials import field_reach_px
from todframes.parameters import (
    MAX_FRAME_MB,
    BlurPx,
    Count,
    DatasetFolder,
    Dimming,
    DisplayName,
    FrameLimit,
    Limits,
    Numbers,
    PathLike,
    Polarity,
    Progress,
    Seed,
    Turns,
    counted,
)
from todframes.stimulus import CIRCLE_PER_SIZE, Orientation, coverage

LEAST_TRIALS = 40
"""Least number of trials of each size and contrast, if none is asked for."""

ROUNDING = 1e-12
"""Smallest contrast of scenes.csv that is more than rounding."""

FINER = 4
"""Points along a pixel at which a triangle is blurred."""

WINDOW_STREAM, VIEW_STREAM = 0, 1
"""First elements of the spawn keys of random streams."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScenesMade:
    """The dataset that `scenes` has written, in numbers and messages.

    Attributes
    ----------
    path : Path
        The dataset.
    n_frames, n_scenes : int
        Frames in the dataset, and scenes behind them.
    trials : int
        Frames of each size and contrast.
    dimmed : float
        Factor of the scenes' luminance above black.
    own_orientation : float
        Root mean square, over the backgrounds, of the contrast of the triangle that would answer as the background
        does by itself.
    own_orientation_left : float
        The same of the mean over all frames of a background: the turns balance it.
    notes : tuple of str
        Remarks that need no action.
    """

    path: Path
    n_frames: int
    n_scenes: int
    trials: int
    dimmed: float
    own_orientation: float
    own_orientation_left: float
    notes: tuple[str, ...]


@checked
def scenes(
    backgrounds: PathLike | Sequence[PathLike],
    *,
    out: DatasetFolder,
    size_mrad: Numbers,
    contrast: Numbers,
    trials: Count | None = None,
    polarity: Polarity = 1,
    blur_px: BlurPx = 0.0,
    windows: Count = 1,
    frames: Count = 1,
    turns: Turns = 8,
    dim: Dimming | None = None,
    display: DisplayName | Display = "reference_sdr",
    value_range: Limits | None = None,
    rng: Seed | Rng = 1,
    max_frame_mb: FrameLimit = MAX_FRAME_MB,
    progress: Progress | None = None,
) -> ScenesMade:
    """Make a dataset of triangles on recorded frames.

    The luminance of a frame is that of the scene on the display, plus contrast × local luminance × the share of
    each pixel that the triangle covers. The local luminance is the mean over the circle through the triangle's
    corners, before it is added. The triangles have not passed the camera: its blur is left out unless `blur_px`
    gives one.

    Parameters
    ----------
    backgrounds : path or sequence of path
        Images, films and arrays, or folders of them; each file is a scene. skimage stands for the photographs that
        scikit-image ships, skimage:camera,brick for two of them.
    out : path
        Folder of the dataset, new or empty.
    size_mrad : sequence of float
        Sizes √(area) of the triangles in mrad at the eye.
    contrast : sequence of float
        Contrasts of the triangles against the local luminance, > 0.
    trials : int, optional
        Frames of each size and contrast. Default: the least number from 40 in which the turns are balanced.
    polarity : {1, -1}
        1 for triangles brighter than the scene, -1 for darker ones.
    blur_px : float
        Blur of the triangle in place of the camera's: standard deviation of a Gaussian in pixels.
    windows : int
        Backgrounds from each frame of a scene.
    frames : int
        Frames from a film, evenly spread.
    turns : {8, 4, 1}
        Turned and mirrored versions in which each scene is shown: 4 are not mirrored, 1 is as recorded.
    dim : float, optional
        Factor of the scene's luminance above black, at most 1. Default: the largest with which no triangle is
        beyond white.
    display : str or Display
        Display that shows the frames: reference_sdr, reference_linear, srgb_monitor, tod_2001, or a TOML file; all
        are in docs/explanation/displays.md.

        A `Display` is taken as well.
    value_range : (float, float), optional
        Recorded values that the display shows black and white; needed for temperatures and counts.
    rng : int, SeedSequence or Generator
        Seed of all random draws.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes; a larger one is refused before it is decoded.
    progress : function of two ints, optional
        Called with the number of frames of a size that are done, and of all.

    Returns
    -------
    ScenesMade

    Raises
    ------
    DataError, FrameError
        If a background cannot be read, or all are unfit: smaller than a frame, even, saturated, or such that the
        display cannot show a triangle on them. If only some are unfit, these are left out, with a note.
    SettingsError
        If a setting is invalid.
    OutputError
        If `out` cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> made = tod.scenes("skimage:camera", size_mrad=[2], contrast=[0.1, 0.4], trials=8, out=tempfile.mkdtemp())
    >>> made.n_frames
    16
    """
    seed = seed_of(rng)
    sizes = distinct_numbers(argument.size_mrad, size_mrad)
    contrasts = distinct_numbers(argument.contrast, contrast)
    most = max(MOST_TRIALS // (len(sizes) * len(contrasts)), 1)
    for name, number in {argument.windows: windows, argument.frames: frames, argument.trials: trials}.items():
        if number is not None:
            check_whole(name, number, 1, most)
    experiment = Experiment(level="contrast", group_by=("size_mrad",))
    shown = find_display(display)
    stage = _Stage.of(shown.display, contrasts, polarity, blur_px, dim)
    pitch = shown.display.pitch_mrad
    layouts = [_layout(size, pitch) for size in sizes]
    notes: list[str] = []
    files = open_scenes(backgrounds, value_range=value_range, max_frame_mb=max_frame_mb, note=notes.append)
    backgrounds_of = draw_backgrounds(
        files,
        shown.display,
        layouts,
        seed=seed,
        stream=WINDOW_STREAM,
        windows=windows,
        frames=frames,
        room_for=stage.room_for if stage.may_clip else None,
        note=notes.append,
    )
    shown_turns = TURNS[:turns]
    step = balanced(len(backgrounds_of[0]), shown_turns)
    n_trials = math.ceil(LEAST_TRIALS / step) * step if trials is None else trials
    if n_trials % step:
        notes.append(
            f"{n_trials} trials of each size and contrast are no multiple of {step}: the turns of the "
            f"{len(backgrounds_of[0])} backgrounds are not balanced"
        )
    rows: list[dict[str, str]] = []
    own: list[_OwnOrientation] = []
    with new_folder(str(out)) as folder:
        (folder / "frames").mkdir()
        for k, (size, layout, found) in enumerate(zip(sizes, layouts, backgrounds_of, strict=True)):
            places = _places(
                found, shown_turns, layout.reach_px, np.random.SeedSequence(seed, spawn_key=(VIEW_STREAM, k))
            )
            seen = _SeenViews(stage, layout, found, places)
            planned = list(plan(len(found), shown_turns, len(contrasts), n_trials))
            for trial in counted(planned, len(planned), progress):
                rows.append(seen.write(folder, size, contrasts[trial.level], trial))
            own += seen.report(size)
        table = csv_text([_OwnOrientation._fields, *(background.row() for background in own)])
        (folder / "scenes.csv").write_text(in_utf8(table), encoding="utf-8")
        write_dataset_files(
            folder,
            rows,
            display=table_of_display(shown.display, folder) | {BACKGROUND_COLUMN: "column"},
            experiment=experiment,
            comment=f"Triangles on scenes by todframes {__version__} with seed {seed}, scenes dimmed by "
            f"{stage.dim:.6g}\nDisplay: {one_line(shown.title)}",
        )
    return ScenesMade(
        path=Path(out),
        n_frames=len(rows),
        n_scenes=len({background.scene for background in own}),
        trials=n_trials,
        dimmed=stage.dim,
        own_orientation=math.sqrt(np.mean(np.square([one.own_orientation_contrast for one in own]))),
        own_orientation_left=math.sqrt(np.mean(np.square([one.own_orientation_left for one in own]))),
        notes=tuple(notes),
    )


def _layout(size_mrad: float, pitch_mrad: float) -> Layout:
    size_px = size_mrad / pitch_mrad
    if not 1.0 <= size_px <= 1e4:
        raise SettingsError(
            f"{argument.size_mrad}: found {size_mrad:g} mrad, which is {size_px:.3g} pixels of {pitch_mrad:g} "
            "mrad, expected 1 to 10000 pixels"
        )
    return Layout(size_px, field_reach_px(math.ceil(size_px), pitch_mrad))


class _Stage(NamedTuple):
    """Settings that all frames share: display, factor of the scene's luminance, and look of the triangle."""

    encoder: Encoder
    dim: float
    polarity: int
    blur_px: float
    contrasts: list[float]

    @classmethod
    def of(
        cls, display: Display, contrasts: list[float], polarity: int, blur_px: float, dim: float | None
    ) -> _Stage:
        encoder = Encoder(display)
        black, white = encoder.black_cd_m2, encoder.white_cd_m2
        largest = 1.0
        if polarity > 0:
            largest = min((white / (1.0 + max(contrasts)) - black) / (white - black), 1.0)
        if dim is not None and not 0.0 < dim <= 1.0:
            raise SettingsError(f"{argument.dim}: found {dim!r}, expected more than 0, and at most 1")
        if not largest > 0.0:
            raise SettingsError(
                f"{argument.contrast}: found {max(contrasts):g}, expected less than {white / black - 1.0:.3g}"
            )
        return cls(encoder, largest if dim is None else dim, polarity, blur_px, contrasts)

    @property
    def may_clip(self) -> bool:
        """Whether a triangle may be beyond black or white on some scenes."""
        encoder = self.encoder
        brightest = self.dimmed(np.array([encoder.white_cd_m2]))[0] * (1.0 + max(self.contrasts))
        return self.polarity < 0 or brightest > encoder.white_cd_m2 * (1.0 + 1e-9)

    def room_for(self, luminance_cd_m2: FloatArray, layout: Layout) -> float:
        """Return how many times stronger the strongest triangle on a window could be without clipping. It stays
        within black and white of the display in all orientations.
        """
        scene = self.dimmed(luminance_cd_m2)
        rows, columns = np.arange(scene.shape[0])[:, None], np.arange(scene.shape[1])
        middle = layout.reach_px
        inside = scene[np.hypot(rows - middle, columns - middle) <= CIRCLE_PER_SIZE * layout.size_px + 1.0]
        encoder = self.encoder
        most = encoder.white_cd_m2 - inside.max() if self.polarity > 0 else inside.min() - encoder.black_cd_m2
        # A triangle is displaced by half a pixel, which changes the local luminance by a per cent or so.
        return float(most) / (1.02 * max(self.contrasts) * local_luminance(scene, middle, middle, layout.size_px))

    def dimmed(self, luminance_cd_m2: FloatArray) -> FloatArray:
        """Return the luminance of a scene as the frames show it."""
        black = self.encoder.black_cd_m2
        return np.asarray(black + self.dim * (luminance_cd_m2 - black))


def _places(
    backgrounds: Sequence[Background], turns: Sequence[str], middle_px: int, seed: np.random.SeedSequence
) -> dict[tuple[int, str], tuple[float, float]]:
    """Draw the place of the triangle on each background, within half a pixel of the middle; it is turned as the
    background is.
    """
    rng = np.random.default_rng(seed)
    rng.permutation(len(backgrounds))  # a seed gives the positions of earlier versions, which drew more
    jitters = rng.uniform(-0.5, 0.5, (len(backgrounds), 2)).tolist()
    turned_jitters = {
        (number, turn): turned_place(x, y, turn) for number, (x, y) in enumerate(jitters) for turn in turns
    }
    return {view: (middle_px + dx, middle_px + dy) for view, (dx, dy) in turned_jitters.items()}


class _OwnOrientation(NamedTuple):
    """A row of scenes.csv: the background's luminance and texture, and what orientation it has by itself."""

    scene: str
    scene_window: str
    size_mrad: float
    n_frames: int
    local_luminance_cd_m2: float
    texture_contrast: float
    own_orientation_contrast: float
    own_orientation_left: float

    def row(self) -> list[str]:
        numbers = (f"{number if abs(number) > ROUNDING else 0.0:.6g}" for number in self[4:])
        return [self.scene, self.scene_window, repr(self.size_mrad), str(self.n_frames), *numbers]


def _shown_triangle(
    side: int, size_px: float, place: tuple[float, float], orientation: Orientation, blur_px: float
) -> FloatArray:
    """Return the share of each pixel of a frame that a triangle covers, after a Gaussian blur of the scene."""
    x_px, y_px = place
    if not blur_px:
        return coverage((side, side), size_px=size_px, x_px=x_px, y_px=y_px, orientation=orientation)
    from scipy.ndimage import gaussian_filter

    # Blurred on pixels, a triangle would be sampled before the blur, and narrow kernels would be narrower.
    fine = coverage(
        (FINER * side, FINER * side),
        size_px=FINER * size_px,
        x_px=FINER * (x_px + 0.5) - 0.5,
        y_px=FINER * (y_px + 0.5) - 0.5,
        orientation=orientation,
    )
    blurred = gaussian_filter(fine, FINER * blur_px, mode="constant", truncate=6.0)
    return np.asarray(blurred.reshape(side, FINER, side, FINER).mean(axis=(1, 3)))


class _SeenViews:
    """The frames of one size, and how often each view was shown."""

    def __init__(
        self,
        stage: _Stage,
        layout: Layout,
        backgrounds: Sequence[Background],
        places: dict[tuple[int, str], tuple[float, float]],
    ) -> None:
        self.stage, self.layout, self.backgrounds, self.places = stage, layout, backgrounds, places
        self.shown = dict.fromkeys(places, 0)
        self._scene = lru_cache(maxsize=4 * len(TURNS))(self._dimmed)

    def _dimmed(self, background: int, turn: str) -> tuple[FloatArray, float]:
        """Return a background's luminance as shown, and the local luminance at its place."""
        luminance = self.stage.dimmed(turned(self.backgrounds[background].luminance_cd_m2, turn))
        return luminance, local_luminance(luminance, *self.places[background, turn], self.layout.size_px)

    def write(self, folder: Path, size_mrad: float, contrast: float, trial: PlannedTrial) -> dict[str, str]:
        """Write a frame; return its row of the manifest."""
        background, key = self.backgrounds[trial.background], (trial.background, trial.turn)
        (scene, local), stage = self._scene(*key), self.stage
        triangle = _shown_triangle(
            len(scene), self.layout.size_px, self.places[key], trial.orientation, stage.blur_px
        )
        luminance = scene + stage.polarity * contrast * local * triangle
        black, white = stage.encoder.black_cd_m2, stage.encoder.white_cd_m2
        if luminance.max() > white * (1.0 + 1e-9) or luminance.min() < black - 1e-9 * white:
            raise DataError(
                f"{background.scene}, window {background.window}, {trial.turn}: a triangle of contrast "
                f"{contrast:g} goes beyond black or white of the display, expected less contrast or another "
                f"{argument.dim}"
            )
        name = f"frames/s{size_mrad:g}_c{contrast:g}_{trial.orientation}_{trial.number}.png"
        write_frame(folder / name, stage.encoder(luminance))
        self.shown[key] += 1
        row = {
            "frame": name,
            "orientation": trial.orientation.value,
            "size_mrad": repr(size_mrad),
            "contrast": repr(contrast),
            **{name: f"{at:.6f}" for name, at in zip(("x_px", "y_px"), self.places[key], strict=True)},
            BACKGROUND_COLUMN: f"{local:.8g}",
        } | dict(zip(SCENE_COLUMNS, background.view(trial.turn), strict=True))
        return row | ({"polarity": "-1"} if stage.polarity < 0 else {})

    def report(self, size_mrad: float) -> Iterator[_OwnOrientation]:
        """Yield for each background what orientation it has by itself, as it is and over the frames shown."""
        for number, background in enumerate(self.backgrounds):
            keys = [key for key in self.places if key[0] == number and self.shown[key]]
            if not keys:
                continue
            counts = np.array([self.shown[key] for key in keys], np.float64)
            responses, local, texture = [], [], []
            for key in keys:
                scene, mean = self._scene(*key)
                responses.append(own_orientation(scene, *self.places[key], self.layout.size_px))
                local.append(mean)
                texture.append(float((scene / mean).std()))
            yield _OwnOrientation(
                background.scene,
                background.window,
                size_mrad,
                int(counts.sum()),
                float(np.average(local, weights=counts)),
                float(np.average(texture, weights=counts)),
                float(np.average(np.max(responses, axis=1), weights=counts)),
                float(np.average(responses, axis=0, weights=counts).max()),
            )
