"""Recordings of triangles with the ordinary mistakes and mishaps of a laboratory, as datasets.

This module shares nothing with the packages that it tests: it has its own triangles, its own camera and its own
files, and imports neither `todframes` nor `sensor_sim`. Every case has the same triangles, camera and noise; what
differs from the case `flat` is the mishap alone, so the right threshold of a mishap is that of `flat`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
Row = dict[str, str]

SIDE_PX = 96
PITCH_MRAD = 0.25
SIZE_MRAD = 4.0
WHITE, BACKGROUND = 100.0, 30.0  # cd/m²
LEVELS = (0.03, 0.042, 0.059, 0.083, 0.117, 0.166)
REPEATS = 2
BLUR_PX = 0.8
NOISE = 0.02
"""Standard deviation of the camera's noise, as a share of the background."""

EDGE = 2.0 / 3.0**0.25
"""Edge of a triangle of size 1."""

ORIENTATIONS = ("up", "right", "down", "left")
MIDDLE_PX = (SIDE_PX - 1) / 2
SIXTEEN_BITS = 65535
BACKGROUNDS: dict[str, float | str] = {"number": BACKGROUND, "border": "border", "surround": "surround"}
"""The backgrounds that a dataset may declare, by the name of the rule."""


@dataclass(frozen=True, kw_only=True)
class Shot:
    """A triangle in front of the camera: negative contrasts are darker; `x_px`, `y_px` are its centroid."""

    number: int
    orientation: str
    contrast: float
    size_px: float = SIZE_MRAD / PITCH_MRAD
    x_px: float = MIDDLE_PX
    y_px: float = MIDDLE_PX

    @property
    def chance(self) -> np.random.Generator:
        """The random numbers of this shot's mishaps; those of its noise are others."""
        return np.random.default_rng([1, self.number])


def series() -> list[Shot]:
    """Every level in every orientation, `REPEATS` times."""
    conditions = [(level, turn) for level in LEVELS for turn in ORIENTATIONS for _ in range(REPEATS)]
    return [Shot(number=n, contrast=level, orientation=turn) for n, (level, turn) in enumerate(conditions)]


def triangle(shot: Shot) -> Image:
    """Return the share of each pixel that the triangle covers, shape (SIDE_PX, SIDE_PX)."""
    return _covered(shot.orientation, shot.size_px, shot.x_px, shot.y_px)


@cache
def _covered(orientation: str, size_px: float, x: float, y: float) -> Image:
    """Rasterise a triangle that points up and turn its picture.

    That triangle has a chord on every horizontal line: exact along the line, and the mean of 64 lines in each row
    of pixels.
    """
    turns = {"up": 0, "left": 1, "down": 2, "right": 3}[orientation]
    for _ in range(turns):
        x, y = SIDE_PX - 1 - y, x
    edge = EDGE * size_px
    height = edge * math.sqrt(0.75)
    lines = (np.arange(SIDE_PX * 64) + 0.5) / 64 - 0.5
    below_apex = lines - (y - 2.0 * height / 3.0)
    half = np.where((below_apex > 0.0) & (below_apex < height), below_apex / math.sqrt(3.0), 0.0)[:, None]
    pixels = np.arange(SIDE_PX)
    chord = np.minimum(x + half, pixels + 0.5) - np.maximum(x - half, pixels - 0.5)
    covered = np.clip(chord, 0.0, None).reshape(SIDE_PX, 64, SIDE_PX).mean(axis=1)
    return np.rot90(covered, turns)


def blurred(image: Image, sigma_px: float) -> Image:
    """Return the image after a Gaussian blur, mirrored at its borders."""
    return cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)


def srgb(light: Image) -> Image:
    """Encode relative luminance by IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.clip(light, 0.0, None) ** (1 / 2.4) - 0.055)


def power(gamma: float) -> Callable[[Image], Image]:
    """Return an encoding of relative luminance by a power law."""
    return lambda light: np.clip(light, 0.0, None) ** (1.0 / gamma)


def integers(codes: Image, full_scale: int = SIXTEEN_BITS) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """Round code values in [0, 1] to integers, as 8 bits if they fit."""
    rounded = np.rint(np.clip(codes, 0.0, 1.0) * full_scale)
    return rounded.astype(np.uint8 if full_scale < 256 else np.uint16)


def _the_same(image, _shot):
    return image


def _alone(shot: Shot) -> Image:
    return shot.contrast * triangle(shot)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """The way from triangles to a dataset; each step is one that can go wrong.

    `shown` changes what is in front of the camera, and the manifest does not know of it. `drawn` gives its
    contrast. `light` changes the luminance in cd/m² before the noise. `encoded` gives code values in [0, 1],
    `stored` changes the integers of the file. `rows` changes the manifest, `display` keys of `dataset.toml`.
    """

    shown: Callable[[Shot], Shot] = lambda shot: shot
    drawn: Callable[[Shot], Image] = _alone
    blur_px: float = BLUR_PX
    light: Callable[[Image, Shot], Image] = _the_same
    noise: float = NOISE
    encoded: Callable[[Image], Image] = lambda light: light
    full_scale: int = SIXTEEN_BITS
    stored: Callable[[NDArray, Shot], NDArray] = _the_same
    rows: Callable[[list[Row]], list[Row]] = lambda rows: rows
    display: Mapping[str, object] = field(default_factory=dict)

    def frame(self, shot: Shot) -> NDArray:
        """Return the integers of the file of a shot."""
        shot = self.shown(shot)
        luminance = self.light(BACKGROUND * (1.0 + blurred(self.drawn(shot), self.blur_px)), shot)
        noise = np.random.default_rng([0, shot.number]).normal(0.0, self.noise * BACKGROUND, luminance.shape)
        codes = self.encoded((luminance + noise) / WHITE)
        return self.stored(integers(codes, self.full_scale), shot)

    def manifest(self) -> list[Row]:
        """Return the rows of the manifest, of which the shots are the lines."""

        def row(shot: Shot) -> Row:
            frame = {"frame": f"frames/{shot.number:03d}.png", "orientation": shot.orientation}
            return frame | {"size_mrad": f"{SIZE_MRAD:g}", "contrast": f"{shot.contrast:g}"}

        return self.rows([row(shot) for shot in series()])

    def write(self, folder: Path) -> None:
        """Write the frames and the manifest; `declare` writes `dataset.toml`."""
        (folder / "frames").mkdir(parents=True)
        for shot in series():
            path = folder / f"frames/{shot.number:03d}.png"
            assert cv2.imwrite(str(path), self.frame(shot), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        rows = self.manifest()
        with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)

    def declare(self, folder: Path, background: float | str) -> None:
        """Write `dataset.toml` with this background."""
        display = {
            "eotf": "linear",
            "white_luminance_cd_m2": WHITE,
            "pixel_pitch_mrad": PITCH_MRAD,
            "background_luminance_cd_m2": background,
            **self.display,
        }
        quoted = {key: f'"{value}"' if isinstance(value, str) else value for key, value in display.items()}
        lines = [f"{key} = {value}" for key, value in quoted.items()]
        experiment = '[experiment]\nlevel = "contrast"\ngroup_by = []\n'
        text = "schema = 1\n\n[display]\n" + "\n".join(lines) + "\n\n" + experiment
        (folder / "dataset.toml").write_text(text, encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A mishap and how its scoring may end.

    `codes` are the warnings that name it: with one of them any threshold will do. `refused` is a pattern of the
    message that refuses the dataset, or of the status without a threshold. Without either, the threshold has to be
    right. A `control` is no mishap: there must be no warning, and its threshold is its own unless `is_right`.
    """

    name: str
    sentence: str
    recording: Recording
    codes: frozenset[str] = frozenset()
    refused: str | None = None
    control: bool = False
    is_right: bool = True

    @property
    def rules(self) -> tuple[str, ...]:
        """The rules of the background that the case is declared with."""
        return ("number",) if "background_luminance_cd_m2" in self.recording.display else tuple(BACKGROUNDS)


# The steps that go wrong.


@cache
def offsets() -> tuple[Image, Image]:
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX] - MIDDLE_PX
    return x, y


def vignetted(loss: float) -> Callable[[Image, Shot], Image]:
    x, y = offsets()
    share = 1.0 - loss * (x**2 + y**2) / (2.0 * MIDDLE_PX**2)
    return lambda light, _shot: light * share


def framed(light: Image, _shot: Shot) -> Image:
    x, y = offsets()
    return np.where(np.maximum(abs(x), abs(y)) > MIDDLE_PX - 12, 0.1 * BACKGROUND, light)


def letterboxed(light: Image, _shot: Shot) -> Image:
    return np.where(abs(offsets()[1]) > MIDDLE_PX - 12, 0.0, light)


def halved(edge_px: float) -> Callable[[Image, Shot], Image]:
    return lambda light, _shot: np.where(offsets()[0] > edge_px, 0.7, 1.0) * light


def flickering(light: Image, shot: Shot) -> Image:
    return light * (1.0 + 0.1 * np.sin(2.0 * np.pi * (offsets()[1] / 40.0 + shot.chance.random())))


def glaring(light: Image, _shot: Shot) -> Image:
    x, y = offsets()
    return light + 0.5 * BACKGROUND * np.exp(-((x - 24) ** 2 + (y + 10) ** 2) / (2 * 6.0**2))


def detected(light: Image, _shot: Shot) -> Image:
    count = SIDE_PX // 2
    means = light.reshape(count, 2, count, 2).mean(axis=(1, 3))
    return np.repeat(np.repeat(means, 2, axis=0), 2, axis=1)


def shaken(shot: Shot) -> Shot:
    x, y = shot.chance.normal(0.0, 3.0, 2)
    return replace(shot, x_px=shot.x_px + x, y_px=shot.y_px + y)


def drifted(shot: Shot) -> Shot:
    return replace(shot, y_px=shot.y_px + 12.0 * shot.number / (len(series()) - 1))


def moved(x_px: float, y_px: float) -> Callable[[Shot], Shot]:
    return lambda shot: replace(shot, x_px=shot.x_px + x_px, y_px=shot.y_px + y_px)


def darker(shot: Shot) -> Shot:
    return replace(shot, contrast=-shot.contrast)


def late(shot: Shot) -> Shot:
    return series()[shot.number - 1] if shot.number % 4 == 2 else shot


def absent(shot: Shot) -> Shot:
    return replace(shot, contrast=0.0) if shot.number % 4 == 3 else shot


def resized(factor: float) -> Callable[[Shot], Shot]:
    return lambda shot: replace(shot, size_px=factor * shot.size_px)


def two_sizes(shot: Shot) -> Shot:
    return replace(shot, size_px=shot.size_px / (1 + shot.number % 2))


def ghosted(shot: Shot) -> Image:
    return _alone(shot) + 0.5 * _alone(moved(20.0, 0.0)(shot))


def two_orientations(shot: Shot) -> Image:
    other = ORIENTATIONS[(ORIENTATIONS.index(shot.orientation) + 1) % 4]
    return 0.5 * (_alone(shot) + _alone(replace(shot, orientation=other)))


def interlaced(codes: NDArray, _shot: Shot) -> NDArray:
    woven = codes.copy()
    woven[1::2] = np.roll(codes[1::2], 6, axis=1)
    return woven


def distorted(barrel: float, image: Image, _shot: Shot) -> Image:
    x, y = offsets()
    stretch = 1.0 + barrel * (x**2 + y**2) / (2.0 * MIDDLE_PX**2)
    maps = [(MIDDLE_PX + along * stretch).astype(np.float32) for along in (x, y)]
    return cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def tilted(image: Image, _shot: Shot) -> Image:
    turn = cv2.getRotationMatrix2D((MIDDLE_PX, MIDDLE_PX), 12.0, 1.0)
    return cv2.warpAffine(image, turn, image.shape, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def overexposed(light: Image, _shot: Shot) -> Image:
    return light * 0.97 * WHITE / BACKGROUND


def stuck(count: int, distance_px: tuple[float, float]) -> Callable[[NDArray, Shot], NDArray]:
    x, y = offsets()
    distance = np.hypot(x, y)
    there = np.flatnonzero((distance >= distance_px[0]) & (distance < distance_px[1]))
    chosen = np.random.default_rng(3).choice(there, count, replace=False)

    def stored(codes: NDArray, _shot: Shot) -> NDArray:
        codes = codes.copy()
        codes.flat[chosen[::2]], codes.flat[chosen[1::2]] = SIXTEEN_BITS, 0
        return codes

    return stored


def titled(codes: NDArray, shot: Shot) -> NDArray:
    letters = np.zeros(codes.shape, np.uint8)
    for text, at in (("REC", (2, 12)), (f"{shot.number:05d}", (2, 94))):
        cv2.putText(letters, text, at, cv2.FONT_HERSHEY_PLAIN, 0.8, 255)
    return np.where(letters > 127, SIXTEEN_BITS, codes).astype(np.uint16)


def aimed(codes: NDArray, _shot: Shot) -> NDArray:
    x, y = offsets()
    near, far = np.minimum(abs(x), abs(y)), np.maximum(abs(x), abs(y))
    return np.where((near < 1.0) & (far > 3.0) & (far < 24.0), SIXTEEN_BITS, codes).astype(np.uint16)


def tinted(codes: NDArray, _shot: Shot) -> NDArray:
    return np.rint(codes[..., None] * np.array([0.6, 0.8, 1.0])).astype(codes.dtype)


def of_jpeg(quality: int) -> Callable[[NDArray, Shot], NDArray]:
    return lambda codes, _shot: cv2.imdecode(
        cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_UNCHANGED
    )


def scaled(share: float) -> Callable[[NDArray, Shot], NDArray]:
    return lambda codes, _shot: cv2.resize(codes, None, fx=share, fy=share, interpolation=cv2.INTER_AREA)


def posterised(codes: Image) -> Image:
    return np.rint(25.0 * codes) / 25.0


def hunting(light: Image, shot: Shot) -> Image:
    return light * shot.chance.uniform(0.8, 1.2)


def finer(codes: NDArray, shot: Shot) -> NDArray:
    return np.kron(codes, np.ones((2, 2), codes.dtype)) if shot.number % 2 else codes


def background(factor: float) -> dict[str, object]:
    return {"background_luminance_cd_m2": factor * BACKGROUND}


# The mistakes of a manifest.


def times(column: str, factor: float) -> Callable[[list[Row]], list[Row]]:
    return lambda rows: [row | {column: f"{float(row[column]) * factor:.6g}"} for row in rows]


def with_columns(**values: str) -> Callable[[list[Row]], list[Row]]:
    return lambda rows: [row | values for row in rows]


def shifted(column: str) -> Callable[[list[Row]], list[Row]]:
    return lambda rows: [row | {column: rows[n - 1][column]} for n, row in enumerate(rows)]


def shuffled_levels(rows: list[Row]) -> list[Row]:
    order = np.random.default_rng(5).permutation(len(rows))
    return [row | {"contrast": rows[k]["contrast"]} for row, k in zip(rows, order, strict=True)]


def one_level(rows: list[Row]) -> list[Row]:
    return [row | {"contrast": rows[0]["contrast"]} for row in rows]


def repeated_frames(rows: list[Row]) -> list[Row]:
    return [row | {"frame": rows[n - n % REPEATS]["frame"]} for n, row in enumerate(rows)]


def case(name: str, sentence: str, codes: str = "", refused: str | None = None, **steps: object) -> Case:
    """Return a mishap; `codes` are separated by spaces."""
    each = frozenset(codes.split())
    return Case(name=name, sentence=sentence, codes=each, refused=refused, recording=Recording(**steps))


def control(name: str, sentence: str, *, is_right: bool = False, **steps: object) -> Case:
    return Case(name=name, sentence=sentence, recording=Recording(**steps), control=True, is_right=is_right)


OFF_MIDDLE = {"x_px": f"{MIDDLE_PX + 9.0:g}", "y_px": f"{MIDDLE_PX - 5.0:g}"}
SWAPPED = {"x_px": OFF_MIDDLE["y_px"], "y_px": OFF_MIDDLE["x_px"]}
DEGREE, ARC_MINUTE = math.pi / 180.0 * 1000.0, math.pi / 10800.0 * 1000.0  # mrad

SRGB = {"encoded": srgb, "full_scale": 255, "display": {"eotf": "srgb"}}
CONTROLS = (
    control("flat", "A flat background, everything as the dataset says.", is_right=True),
    control("noisy", "Ten times the noise.", noise=10 * NOISE),
    control("defocused", "The lens is out of focus: the threshold rises, as it should.", blur_px=1.6),
    control("eight_bits", "sRGB in 8 bits, as declared.", **SRGB),
    control("small", "Triangles of 10 pixels.", shown=resized(0.625), rows=times("size_mrad", 0.625)),
    control("large", "Triangles of a third of the side.", shown=resized(2.0), rows=times("size_mrad", 2.0)),
    control("large_detectors", "A camera whose detectors are 2 pixels wide.", light=detected),
    control("dark_stated", "Dark triangles, with their polarity.", shown=darker, rows=with_columns(polarity="-1")),
    control("off_centre_stated", "Off the middle.", shown=moved(9.0, -5.0), rows=with_columns(**OFF_MIDDLE)),
)

UNEVEN = "background_uneven background_mismatch"
STUCK = "saturated crushed stuck_pixels"
BACKGROUND_CASES = (
    case("vignetting_30", "Corners darker by 30 %.", UNEVEN, light=vignetted(0.3)),
    case("vignetting_50", "Corners darker by 50 %.", UNEVEN, light=vignetted(0.5)),
    case("vignetting_70", "Corners darker by 70 %.", UNEVEN, light=vignetted(0.7)),
    case("dark_border", "A dark border of 12 pixels around the picture.", UNEVEN, light=framed),
    case("letterbox", "Black bars of 12 pixels above and below.", UNEVEN + " crushed", light=letterboxed),
    case("two_levels_beside", "The background is darker by 30 % beside the triangle.", UNEVEN, light=halved(16)),
    case("two_levels_through", "The background's edge runs through the triangle.", UNEVEN, light=halved(0)),
    case("flicker", "Bands of a lamp's flicker roll over the frames.", UNEVEN, light=flickering),
    case("glare", "A lamp is reflected beside the triangle.", UNEVEN, light=glaring),
    case("on_screen_text", "The camera's own text on the frame.", UNEVEN + " saturated", stored=titled),
    case("cross_hair", "A thermal sight's cross-hair on the triangle.", STUCK, stored=aimed),
    case("background_doubled", "Background number × 2.", "background_mismatch", display=background(2.0)),
    case("background_halved", "Background number / 2.", "background_mismatch", display=background(0.5)),
)

LIGHT = "background_mismatch contrast_mismatch"
VIDEO_LEVELS = {"encoded": lambda codes: (16.0 + 219.0 * codes) / 255.0, "full_scale": 255}
CODE_CASES = (
    case("gamma_as_linear", "sRGB frames declared linear.", LIGHT, encoded=srgb),
    case("srgb_as_bt1886", "sRGB frames declared bt1886.", LIGHT, encoded=srgb, display={"eotf": "bt1886"}),
    case("linear_as_srgb", "Linear frames declared sRGB.", LIGHT, display={"eotf": "srgb"}),
    case("negative", "Black is hot, not white.", LIGHT + " polarity_mismatch", encoded=lambda codes: 1.0 - codes),
    case("colour_cast", "Colour frames with too little blue and green.", "background_mismatch", stored=tinted),
    case("limited_range", "Video levels, 16 to 235, declared full.", "limited_range " + LIGHT, **VIDEO_LEVELS),
    case("twelve_bits", "12 bits in files of 16.", "bit_depth background_mismatch", stored=lambda c, _: c >> 4),
    case("posterised", "Only 26 code values.", "coarse_codes", encoded=posterised, full_scale=255),
    case("jpeg", "They were JPEGs of quality 30.", "coarse_codes contrast_mismatch", **SRGB, stored=of_jpeg(30)),
    case("overexposed", "The triangle is at the end of the scale.", "saturated", light=overexposed),
    case("crushed_blacks", "The blacks are cut off.", "crushed", light=lambda i, _: i - 0.99 * BACKGROUND),
    case("automatic_gain", "Each frame has full contrast.", LIGHT, encoded=lambda c: (c - c.min()) / np.ptp(c)),
    case("automatic_exposure", "The exposure hunts by 20 %.", LIGHT, light=hunting),
    case("dead_pixels_outside", "Sixty stuck pixels off the triangle.", STUCK, stored=stuck(60, (20.0, 48.0))),
    case("hot_pixels_inside", "Eight stuck on it.", STUCK + " background_uneven", stored=stuck(8, (0.0, 8.0))),
)

PLACED = "position_offset"
SCATTERED = "position_scatter " + PLACED
PLACE_CASES = (
    case("off_centre_few", "The triangle is 3 pixels off the middle.", PLACED, shown=moved(2.0, -2.2)),
    case("off_centre_many", "The triangle is 20 pixels off the middle.", PLACED, shown=moved(16.0, 12.0)),
    case("swapped", "x_px and y_px swapped.", PLACED, shown=moved(9.0, -5.0), rows=with_columns(**SWAPPED)),
    case("hand_held", "The camera shakes by 3 pixels.", SCATTERED, shown=shaken),
    case("drift", "The picture drifts by 12 pixels.", SCATTERED, shown=drifted),
    case("interlaced", "Odd rows are 6 pixels late.", PLACED + " size_mismatch", stored=interlaced),
    case("barrel", "The lens bends lines by 10 % in corners.", "size_mismatch", light=partial(distorted, 0.1)),
)

TURNED = "turned mirrored orientation_mismatch"
TRIANGLE_CASES = (
    case("dark_triangles", "Dark triangles without a polarity.", "polarity_mismatch", shown=darker),
    case("mirror", "The camera looks into a mirror.", "mirrored", stored=lambda c, _: np.fliplr(c)),
    case("flip", "Rows from the bottom to the top.", "mirrored flipped", stored=lambda c, _: np.flipud(c)),
    case("quarter_turn", "The camera lies on its side.", "turned", stored=lambda c, _: np.rot90(c)),
    case("half_turn", "The camera hangs upside down.", "turned", stored=lambda c, _: np.rot90(c, 2)),
    case("tilt", "The camera is tilted by 12 degrees.", TURNED, stored=tilted),
    case("orientation_shifted", "Orientations one row too low.", TURNED, rows=shifted("orientation")),
    case("late_frames", "Every fourth frame is of the row before.", TURNED + " contrast_mismatch", shown=late),
    case("absent_triangles", "Every fourth frame is empty.", "contrast_mismatch", shown=absent),
    case("ghost", "The triangle again beside itself, half as strong.", UNEVEN, drawn=ghosted),
    case("double_exposure", "Two orientations at once.", TURNED + " contrast_mismatch", drawn=two_orientations),
)

LEVEL_CASES = (
    case("per_cent", "Contrast in per cent.", "contrast_mismatch", rows=times("contrast", 100.0)),
    case("twice_as_strong", "Stated contrast × 2.", "contrast_mismatch", rows=times("contrast", 2.0)),
    case("levels_shuffled", "Levels of another session.", "contrast_mismatch", rows=shuffled_levels),
    case("negative_levels", "Contrasts below zero.", refused="contrast", shown=darker, rows=times("contrast", -1)),
    case("one_level", "One level in each row.", "contrast_mismatch", refused="too_few_levels", rows=one_level),
    case("repeated_frames", "One frame listed for each repeat.", refused="already", rows=repeated_frames),
)

SIZED = "size_mismatch size_unit"
SIZE_CASES = (
    case("degrees", "Sizes in degrees.", SIZED, rows=times("size_mrad", 1.0 / DEGREE)),
    case("arc_minutes", "Sizes in arcmin.", SIZED, "off the frame", rows=times("size_mrad", 1.0 / ARC_MINUTE)),
    case("edges_for_sizes", "Edges, not the root of the area.", SIZED, rows=times("size_mrad", EDGE)),
    case("microradians", "Sizes in µrad.", SIZED, "smaller than the triangle", rows=times("size_mrad", 1000.0)),
    case("pitch_doubled", "Pixel pitch × 2.", SIZED, display={"pixel_pitch_mrad": 2 * PITCH_MRAD}),
    case("pitch_halved", "Pixel pitch / 2.", SIZED, display={"pixel_pitch_mrad": PITCH_MRAD / 2}),
    case("scaled", "Frames scaled to three quarters.", SIZED, stored=scaled(0.75)),
    case("mixed_sizes", "Every other triangle is half as large.", SIZED + " mixed_sizes", shown=two_sizes),
    case("mixed_resolutions", "Every other frame is twice as fine.", "mixed_frame_sizes " + SIZED, stored=finer),
)

CASES = (*CONTROLS, *BACKGROUND_CASES, *CODE_CASES, *PLACE_CASES, *TRIANGLE_CASES, *LEVEL_CASES, *SIZE_CASES)
