"""MTF of one slanted edge in an array (e-SFR), with its 95 % band.

The edge-based spatial frequency response of ISO 12233:2023, at any angle and along a curve: the distances of the
pixels from the edge are sorted into bins, whose means are a finely sampled edge profile. Its differences have the
MTF as their Fourier transform, after correction for the width of bins and differences.

- Bins grow with the distance from the edge and reach to the ends of the box, so the halo of a lens counts; what is
  farther does not.
- The transform is a linear function of the means. Their covariance is that of the wild bootstrap over blocks of
  rows (Cameron et al. 2008, Rev. Econ. Stat. 90): the mean over all signs of the blocks' residuals is a sum of
  products, so that nothing is drawn.
- The square of a noisy transform's modulus is too large by the variance at right angles to it, which is taken off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from todframes.base._typing import ComplexArray, FloatArray, Json
from todframes.base.errors import DataError, SettingsError
from todframes.camera.mtf_table import EdgeRecord, crossing_frequency, with_ends
from todframes.parameters import Box
from todframes.psychometrics.bootstrap import NORMAL_95

FREQUENCY_CYC_PER_PIXEL: FloatArray = np.arange(65) / 64.0
"""Frequencies of an MTF: up to twice the Nyquist frequency, with the steps that files of MTF Mapper have."""

NYQUIST = 32
"""Index of half a cycle/pixel, the Nyquist frequency of the pixels."""

LEAST_SIDE_PX = 20
"""Least width and height of a box."""

LEAST_BESIDE_PX, MOST_BESIDE_PX = 10.0, 48.0
"""Least distance of pixels on both sides of an edge, and the largest that is used: farther out there is more
change of light, and no more precision."""

LEVEL_FROM, SHADING_FROM = 0.75, 0.4
"""Parts of the distance of the farthest pixels from which on they show the dark and the bright level, and the
change of light on either side."""

BIN_PX = 0.1
"""Width of the bins at the edge. Where the distances of the pixels lie on a coarser lattice, some are empty."""

WIDEST_GAP_PX = 0.46
"""Largest distance between neighbouring bins at an edge, and of bins that count as samples; wider ones are joined
by straight lines. It is 1 for an upright edge, 0.71 at 45° and 0.45 at a slope of 1/2. What is beyond 1.5
cycles/pixel comes back below the Nyquist frequency."""

QUARTILE = 0.6745
"""Upper quartile of a Gaussian."""

SYSTEMATIC = 0.008
"""Error of an MTF without noise, mostly by the halo beyond the box: 0.006 for a diffraction limit of 0.6
cycles/pixel. It is added in squares, and with 0.006 the band of such a lens held it in 88 % at low frequencies."""

DEGREE = 3
"""Degree of the polynomial that the edge may follow: lenses bend it by a parabola, and more at one end."""

LEAST_STEP = 5.0
"""Least contrast of an edge in units of the noise of a pixel."""

BLOCK_ROWS = 8
"""Length of the blocks of rows along the edge, in pixels: pixels farther apart share little noise."""

ROUGHEST_PX = 0.15
"""Largest standard deviation of the edge from its curve. It lowers the MTF at the Nyquist frequency by 10 %."""

MOST_ROUGH = 2.0
"""Largest mean square of displacements of an edge, in that of noise."""

N_STEPS = 4
"""Number of steps of the edge's curve, after which it is at rest."""

LARGEST_ERROR = 0.25
"""Largest half-width of the interval of MTF50, relative to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeMtf:
    """The MTF across one edge at `FREQUENCY_CYC_PER_PIXEL`, and the edge.

    `curves` are the MTF and the ends of its 95 % band, point by point: shape (3, 65). In the fitted profile, shape
    (n,), 0 is the dark level and 1 the bright one. The record has the number 1 and no colour.
    """

    curves: FloatArray
    record: EdgeRecord
    distance_px: FloatArray
    profile: FloatArray

    @property
    def mtf(self) -> FloatArray:
        """The MTF, shape (65,)."""
        return np.asarray(self.curves[0])

    @property
    def box(self) -> Box:
        """Left column, top row, width and height of the box about the edge."""
        return self.record.x_px, self.record.y_px, self.record.width_px, self.record.height_px


def mean_curves(curves: Sequence[FloatArray]) -> FloatArray:
    """Return the mean of MTFs with their bands, and the band that follows if their noise is independent."""
    mean = np.mean(curves, 0)[0]
    down, up = np.sqrt(np.sum([(mtf[1:] - mtf[0]) ** 2 for mtf in curves], 0)) / len(curves)
    return np.stack([mean, np.maximum(mean - down, 0.0), mean + up])


def measure_edge(
    image: FloatArray, box: Box, *, step_px: float = 0.0, saturated: NDArray[np.bool_] | None = None
) -> EdgeMtf:
    """Measure the MTF across the one edge in a box: left column, top row, width and height.

    The values of the image are proportional to light; `saturated` says whether a pixel was at an end of its scale.
    If the edge is a stair of a monitor's pixels, with steps of this width along the normal, their MTF is divided
    out: averaged along the edge, a regular stair is a straight edge whose light is spread evenly over one step.
    SettingsError if the box is not in the image or smaller than `LEAST_SIDE_PX`; DataError if there is no edge, it
    is saturated, too upright for a finely sampled profile or not smooth, or noise leaves MTF50 uncertain by more
    than a quarter.
    """
    left, top, width, height = box
    rows, columns = image.shape
    where = f"box {left},{top},{width},{height}: "
    if min(width, height) < LEAST_SIDE_PX or min(left, top) < 0 or left + width > columns or top + height > rows:
        raise SettingsError(
            f"{where}expected x, y, width, height of at least {LEAST_SIDE_PX} x {LEAST_SIDE_PX} pixels within the "
            f"frame of {columns} x {rows}"
        )
    values = image[top : top + height, left : left + width].astype(np.float64)
    if saturated is not None:
        share = float(saturated[top : top + height, left : left + width].mean())
        if share > 0.01:
            raise DataError(
                f"{where}{100 * share:.0f} % of the pixels are at an end of the scale: the edge is saturated and "
                "its MTF is lost; change exposure or gain"
            )
    edge = _fitted(values, _fitted_curve(values, where), box, step_px, where)
    mtf50, ends = edge.record.mtf50_cyc_per_pixel, edge.record.mtf50_cyc_per_pixel_ci95
    if mtf50 is not None and ends is not None:
        low, high = ends
        if low is None or high is None or high - low > 2 * LARGEST_ERROR * mtf50:
            shown = f"{low or 0:.2g} to {'above 1' if high is None else f'{high:.2g}'}"
            raise DataError(
                f"{where}noise of {edge.record.noise_percent:.1f} % of the contrast leaves MTF50 at {shown} "
                "cycles/pixel, expected an interval within a quarter of it; average frames, or use a longer edge"
            )
    return edge


class _Curve(NamedTuple):
    """A smooth line in an image: a point, the unit normal from dark to bright, and a polynomial.

    In coordinates t along the normal and s across it, from the point, the edge is t = polynomial(s); its first two
    coefficients are 0.
    """

    x: float
    y: float
    normal: tuple[float, float]
    polynomial: FloatArray

    @property
    def normal_deg(self) -> float:
        """Direction of the normal: 0 is right, 90 is down."""
        return math.degrees(math.atan2(self.normal[1], self.normal[0]))

    @property
    def angle_deg(self) -> float:
        """Angle against rows or columns of pixels, whichever is nearer: 0 to 45."""
        return abs((self.normal_deg + 45.0) % 90.0 - 45.0)

    def distance(self, x: NDArray[Any], y: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return the distance of points from the edge along its normal, and s.

        The distance is right to first order in the slope of the polynomial squared, which is below 0.01.
        """
        (nx, ny), dx, dy = self.normal, x - self.x, y - self.y
        t, s = dx * nx + dy * ny, dy * nx - dx * ny
        slope = polyval(s, polyder(self.polynomial))
        return (t - polyval(s, self.polynomial)) / np.sqrt(1.0 + slope**2), s

    def moved(self, change: FloatArray) -> _Curve:
        """Return the curve with a polynomial added, in a frame that is turned and moved with it."""
        total = self.polynomial + change
        (nx, ny), turn = self.normal, math.atan(total[1])
        normal = (nx * math.cos(turn) + ny * math.sin(turn), ny * math.cos(turn) - nx * math.sin(turn))
        total[:2], shift = 0.0, float(total[0])
        return _Curve(self.x + nx * shift, self.y + ny * shift, normal, total)


def _fitted_curve(values: FloatArray, where: str) -> _Curve:
    """Return a first curve: an orthogonal fit to the pixels, weighted with the slope of the smoothed image."""
    from scipy.ndimage import gaussian_filter

    smooth_px = 1.5  # a gradient's noise is then 3 % of that of pixels
    gx, gy = (gaussian_filter(values, smooth_px, order=order, mode="nearest") for order in ((0, 1), (1, 0)))
    squares = gx**2 + gy**2
    if not squares.max() > 0.0:
        raise DataError(f"{where}found no edge: all values are the same")
    y, x = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in values.shape), indexing="ij")
    # The direction of the steepest slopes: the principal axis of the structure tensor.
    jxx, jyy, jxy = (float((squares * left * right).sum()) for left, right in ((gx, gx), (gy, gy), (gx, gy)))
    angle = 0.5 * math.atan2(2 * jxy, jxx - jyy)
    normal = (math.cos(angle), math.sin(angle))
    if float((squares * (gx * normal[0] + gy * normal[1])).sum()) < 0.0:
        normal = (-normal[0], -normal[1])
    weight = squares**2
    start = (float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum()))
    curve = _Curve(*start, normal, np.zeros(DEGREE + 1))
    reach_px = max(values.shape) / 3.0
    for n_done in range(12):
        distance, s = curve.distance(x, y)
        rising = np.maximum(gx * curve.normal[0] + gy * curve.normal[1], 0.0)
        weight = rising**2 * np.exp(-0.5 * (distance / reach_px) ** 2)
        if not weight.sum() > 0.0:
            raise DataError(f"{where}found no edge that follows a smooth curve, expected one that is straight")
        spread_px = math.sqrt(float((weight * distance**2).sum() / weight.sum()))
        reach_px = max(min(0.7 * reach_px, 3.0 * spread_px), 2.0)
        used = weight > 1e-4 * weight.max()
        degree = 1 if n_done < 3 else DEGREE
        length = float(np.abs(s).max())
        powers = (s[used, np.newaxis] / length) ** np.arange(degree + 1)
        root = np.sqrt(weight[used])
        change = np.zeros(DEGREE + 1)
        solved = np.linalg.lstsq(powers * root[:, np.newaxis], distance[used] * root, rcond=None)[0]
        change[: degree + 1] = solved / length ** np.arange(degree + 1)
        curve = curve.moved(change)
    return curve


class _Esf(NamedTuple):
    """Pixels sorted by their distance from the edge, and their means in bins.

    Of each pixel that is used: its coordinates, its bin, and what is left of its value without the bin's mean and
    slope, shape (n_pixels,). Of each bin: mean distance and value, number of pixels and slope of the profile,
    shape (n_bins,). `levels` are the weights of the means in the dark level, the contrast, and the changes
    of light on the dark and the bright side, (4, n_bins), and `reach_px` is the distance at which they begin.
    """

    distance: FloatArray
    along: FloatArray
    residual: FloatArray
    bins: NDArray[np.intp]
    nodes: FloatArray
    means: FloatArray
    counts: FloatArray
    slopes: FloatArray
    levels: FloatArray
    reach_px: float

    @property
    def rise(self) -> FloatArray:
        """The means from 0 at the dark to 1 at the bright level."""
        dark, contrast = self.levels[:2] @ self.means
        return np.asarray(np.clip((self.means - dark) / contrast, 0.0, 1.0))

    def covariance(self) -> FloatArray:
        """Return the covariance of the means, from the sums of residuals in overlapping blocks of rows.

        It is scaled so that the quantiles of a Gaussian give those of Student's t for the number of blocks.
        """
        from scipy.special import stdtrit

        rows = np.floor(self.along - self.along.min()).astype(np.intp)
        n_rows, n_bins = int(rows.max()) + 1, len(self.nodes)
        sums = np.bincount(rows * n_bins + self.bins, (self.residual / self.counts[self.bins]), n_rows * n_bins)
        total = np.cumsum(np.pad(sums.reshape(n_rows, n_bins), ((BLOCK_ROWS, BLOCK_ROWS - 1), (0, 0))), 0)
        blocks = total[BLOCK_ROWS:] - total[:-BLOCK_ROWS]
        # The means leave less in a block, and overlapping blocks are worth 1.5 times as many that do not overlap.
        n_blocks = n_rows / BLOCK_ROWS
        scale = n_blocks / (n_blocks - 1.0) * (float(stdtrit(1.5 * n_blocks, 0.975)) / NORMAL_95) ** 2
        return np.asarray(scale / BLOCK_ROWS * (blocks.T @ blocks))


def _levels(nodes: FloatArray, counts: NDArray[Any], reach_px: float, terms: Sequence[int]) -> FloatArray:
    """Return how terms of a profile follow from its means beyond a distance, (5, n_bins).

    They are the dark level, the contrast, a change of light on the dark and on the bright side, and a halo.
    """
    far = np.abs(nodes) > reach_px
    d, root = nodes[far], np.sqrt(counts[far])
    functions = np.array([np.ones_like(d), d > 0.0, np.minimum(d, 0.0), np.maximum(d, 0.0), -1.0 / d])[[*terms]]
    levels = np.zeros((5, len(nodes)))
    levels[np.ix_(np.array(terms), far)] = np.linalg.pinv((functions * root).T) * root
    return levels


def _is_shaded(esf: _Esf, farthest_px: float) -> bool:
    """Return whether light changes across a side by 1 % and 1.5 errors more than a halo explains."""
    covariance = esf.covariance()
    for side in (2, 3):
        levels = _levels(esf.nodes, esf.counts, SHADING_FROM * farthest_px, (0, 1, 4, side))
        size, error = abs(float(levels[side] @ esf.means)), math.sqrt(levels[side] @ covariance @ levels[side])
        if (size - 1.5 * error) * farthest_px > 0.01 * (levels[1] @ esf.means):
            return True
    return False


def _binned(
    distance: FloatArray, along: FloatArray, values: FloatArray, farthest_px: float, *, is_shaded: bool
) -> _Esf:
    """Return the means of values in bins of their distance; empty bins are left out."""
    ends = [0.0]
    while ends[-1] < farthest_px:
        ends.append(ends[-1] + max(BIN_PX, (ends[-1] - 2.0) / 6.0))
    half = np.array(ends[1:])
    limits = np.concatenate([-half[::-1], [0.0], half])
    _, bins, counts = np.unique(np.digitize(distance, limits), return_inverse=True, return_counts=True)
    nodes, means = (np.bincount(bins, quantity) / counts for quantity in (distance, values))
    slopes = np.gradient(means, nodes)
    residual = values - means[bins] - slopes[bins] * (distance - nodes[bins])
    reach_px = (SHADING_FROM if is_shaded else LEVEL_FROM) * farthest_px
    levels = _levels(nodes, counts, reach_px, (0, 1, 2, 3) if is_shaded else (0, 1))[:4]
    count = counts.astype(np.float64)
    return _Esf(distance, along, residual, bins, nodes, means, count, slopes, levels, reach_px)


def _fitted(values: FloatArray, curve: _Curve, box: Box, step_px: float, where: str) -> EdgeMtf:
    """Fit curve and profile in turn, then transform the profile."""
    y, x = (indices.ravel() for indices in np.indices(values.shape, np.float64))
    distance, s = curve.distance(x, y)
    # The farthest pixels, as many as the edge has along it, lie in corners of the box.
    n_left_out = min(int(np.ptp(s)), len(s) // 4)
    ordered = np.sort(distance)
    farthest_px = min(MOST_BESIDE_PX, float(ordered[-1 - n_left_out]), float(-ordered[n_left_out]))
    if farthest_px < LEAST_BESIDE_PX:
        raise DataError(
            f"{where}found an edge with {max(farthest_px, 0.0):.1f} pixels beside it, expected at least "
            f"{LEAST_BESIDE_PX:.0f} on both sides"
        )
    without_light, is_alive, is_shaded = values.ravel().copy(), np.ones(values.size, bool), False

    def profile() -> _Esf:
        distance, s = curve.distance(x, y)
        used = (np.abs(distance) <= farthest_px) & is_alive
        esf = _binned(distance[used], s[used], without_light[used], farthest_px, is_shaded=is_shaded)
        gap_px = float(np.diff(esf.nodes[np.abs(esf.nodes) < 2.0], prepend=-2.0, append=2.0).max())
        if gap_px > WIDEST_GAP_PX:
            raise DataError(
                f"{where}found an edge {curve.angle_deg:.2f}° from rows or columns, whose pixels leave a gap of "
                f"{gap_px:.3g} pixels in its profile, expected at most {WIDEST_GAP_PX}; turn target or camera by "
                "2° to 10°, or use a longer edge"
            )
        contrast, noise_sd = float(esf.levels[1] @ esf.means), float(esf.residual.std())
        if not contrast > LEAST_STEP * noise_sd:
            raise DataError(
                f"{where}found no edge: along a smooth curve the steepest step is {max(contrast, 0.0):.3g} "
                f"against noise of {noise_sd:.3g}, expected at least {LEAST_STEP:g} times the noise; is it "
                "straight and alone in the box?"
            )
        return esf

    for _ in range(N_STEPS):
        esf = profile()
        # A Gauss-Newton step of the curve, and of light that changes along either side of the edge.
        length, powers = float(np.abs(esf.along).max()), np.arange(1, DEGREE + 1)
        along, bright = esf.along / length, esf.rise[esf.bins]
        columns = -esf.slopes[esf.bins, np.newaxis] * along[:, np.newaxis] ** powers
        sides = np.column_stack([along * bright, along * (1.0 - bright)])
        step = np.linalg.lstsq(np.column_stack([columns, sides]), esf.residual, rcond=None)[0]
        distance, s = curve.distance(x, y)
        rise = np.interp(distance, esf.nodes, esf.rise)
        without_light -= s / length * (step[DEGREE] * rise + step[DEGREE + 1] * (1.0 - rise))
        residual = np.abs(without_light - np.interp(distance, esf.nodes, esf.means)).reshape(values.shape)
        is_alive = ~_dead(residual, float(esf.levels[1] @ esf.means)).ravel()
        curve = curve.moved(np.concatenate([[0.0], step[:DEGREE] / length**powers]))
    is_shaded = _is_shaded(esf, farthest_px)
    esf = profile()
    _check_smooth(esf, where)
    return _edge_mtf(esf, curve, box, step_px)


def _dead(residual: FloatArray, contrast: float) -> NDArray[np.bool_]:
    """Return which pixels are far from the profile while all that surround them are not."""
    from scipy.ndimage import maximum_filter

    noise_sd = float(np.median(residual)) / QUARTILE
    others = maximum_filter(residual, footprint=[[1, 1, 1], [1, 0, 1], [1, 1, 1]], mode="constant")
    return np.asarray((residual > max(8.0 * noise_sd, 0.05 * contrast)) & (residual > 3.0 * others))


def _check_smooth(esf: _Esf, where: str) -> None:
    """Raise DataError if rows of the edge are displaced from the curve by far more than noise would displace them.

    The same filter beside the edge shows what noise does, also noise that neighbouring pixels share.
    """
    quarters = np.interp([0.25, 0.75], np.maximum.accumulate(esf.rise), esf.nodes)
    sigma_px = max(float(np.ptp(quarters)) / (2 * QUARTILE), 0.4)
    height = float(esf.levels[1] @ esf.means) / (sigma_px * math.sqrt(math.tau))
    row = np.floor(esf.along - esf.along.min()).astype(np.intp)

    def displacement(position_px: float) -> float:
        """Return the mean square of those that residuals at a distance show, less the polynomial of the curve."""
        slope = height * np.exp(-0.5 * ((esf.distance - position_px) / sigma_px) ** 2)
        power = np.bincount(row, slope**2)
        seen = np.flatnonzero(power > 0.5 * np.median(power))  # rows at the ends have few pixels
        shift = np.bincount(row, slope * esf.residual)[seen] / power[seen]
        shift -= np.polyval(np.polyfit(seen, shift, DEGREE), seen)
        return float(shift @ shift) / max(len(seen) - DEGREE - 1, 1)

    noise = 0.5 * (displacement(-esf.reach_px) + displacement(esf.reach_px))
    on_edge = displacement(0.0)
    if on_edge > max(noise + ROUGHEST_PX**2, MOST_ROUGH * noise):
        raise DataError(
            f"{where}found an edge that departs from a smooth curve by {math.sqrt(on_edge - noise):.2f} pixels, "
            f"expected at most {ROUGHEST_PX}; is it straight and smooth, and alone in the box?"
        )


def _transform(distance_px: FloatArray, values: FloatArray, off_px: FloatArray) -> ComplexArray:
    """Return how the Fourier transform of the profile's slope follows from the means, (n_frequencies, n_bins).

    Differences of samples a width w apart have sinc(f w) times the transform of the slope. Farther out the profile
    is straight between two bins. The means at the edge are those of a profile blurred by the distances in a bin.
    """
    frequency = FREQUENCY_CYC_PER_PIXEL
    width, middle = np.diff(distance_px), (distance_px[1:] + distance_px[:-1]) / 2.0
    of_width = np.sinc(np.outer(frequency, width))
    waves = np.exp(-2j * np.pi * np.outer(frequency, middle))
    waves *= np.where(width < WIDEST_GAP_PX, 1.0 / np.maximum(of_width, 0.1), of_width)
    of_bins = np.cos(2 * np.pi * np.outer(frequency, off_px)).mean(1)
    return np.asarray(waves @ np.diff(values, axis=0) / of_bins[:, np.newaxis], np.complex128)


def _edge_mtf(esf: _Esf, curve: _Curve, box: Box, step_px: float) -> EdgeMtf:
    """Return MTF, band and overshoot of a fitted edge."""
    from scipy.interpolate import make_interp_spline

    means, covariance = esf.means, esf.covariance()
    dark, contrast = (esf.levels[:2] @ means).tolist()
    inner, at_edge = np.abs(esf.nodes) < esf.reach_px, np.abs(esf.distance) < 2.0
    distance_px = np.concatenate([[-esf.reach_px], esf.nodes[inner], [esf.reach_px]])
    rise = esf.rise[inner, np.newaxis]
    shading = esf.nodes[inner, np.newaxis] * ((1.0 - rise) * esf.levels[2] + rise * esf.levels[3])
    values = np.vstack([esf.levels[0], np.eye(len(means))[inner] - shading, esf.levels[:2].sum(0)])
    off_px = (esf.distance - esf.nodes[esf.bins])[at_edge]
    transform = _transform(distance_px, values, off_px) / contrast
    transform /= np.sinc(step_px * FREQUENCY_CYC_PER_PIXEL)[:, np.newaxis]
    ratio = transform @ means
    # Derivatives of the ratio, turned so that the real part is along it.
    derivative = transform - np.outer(ratio, esf.levels[1] / contrast)
    derivative *= np.exp(-1j * np.angle(ratio))[:, np.newaxis]

    def error(derivatives: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", derivatives, covariance, derivatives), 0.0)))

    mtf = np.sqrt(np.maximum(np.abs(ratio) ** 2 - error(derivative.imag) ** 2, 0.0))
    half = np.hypot(NORMAL_95 * error(derivative.real), SYSTEMATIC * (FREQUENCY_CYC_PER_PIXEL > 0.0))
    # How far means over a pixel go beyond both levels.
    n_in_pixel = 20
    end = math.floor(esf.reach_px * n_in_pixel)
    grid = np.arange(-end, end + 1) / n_in_pixel
    sums = np.cumsum(make_interp_spline(distance_px, values - esf.levels[0], k=1)(grid) / contrast, 0)
    in_pixels = (sums[n_in_pixel:] - sums[:-n_in_pixel]) / n_in_pixel
    level = in_pixels @ means

    def beyond(name: str, k: int, height: float, sign: float) -> Json:
        value = max(sign * (float(level[k]) - height), 0.0)
        reach = NORMAL_95 * float(error(in_pixels[k : k + 1] - level[k] * esf.levels[1] / contrast)[0])
        return {name: value, f"{name}_ci95": (max(value - reach, 0.0), value + reach)}

    visible = esf.along[np.abs(esf.distance) < 1.0]
    ends = np.linspace(visible.min(), visible.max(), 101)
    line = polyval(ends, curve.polynomial)
    curves = np.stack([mtf, np.maximum(mtf - half, 0.0), np.abs(ratio) + half])
    mtf50 = [crossing_frequency(0.5, FREQUENCY_CYC_PER_PIXEL, values) for values in curves]
    left, top, width, height = box
    record = EdgeRecord(
        edge=1,
        x_px=left,
        y_px=top,
        width_px=width,
        height_px=height,
        angle_deg=curve.angle_deg,
        normal_deg=curve.normal_deg,
        bend_px=float(np.ptp(line - np.polyval(np.polyfit(ends, line, 1), ends))),
        dark=dark,
        bright=dark + contrast,
        noise_percent=100.0 * float(esf.residual.std()) / contrast,
        **with_ends("mtf50_cyc_per_pixel", [] if mtf50[0] is None else mtf50),
        **with_ends("mtf_at_nyquist", curves[:, NYQUIST].tolist()),
        **beyond("overshoot", int(np.argmax(level)), 1.0, 1.0),
        **beyond("undershoot", int(np.argmin(level)), 0.0, -1.0),
    )
    return EdgeMtf(
        curves=curves,
        record=record,
        distance_px=distance_px,
        profile=(values @ means - dark) / contrast,
    )
