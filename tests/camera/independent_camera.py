"""A camera that films charts, and where it sees the triangles: NumPy, OpenCV and PyAV alone.

Nothing here comes from the packages under test, so an error that they share with it would take two equal mistakes.
Places are pixels with (0, 0) in the centre of the top left one, x to the right and y down.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float64]
TO_LIGHT: dict[str, Callable[[Image], Image]] = {
    "linear": lambda code: code,
    "srgb": lambda code: np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4),
}
DIRECTIONS = {"up": (0.0, -1.0), "right": (1.0, 0.0), "down": (0.0, 1.0), "left": (-1.0, 0.0)}


@dataclass(frozen=True, kw_only=True)
class Seen:
    """A triangle as the camera sees it: centroid, √(area) and direction in pixels of the camera."""

    x_px: float
    y_px: float
    size_px: float
    orientation: str
    contrast: float
    size_mrad: float


@dataclass(frozen=True, kw_only=True)
class Chart:
    """The pages of a chart on its monitor, as `chart.toml` and the PNG files have them."""

    folder: Path
    content: dict

    @classmethod
    def read(cls, folder: Path) -> Chart:
        return cls(folder=folder, content=tomllib.loads((folder / "chart.toml").read_text(encoding="utf-8")))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the monitor."""
        return self.content["screen"]["height_px"], self.content["screen"]["width_px"]

    def __len__(self) -> int:
        return len(self.content["pages"])

    def light(self, page: int) -> Image:
        """The light of a page as a share of white, a value for each pixel of the monitor."""
        code = cv2.imread(str(self.folder / self.content["pages"][page]["file"]), cv2.IMREAD_UNCHANGED)
        code = code / np.iinfo(code.dtype).max
        grey = code if code.ndim == 2 else code[..., :3].mean(axis=2)
        return TO_LIGHT[self.content["screen"]["eotf"]](grey)

    def triangle(self, page: int, matrix: Image, bending: Bending | None = None) -> Seen:
        """Where a camera with this homography and lens sees the triangle of a page."""
        (one,) = self.content["pages"][page]["triangles"]
        pitch = self.content["screen"]["pixel_pitch_mm"]
        u, v = one["x_mm"] / pitch - 0.5, one["y_mm"] / pitch - 0.5
        # The apex is 2/3 of the height from the centroid; the area is height² / √3.
        height = one["size_mm"] / pitch * 3**0.25
        ahead = np.array(DIRECTIONS[one["orientation"]])
        aside = np.array([-ahead[1], ahead[0]])
        corners = (u, v) + height * np.array(
            [ahead * 2 / 3, -ahead / 3 + aside / math.sqrt(3), -ahead / 3 - aside / math.sqrt(3)]
        )
        # A lens bends the sides, so they are followed in small steps.
        shares = np.linspace(0.0, 1.0, 100, endpoint=False)[:, None]
        outline = np.vstack([a + (b - a) * shares for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])
        seen = np.column_stack([outline, np.ones(len(outline))]) @ matrix.T
        seen = seen[:, :2] / seen[:, 2:]
        if bending is not None:
            seen = bending.bent(seen)
        after = np.roll(seen, -1, axis=0)
        slices = seen[:, 0] * after[:, 1] - seen[:, 1] * after[:, 0]
        x, y = ((seen + after) * slices[:, None]).sum(axis=0) / (3 * slices.sum())
        pointing = seen[0] - (x, y)
        return Seen(
            x_px=float(x),
            y_px=float(y),
            size_px=math.sqrt(abs(slices.sum()) / 2),
            orientation=max(DIRECTIONS, key=lambda name: pointing @ DIRECTIONS[name]),
            contrast=one["contrast"],
            size_mrad=one["size_mrad"],
        )


def looking_at(
    chart: Chart,
    *,
    width: int,
    height: int,
    scale: float,
    turn_deg: float = 0.0,
    tilt_deg: float = 0.0,
    pan_deg: float = 0.0,
    mirrored: bool = False,
    shift_px: tuple[float, float] = (0.0, 0.0),
) -> Image:
    """The homography from the monitor's pixels to the camera's, shape (3, 3).

    The camera looks at the middle of the monitor, where one pixel of it is `scale` pixels of the camera. It is
    turned about its axis, and the monitor about its horizontal (tilt) and vertical (pan) middle line.
    """
    rows, columns = chart.shape
    focal_px = 2.0 * max(width, height)  # a field of view of 28 degrees
    distance = focal_px / scale
    turn, tilt, pan = (math.radians(angle) for angle in (turn_deg, tilt_deg, pan_deg))
    about_x = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    about_y = np.array([[math.cos(pan), 0, math.sin(pan)], [0, 1, 0], [-math.sin(pan), 0, math.cos(pan)]])
    about_z = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    rotation = about_z @ about_x @ about_y
    centred = np.array([[1, 0, -(columns - 1) / 2], [0, 1, -(rows - 1) / 2], [0, 0, 1]])
    to_camera = np.column_stack([rotation[:, 0], rotation[:, 1], (0.0, 0.0, distance)])
    sign = -1.0 if mirrored else 1.0
    x0, y0 = (width - 1) / 2 + shift_px[0], (height - 1) / 2 + shift_px[1]
    inner = np.array([[sign * focal_px, 0, x0], [0, focal_px, y0], [0, 0, 1]])
    return inner @ to_camera @ centred


@dataclass(frozen=True, kw_only=True)
class Bending:
    """A lens that bends straight lines, about the middle of a frame of width × height pixels.

    The radius of an ideal picture, in units of half the frame's diagonal, becomes r (1 + k1 r² + k2 r⁴ + k3 r⁶)
    for a lens with barrel or pincushion distortion, and the angle of the ray for a fisheye lens whose picture
    spans `fisheye_deg` along the diagonal: the ideal picture's centre then keeps its scale. The lens may sit
    beside the middle, by (x, y) pixels.
    """

    width: int
    height: int
    k: tuple[float, ...] = ()
    fisheye_deg: float | None = None
    beside_px: tuple[float, float] = (0.0, 0.0)

    @property
    def middle(self) -> Image:
        return np.array([(self.width - 1) / 2, (self.height - 1) / 2]) + self.beside_px

    @property
    def half_diagonal(self) -> float:
        return math.hypot(self.width, self.height) / 2

    def radius(self, ideal: Image) -> Image:
        """Where a radius of the ideal picture is found, both in units of half the diagonal."""
        if self.fisheye_deg is not None:
            widest = math.radians(self.fisheye_deg) / 2
            return np.arctan(ideal * widest) / widest
        return ideal * (1 + sum(k * ideal ** (2 * n) for n, k in enumerate(self.k, start=1)))

    def bent(self, places: Image) -> Image:
        """Pixels of places of the ideal picture, (n, 2)."""
        away = (places - self.middle) / self.half_diagonal
        radius = np.linalg.norm(away, axis=1, keepdims=True)
        stretch = np.where(radius > 0, self.radius(radius) / np.maximum(radius, 1e-12), 1.0)
        return self.middle + away * stretch * self.half_diagonal

    def straightened(self, places: Image) -> Image:
        """Places of the ideal picture for pixels, (..., 2); far away where no ray arrives."""
        ideal = np.linspace(0.0, 5.0, 50_001)
        found = self.radius(ideal)
        turning = np.flatnonzero(np.diff(found) <= 0)
        stop = turning[0] + 1 if turning.size else len(found)
        away = (places - self.middle) / self.half_diagonal
        radius = np.linalg.norm(away, axis=-1, keepdims=True)
        straight = np.interp(radius, found[:stop], ideal[:stop], right=1e4)
        return self.middle + away * straight / np.maximum(radius, 1e-12) * self.half_diagonal


@dataclass(frozen=True, kw_only=True)
class Camera:
    """What a camera does to the light: blur, vignetting, noise, mosaic, tone curve and rounding."""

    width: int = 480
    height: int = 320
    blur_sigma_px: float = 0.7
    electrons_at_white: float = 40_000.0
    read_noise_electrons: float = 6.0
    vignetting: float = 0.0  # share of the light lost in the corners; falls with the square of the radius
    mosaic: bool = False
    gamma: float = 1.0  # code = light ** (1 / gamma)
    bits: int = 16
    oversampling: int = 5
    bending: Bending | None = None

    def image(self, light: Image, matrix: Image) -> Image:
        """The light on each pixel: mean over its area of the warped and blurred page, shape (height, width)."""
        fine = self.oversampling
        to_fine = np.array([[fine, 0, (fine - 1) / 2], [0, fine, (fine - 1) / 2], [0, 0, 1.0]])
        size = (self.width * fine, self.height * fine)
        # Samples of the page itself would round its edges to whole samples. Its pixels are halved, so that edges
        # get the width of about one sample and keep their places when interpolated.
        halves = light.astype(np.float32).repeat(2, axis=0).repeat(2, axis=1)
        to_halves = np.array([[2.0, 0, 0.5], [0, 2.0, 0.5], [0, 0, 1.0]])
        whole = to_fine @ matrix @ np.linalg.inv(to_halves)
        if self.bending is None:
            warped = cv2.warpPerspective(halves, whole, size, flags=cv2.INTER_LINEAR, borderValue=0.02)
        else:
            warped = self._bent(halves, to_fine, whole)
        blurred = cv2.GaussianBlur(warped, (0, 0), self.blur_sigma_px * fine)
        pixels = cv2.resize(blurred, (self.width, self.height), interpolation=cv2.INTER_AREA)
        y, x = np.mgrid[-1 : 1 : self.height * 1j, -1 : 1 : self.width * 1j]
        return pixels * (1.0 - self.vignetting * (x**2 + y**2) / 2.0)

    def _bent(self, halves: NDArray[np.float32], to_fine: Image, whole: Image) -> NDArray[np.float32]:
        """The page through a lens that bends lines, on the fine grid."""
        # Samples of the fine grid are up to three halves of the monitor's pixels apart where the lens squeezes the
        # picture: a blur by 1.5 of them, a third of a pixel of the camera, spares edges the rounding to samples.
        halves = cv2.GaussianBlur(halves, (0, 0), 1.5)
        x, y = _behind_the_lens(self, tuple(to_fine.ravel()), tuple(whole.ravel()))
        return cv2.remap(halves, x, y, cv2.INTER_LINEAR, borderValue=0.02)

    def expose(self, image: Image, rng: np.random.Generator) -> NDArray[np.uint8 | np.uint16]:
        """One frame of code values, grey or RGB, with new noise."""
        if self.mosaic:
            raw = self._read(image, rng)
            # The monitor is white, so red, green and blue sites get the same light; demosaicing is bilinear.
            rgb = cv2.cvtColor(np.rint(raw * 65535).astype(np.uint16), cv2.COLOR_BayerBG2RGB)
            values = rgb / 65535.0
        else:
            values = self._read(image, rng)
        code = np.rint(np.clip(values, 0.0, 1.0) ** (1.0 / self.gamma) * (2**self.bits - 1))
        return code.astype(np.uint8 if self.bits == 8 else np.uint16)

    def _read(self, image: Image, rng: np.random.Generator) -> Image:
        electrons = image * self.electrons_at_white
        noise = rng.standard_normal(image.shape) * np.sqrt(electrons + self.read_noise_electrons**2)
        return np.clip((electrons + noise) / self.electrons_at_white, 0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class ThermalCamera:
    """A thermal camera of 14 bits: a round lens without errors, square detectors without gaps, and white noise."""

    f_number: float = 1.0
    focal_length_mm: float = 14.0
    pitch_um: float = 12.0
    wavelength_um: float = 10.0
    netd_k: float = 0.04
    noise_dn: float = 12.0
    background_dn: float = 7_300.0
    side_px: int = 64
    oversampling: int = 8

    @property
    def ifov_mrad(self) -> float:
        return self.pitch_um / self.focal_length_mm

    def image(self, size_px: float, orientation: str) -> Image:
        """A triangle in the middle as every place of a detector would see it, `oversampling` places a pixel."""
        fine = self.oversampling
        at = (np.arange(self.side_px * fine) - self.side_px * fine // 2) / fine
        u, v = np.meshgrid(at, at)
        ahead, height = DIRECTIONS[orientation], size_px * 3**0.25
        along, across = u * ahead[0] + v * ahead[1], np.abs(u * ahead[1] - v * ahead[0])
        # The base is height / 3 behind the centroid. Edges are as soft as a place is wide.
        base = np.clip((along + height / 3.0) * fine + 0.5, 0.0, 1.0)
        legs = (height * 2.0 / 3.0 - along) / 2.0 - across * math.sqrt(3.0) / 2.0
        triangle = base * np.clip(legs * fine + 0.5, 0.0, 1.0)
        f = np.fft.fftfreq(len(at), 1.0 / fine)  # cycles for each pixel
        share = np.hypot(f[:, None], f) * self.wavelength_um * self.f_number / self.pitch_um
        share = np.minimum(share, 1.0)
        lens = 2.0 / math.pi * (np.arccos(share) - share * np.sqrt(1.0 - share**2))
        return np.fft.ifft2(np.fft.fft2(triangle) * lens * np.sinc(f)[:, None] * np.sinc(f)).real

    def film(
        self,
        folder: Path,
        levels_k: Mapping[float, Sequence[float]],
        *,
        repeats: int,
        frames: int = 6,
        frames_per_second: int = 60,
        seed: int = 1,
    ) -> None:
        """Film triangles by their sizes in mrad, each at a place of its own: film.mkv and schedule.csv."""
        rng, fine, shown, rows = np.random.default_rng(seed), self.oversampling, [], []
        for size_mrad, levels in levels_k.items():
            for orientation in DIRECTIONS:
                image = self.image(size_mrad / self.ifov_mrad, orientation)
                for level in [*levels] * repeats:
                    right, down = rng.integers(0, fine, 2)
                    signal = level / self.netd_k * self.noise_dn * image[down::fine, right::fine]
                    begin = max(len(shown) - 0.1, 0.0) / frames_per_second
                    for _ in range(frames):
                        values = self.background_dn + signal + self.noise_dn * rng.standard_normal(signal.shape)
                        # A file of 16 bits holds the 14 of the camera.
                        shown.append(np.clip(np.rint(values), 0, 2**14 - 1).astype(np.uint16))
                    end = (len(shown) - 0.1) / frames_per_second
                    x, y = self.side_px / 2 - right / fine, self.side_px / 2 - down / fine
                    rows.append(f"{begin:.5f},{end:.5f},{orientation},{size_mrad},{level},{x:.4f},{y:.4f}")
        write_video(folder / "film.mkv", shown, frames_per_second=frames_per_second)
        header = "start_s,end_s,orientation,size_mrad,delta_t_k,x_px,y_px"
        (folder / "schedule.csv").write_text("\n".join([header, *rows, ""]), encoding="utf-8")


@lru_cache(maxsize=1)  # all pages of a film are seen alike
def _behind_the_lens(
    camera: Camera, to_fine: tuple[float, ...], whole: tuple[float, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places on the page, x and y in its halves of pixels, that samples of the camera's fine grid see."""
    assert camera.bending is not None
    fine, shift = camera.oversampling, np.reshape(to_fine, (3, 3))[:2, 2]
    y, x = np.mgrid[: camera.height * fine, : camera.width * fine].astype(float)
    pixels = (np.stack([x, y], axis=-1) - shift) / fine
    straight = camera.bending.straightened(pixels) * fine + shift
    back = np.linalg.inv(np.reshape(whole, (3, 3)))
    on_page = straight @ back[:, :2].T + back[:, 2]
    behind = on_page[..., 2] <= 0
    places = np.where(behind[..., None], -1e4, on_page[..., :2] / on_page[..., 2:]).astype(np.float32)
    return places[..., 0], places[..., 1]


def film(
    chart: Chart,
    camera: Camera,
    matrix: Image,
    *,
    frames_per_page: int,
    seed: int = 1,
    shake_px: float = 0.0,
    pages: Sequence[int] | None = None,
) -> list[tuple[int, tuple[float, float], NDArray]]:
    """Frames of all pages one after the other, each with its page and the shift (x, y) of the hand in pixels."""
    rng = np.random.default_rng(seed)
    frames = []
    for page in range(len(chart)) if pages is None else pages:
        light = chart.light(page)
        still = None if shake_px else camera.image(light, matrix)
        for _ in range(frames_per_page):
            shift = tuple(rng.uniform(-shake_px, shake_px, 2)) if shake_px else (0.0, 0.0)
            moved = np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1.0]]) @ matrix
            image = camera.image(light, moved) if still is None else still
            frames.append((page, shift, camera.expose(image, rng)))
    return frames


def write_video(
    path: Path,
    frames: Iterable[NDArray],
    *,
    codec: str = "ffv1",
    frames_per_second: int = 25,
    times: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
) -> None:
    """Write frames as a video: grey of 8 or 16 bits with FFV1, 4:2:0 of 8 bits with H.264.

    `times` are those of the frames in units of 1 / `frames_per_second`; by default one after the other.
    """
    import av

    with av.open(str(path), "w") as container:
        stream = None
        for number, frame in enumerate(frames):
            grey = "gray16le" if frame.dtype == np.uint16 else "gray"
            kind = "rgb24" if frame.ndim == 3 else grey
            if stream is None:
                stream = container.add_stream(codec, rate=frames_per_second, options=options or {})
                stream.height, stream.width = frame.shape[:2]
                stream.pix_fmt = "yuv420p" if codec == "libx264" else ("bgr0" if kind == "rgb24" else kind)
                stream.time_base = stream.codec_context.time_base = Fraction(1, frames_per_second)
            picture = av.VideoFrame.from_ndarray(frame, format=kind)
            picture.pts = number if times is None else times[number]
            picture.time_base = Fraction(1, frames_per_second)
            container.mux(stream.encode(picture))
        assert stream is not None
        container.mux(stream.encode())


def write_tiffs(folder: Path, frames: Iterable[NDArray]) -> None:
    """Write frames as a sequence of TIFF files."""
    folder.mkdir()
    for number, frame in enumerate(frames):
        pixels = frame if frame.ndim == 2 else frame[..., ::-1]
        assert cv2.imwrite(str(folder / f"{number:05d}.tif"), pixels)
