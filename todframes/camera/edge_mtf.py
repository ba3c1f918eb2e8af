"""MTF of one slanted edge in an array (e-SFR), with its 95 % band.

The edge-based spatial frequency response of ISO 12233:2023, at any angle and along a curve: the distances of the
pixels from the edge are sorted into bins, whose means are a finely sampled edge profile. Its differences have the
MTF as their Fourier transform, after correction for the width of bins and differences.

- Farther out bins grow with the distance, in place of the standard's window, so the halo of a lens counts. What is
  farther still is a level that is approached as 1 / distance: every aperture with a rim has such a tail, because
  its OTF has a kink at frequency 0 (for a circle: 1 - 4 f / (π f_c)).
- The transform is a linear function of the means. Their covariance is that of the wild bootstrap over blocks of
  rows (Cameron et al. 2008, Rev. Econ. Stat. 90): the mean over all signs of the blocks' residuals is a sum of
  products, so that nothing is drawn. Blocks are longer than the distance over which pixels share noise.
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
"""Least width and height of a box: the tail begins 6 pixels from the edge or farther, and needs pixels behind."""

BIN_PX = 0.25
"""Width of the bins at the edge, unless the distances of the pixels lie on a lattice."""

LATTICES_PX: FloatArray = np.sort(
    [1.0 / math.hypot(p, q) for p in range(9) for q in range(p, 9) if math.gcd(p, q) == 1 and math.hypot(p, q) < 9]
)[::-1]
"""Steps of the distances of pixels from an edge whose slope is p / q: 1 for an upright edge, 0.707 at 45°."""

TAIL_PX, FARTHEST_TAIL = 6.0, 0.6
"""Least distance at which the tail begins, and the largest relative to the distance of the farthest pixels."""

QUARTILE = 0.6745
"""Upper quartile of a Gaussian."""

WIDEST_GAP_PX = 0.1
"""Largest distance between neighbouring pixels of a profile that has bins of `BIN_PX` where pixels are sparse."""

WIDEST_BIN_PX = 0.75
"""Largest width of the bins at the edge: 0.71 at 45° exactly, and 1 for an upright edge."""

LARGEST_ALIAS = 0.02
"""Largest error of an MTF up to the Nyquist frequency by coarse steps of the profile that gives no warning."""

SYSTEMATIC = 0.004
"""Error of an MTF from the Nyquist frequency on, without noise, as the bias of exact edges: 0 at frequency 0."""

DEGREE = 3
"""Degree of the polynomial that the edge may follow: lenses bend it by a parabola, and more at one end."""

LEAST_LATTICE = 0.1
"""Least amplitude of the wave of a lattice in the distances of pixels: they leave a tenth of its steps free."""

LEAST_STEP = 5.0
"""Least contrast of an edge in units of the noise of a pixel."""

BLOCK_ROWS = 8
"""Length of the blocks of rows along the edge, in pixels: pixels farther apart share little noise."""

ROUGHEST_PX = 0.15
"""Largest standard deviation of the edge from its curve. It lowers the MTF at the Nyquist frequency by 10 %."""

LARGEST_ERROR = 0.25
"""Largest half-width of the interval of MTF50, relative to it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeMtf:
    """The MTF across one edge at `FREQUENCY_CYC_PER_PIXEL`, and the edge.

    `curves` are the MTF and the ends of its 95 % band, point by point: shape (3, 65). `centre_px` is a point of
    the edge, (x, y); (0, 0) is the centre of the frame's first pixel. In the fitted profile, shape (n,), 0 is the
    dark level and 1 the bright one. The record has the number 1 and no colour. `alias` is the largest error up to
    the Nyquist frequency by gaps between the distances of pixels.
    """

    curves: FloatArray
    record: EdgeRecord
    box: Box
    centre_px: tuple[float, float]
    alias: float
    distance_px: FloatArray
    profile: FloatArray

    @property
    def mtf(self) -> FloatArray:
        """The MTF, shape (65,)."""
        return np.asarray(self.curves[0])


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
            cause = f"noise of {edge.record.noise_percent:.1f} % of the contrast"
            remedy = "average frames, or use a longer edge"
            if edge.alias > LARGEST_ALIAS:
                cause = f"an edge {edge.record.angle_deg:.2f}° from rows or columns, sharper than its pixels show,"
                remedy = "turn target or camera by 2° to 10°"
            raise DataError(
                f"{where}{cause} leaves MTF50 at {shown} cycles/pixel, expected an interval within a quarter of "
                f"it; {remedy}"
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
    shape (n_bins,). `off_px` are the distances of pixels at the edge from the mean distance in their bin, and
    `bin_px` is the width of the bins there.
    """

    distance: FloatArray
    along: FloatArray
    residual: FloatArray
    bins: NDArray[np.intp]
    nodes: FloatArray
    means: FloatArray
    counts: FloatArray
    slopes: FloatArray
    off_px: FloatArray
    bin_px: float

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


def _bins_px(near: FloatArray) -> tuple[float, float]:
    """Return the width of the bins at the edge, and where one begins, by the distances of the pixels there.

    If they lie on a lattice, a bin has the same part of it as every other bin.
    """
    waves = np.exp(2j * np.pi * near / LATTICES_PX[:, np.newaxis]).mean(1)
    k = int(np.argmax(np.abs(waves)))
    step_px = float(LATTICES_PX[k])
    if np.abs(waves[k]) < LEAST_LATTICE or (_gap_px(near) < WIDEST_GAP_PX and step_px > 1.5 * BIN_PX):
        return BIN_PX, 0.0
    return step_px * max(round(BIN_PX / step_px), 1), step_px * (0.5 + float(np.angle(waves[k])) / math.tau)


def _gap_px(near: FloatArray) -> float:
    """Return the largest distance between neighbours, infinite for fewer than two."""
    return float(np.diff(np.sort(near)).max()) if len(near) > 1 else math.inf


def _binned(distance: FloatArray, along: FloatArray, values: FloatArray, uniform_px: float) -> _Esf:
    """Return the means of values in bins of their distance; empty bins are left out."""
    bin_px, start_px = _bins_px(distance[np.abs(distance) < uniform_px])
    ends = [0.0]
    while ends[-1] < np.abs(distance).max() + bin_px:
        ends.append(ends[-1] + (bin_px if ends[-1] < uniform_px else max(bin_px, ends[-1] / 6.0)))
    half = np.array(ends[1:])
    limits = start_px + np.concatenate([-half[::-1], [0.0], half])
    _, bins, counts = np.unique(np.digitize(distance, limits), return_inverse=True, return_counts=True)
    nodes, means = (np.bincount(bins, quantity) / counts for quantity in (distance, values))
    slopes = np.zeros(len(nodes))
    slopes[1:-1] = (means[2:] - means[:-2]) / (nodes[2:] - nodes[:-2])
    off = distance - nodes[bins]
    at_edge = off[np.abs(distance) < uniform_px]
    residual = values - means[bins] - slopes[bins] * off
    return _Esf(distance, along, residual, bins, nodes, means, counts.astype(np.float64), slopes, at_edge, bin_px)


DARK, CONTRAST, TAIL, DARK_SIDE, BRIGHT_SIDE = range(5)
"""Terms of the profile far from the edge: its dark level, its contrast, the tail, and the changes of light."""


def _levels(esf: _Esf, tail_px: float, terms: Sequence[int]) -> FloatArray:
    """Return how the terms of the profile follow from the means beyond a distance, (5, n_bins)."""
    far = np.abs(esf.nodes) >= tail_px
    d, root = esf.nodes[far], np.sqrt(esf.counts[far])
    functions = np.array([np.ones_like(d), d > 0.0, -1.0 / d, np.minimum(d, 0.0), np.maximum(d, 0.0)])[[*terms]]
    levels = np.zeros((5, len(far)))
    levels[np.ix_(np.array(terms), far)] = np.linalg.pinv((functions * root).T) * root
    return levels


def _rise(esf: _Esf, levels: FloatArray) -> FloatArray:
    """Return the means from 0 at the dark to 1 at the bright level."""
    dark, contrast = levels[[DARK, CONTRAST]] @ esf.means
    return np.asarray(np.clip((esf.means - dark) / contrast, 0.0, 1.0))


PASSES = ("uniform bins", "dead pixels", "curve", "shading", "curve", "last")
"""Names of the passes of the fit, by what each of them decides after a step of the curve."""


def _fitted(values: FloatArray, curve: _Curve, box: Box, step_px: float, where: str) -> EdgeMtf:
    """Fit curve and profile in turn, then transform the profile."""
    y, x = (indices.ravel() for indices in np.indices(values.shape, np.float64))
    distance, s = curve.distance(x, y)
    # The farthest pixels, as many as the edge has along it, lie in corners of the box.
    n_left_out = min(int(np.ptp(s)), len(s) // 4)
    ordered = np.sort(distance)
    # Beyond 48 pixels there is more shading, and no more precision.
    widest_px = min(48.0, float(ordered[-1 - n_left_out]), float(-ordered[n_left_out]))
    farthest_px = FARTHEST_TAIL * widest_px
    if farthest_px < TAIL_PX:
        raise DataError(
            f"{where}found an edge with {max(widest_px, 0.0):.1f} pixels beside it, expected at least "
            f"{TAIL_PX / FARTHEST_TAIL:.0f} on both sides"
        )
    # First with bins of one width everywhere, as that of the profile is not known.
    tail_px = uniform_px = min(farthest_px, 1.5 * TAIL_PX)
    light, is_alive = np.zeros(values.size), np.ones(values.size, bool)
    terms: tuple[int, ...] = DARK, CONTRAST, TAIL
    for stage in PASSES:
        distance, s = curve.distance(x, y)
        used = (np.abs(distance) <= widest_px) & is_alive
        esf = _binned(distance[used], s[used], (values.ravel() - light)[used], uniform_px)
        _check_gaps(esf, uniform_px, curve, where)
        levels = _levels(esf, tail_px, terms)
        contrast, noise_sd = float(levels[CONTRAST] @ esf.means), float(esf.residual.std())
        if not contrast > LEAST_STEP * noise_sd:
            raise DataError(
                f"{where}found no edge: along a smooth curve the steepest step is {max(contrast, 0.0):.3g} "
                f"against noise of {noise_sd:.3g}, expected at least {LEAST_STEP:g} times the noise; is it "
                "straight and alone in the box?"
            )
        rise = _rise(esf, levels)
        if stage == "last":
            break
        # A Gauss-Newton step of the curve, and of light that changes along either side of the edge.
        length, powers = float(np.abs(esf.along).max()), np.arange(1, DEGREE + 1)
        s, bright = esf.along / length, rise[esf.bins]
        sides = np.column_stack([s * bright, s * (1.0 - bright)])
        columns = -esf.slopes[esf.bins, np.newaxis] * s[:, np.newaxis] ** powers
        step = np.linalg.lstsq(np.column_stack([columns, sides]), esf.residual, rcond=None)[0]
        curve = curve.moved(np.concatenate([[0.0], step[:DEGREE] / length**powers]))
        light[used] += sides @ step[DEGREE:]
        if stage != "uniform bins":
            high = esf.nodes[int(np.argmax(rise > 0.9))]
            low = esf.nodes[len(rise) - 1 - int(np.argmax(rise[::-1] < 0.1))]
            rise_px = float(high - low)
            # From the tail on a Gaussian is 0, and a diffraction-limited lens's profile 1 / distance to 3e-4.
            tail_px = min(max(TAIL_PX, 2.5 * rise_px), farthest_px)
            uniform_px = min(max(3.0, 1.2 * rise_px), tail_px)
        if stage == "dead pixels":
            is_alive = ~_dead(esf, used.reshape(values.shape), contrast)
        if stage == "shading" and _is_shaded(esf, tail_px, widest_px):
            terms = DARK, CONTRAST, DARK_SIDE, BRIGHT_SIDE
    _check_smooth(esf, rise, contrast, widest_px, where)
    return _edge_mtf(esf, levels, tail_px, uniform_px, curve, box, step_px)


def _check_gaps(esf: _Esf, uniform_px: float, curve: _Curve, where: str) -> None:
    """Raise DataError if pixels near the edge leave gaps between their distances."""
    if esf.bin_px > WIDEST_BIN_PX:
        gap_px = _gap_px(esf.distance[np.abs(esf.distance) <= uniform_px])
        raise DataError(
            f"{where}found an edge {curve.angle_deg:.2f}° from rows or columns, whose pixels leave a gap of "
            f"{gap_px:.3g} pixels in its profile, expected at most {WIDEST_GAP_PX}; turn target or camera by 2° "
            "to 10°, or use a longer edge"
        )


def _dead(esf: _Esf, used: NDArray[np.bool_], contrast: float) -> NDArray[np.bool_]:
    """Return which pixels are far from the profile while all that surround them are not."""
    from scipy.ndimage import maximum_filter

    residual = np.zeros(used.shape)
    residual[used] = np.abs(esf.residual)
    noise_sd = float(np.median(np.abs(esf.residual))) / QUARTILE
    others = maximum_filter(residual, footprint=[[1, 1, 1], [1, 0, 1], [1, 1, 1]], mode="constant")
    return np.asarray((residual > max(8.0 * noise_sd, 0.05 * contrast)) & (residual > 3.0 * others)).ravel()


def _is_shaded(esf: _Esf, tail_px: float, widest_px: float) -> bool:
    """Return whether light changes across one side of the edge by 1 % and 1.5 errors more than the tail explains.

    One edge cannot hold a tail and a change of light apart, so that a fit of both loses the levels.
    """
    covariance = esf.covariance()
    for term in (DARK_SIDE, BRIGHT_SIDE):
        levels = _levels(esf, tail_px, (DARK, CONTRAST, TAIL, term))
        size, error = abs(float(levels[term] @ esf.means)), math.sqrt(levels[term] @ covariance @ levels[term])
        if (size - 1.5 * error) * widest_px > 0.01 * (levels[CONTRAST] @ esf.means):
            return True
    return False


def _check_smooth(esf: _Esf, rise: FloatArray, contrast: float, widest_px: float, where: str) -> None:
    """Raise DataError if rows of the edge are displaced from the curve by more than noise would displace them.

    The same filter beside the edge shows what noise does, also noise that neighbouring pixels share.
    """
    quarters = np.interp([0.25, 0.75], np.maximum.accumulate(rise), esf.nodes)
    sigma_px = max(float(np.ptp(quarters)) / (2 * QUARTILE), 0.4)
    height = contrast / (sigma_px * math.sqrt(math.tau))
    row = np.floor(esf.along - esf.along.min()).astype(np.intp)

    def slope_at(position_px: float) -> tuple[FloatArray, FloatArray]:
        """Return the slope of an edge at a distance, and the sum of its squares in each row."""
        slope = height * np.exp(-0.5 * ((esf.distance - position_px) / sigma_px) ** 2)
        return slope, np.bincount(row, slope**2).astype(np.float64)

    least_power = 0.5 * float(np.median(slope_at(0.0)[1]))

    def displacements(position_px: float) -> FloatArray:
        """Return those that residuals at a distance show, less the polynomial that the curve may follow."""
        slope, power = slope_at(position_px)
        # Rows at the ends, and at corners of the box, have few pixels.
        seen = np.flatnonzero(power > least_power)
        if len(seen) < 2 * DEGREE + 2:
            return np.zeros(0)
        shift = np.bincount(row, slope * esf.residual)[seen] / power[seen]
        shift -= np.polyval(np.polyfit(seen, shift, DEGREE), seen)
        return np.asarray(shift / math.sqrt(1.0 - (DEGREE + 1) / len(seen)))

    farthest_px = max(widest_px - 2 * sigma_px, widest_px / 2)
    beside_px = np.append(np.arange(farthest_px - 4 * sigma_px, 4 * sigma_px, -4 * sigma_px), farthest_px)
    beside = [
        shift for position in beside_px for side in (1.0, -1.0) if len(shift := displacements(side * position))
    ]
    on_edge = displacements(0.0)
    noise = float(np.mean([shift @ shift / len(shift) for shift in beside]))
    # Rows that share noise are fewer: the variance of a mean of squares (Bartlett).
    shared = [
        np.mean([shift[lag:] @ shift[:-lag] / len(shift) for shift in beside if len(shift) > lag]) / noise
        for lag in range(1, min(2 * BLOCK_ROWS, len(on_edge) // 4))
    ]
    n_rows = len(on_edge) / (1.0 + 2.0 * float(np.sum(np.square(shared)))) if noise > 0.0 else math.inf
    excess = float(on_edge @ on_edge) / len(on_edge) - noise
    if excess > max(ROUGHEST_PX**2, 5.0 * math.sqrt(2.0 / n_rows) * noise):
        raise DataError(
            f"{where}found an edge that departs from a smooth curve by {math.sqrt(excess):.2f} pixels, expected "
            f"at most {ROUGHEST_PX}; is it straight and smooth, and alone in the box?"
        )


def _transform(
    distance_px: FloatArray, values: FloatArray, tail: FloatArray, uniform_px: float, off_px: FloatArray
) -> ComplexArray:
    """Return how the Fourier transform of the profile's slope follows from the means, (n_frequencies, n_bins).

    Differences of samples a width w apart have sinc(f w) times the transform of the slope. Farther out the profile
    is straight between two bins. The tail's slope, 1 / distance², is transformed by the sine integral.
    """
    from scipy.special import sici

    frequency = FREQUENCY_CYC_PER_PIXEL
    width, middle = np.diff(distance_px), (distance_px[1:] + distance_px[:-1]) / 2.0
    of_width = np.sinc(np.outer(frequency, width))
    is_uniform = (np.abs(middle) < uniform_px) & (width < 1.0)
    waves = np.exp(-2j * np.pi * np.outer(frequency, middle)) * np.where(
        is_uniform, 1.0 / np.maximum(of_width, 0.1), of_width
    )
    end_px, omega = distance_px[-1], 2 * np.pi * frequency
    of_tail = 2 * (np.cos(omega * end_px) / end_px - omega * (np.pi / 2 - sici(omega * end_px)[0]))
    transform = waves @ np.diff(values, axis=0) + np.outer(of_tail, tail)
    # A bin's mean is that of a profile blurred by the distances in it.
    of_bins = np.cos(np.outer(omega, off_px)).mean(1)
    return np.asarray(transform / of_bins[:, np.newaxis], np.complex128)


def _alias(mtf: FloatArray, step_px: float) -> FloatArray:
    """Return the error of an MTF that is known at a profile in steps: what is beyond their sampling frequency.

    It is estimated with a Gaussian through the MTF at the Nyquist frequency of the pixels.
    """
    frequency = FREQUENCY_CYC_PER_PIXEL
    beyond = 1.0 / step_px - frequency
    size = np.minimum(mtf[NYQUIST], 1.0) ** ((beyond / frequency[NYQUIST]) ** 2)
    return np.asarray(size * np.abs(np.sinc(beyond * step_px) / np.sinc(frequency * step_px)))


def _edge_mtf(
    esf: _Esf, levels: FloatArray, tail_px: float, uniform_px: float, curve: _Curve, box: Box, step_px: float
) -> EdgeMtf:
    """Return MTF, band and overshoot of a fitted edge, whose profile ends in tails at a distance."""
    from scipy.interpolate import make_interp_spline

    means, covariance = esf.means, esf.covariance()
    dark, contrast = (levels[[DARK, CONTRAST]] @ means).tolist()
    inner, tail = np.abs(esf.nodes) < tail_px, levels[TAIL] / tail_px
    d, rise = esf.nodes[inner, np.newaxis], _rise(esf, levels)[inner, np.newaxis]
    distance_px = np.concatenate([[-tail_px], d[:, 0], [tail_px]])
    # Without the changes of light across its sides.
    between = np.eye(len(inner))[inner] - d * ((1.0 - rise) * levels[DARK_SIDE] + rise * levels[BRIGHT_SIDE])
    values = np.vstack([levels[DARK] + tail, between, levels[DARK] + levels[CONTRAST] - tail])
    transform = _transform(distance_px, values, levels[TAIL], uniform_px, esf.off_px) / contrast
    transform /= np.sinc(step_px * FREQUENCY_CYC_PER_PIXEL)[:, np.newaxis]
    ratio = transform @ means
    # Derivatives of the ratio, turned so that the real part is along it.
    derivative = transform - np.outer(ratio, levels[CONTRAST] / contrast)
    derivative *= np.exp(-1j * np.angle(ratio))[:, np.newaxis]

    def error(derivatives: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", derivatives, covariance, derivatives), 0.0)))

    mtf = np.sqrt(np.maximum(np.abs(ratio) ** 2 - error(derivative.imag) ** 2, 0.0))
    alias = _alias(mtf, esf.bin_px)
    bias = SYSTEMATIC * np.minimum(FREQUENCY_CYC_PER_PIXEL / FREQUENCY_CYC_PER_PIXEL[NYQUIST], 1.0)
    half = np.sqrt((NORMAL_95 * error(derivative.real)) ** 2 + alias**2 + bias**2)
    # How far means over a pixel go beyond both levels.
    n_in_pixel = 20
    end = math.floor(tail_px * n_in_pixel)
    grid = np.arange(-end, end + 1) / n_in_pixel
    sums = np.cumsum(make_interp_spline(distance_px, values - levels[DARK], k=1)(grid) / contrast, 0)
    in_pixels = (sums[n_in_pixel:] - sums[:-n_in_pixel]) / n_in_pixel
    level = in_pixels @ means

    def beyond(name: str, k: int, height: float, sign: float) -> Json:
        value = max(sign * (float(level[k]) - height), 0.0)
        reach = NORMAL_95 * float(error(in_pixels[k : k + 1] - level[k] * levels[CONTRAST] / contrast)[0])
        return {name: value, f"{name}_ci95": (max(value - reach, 0.0), value + reach)}

    visible = esf.along[np.abs(esf.distance) < 1.0]
    ends = np.linspace(visible.min(), visible.max(), 101)
    line = polyval(ends, curve.polynomial)
    curves = np.stack([mtf, np.maximum(mtf - half, 0.0), np.abs(ratio) + half])
    mtf50 = with_ends(
        "mtf50_cyc_per_pixel", lambda values: crossing_frequency(0.5, FREQUENCY_CYC_PER_PIXEL, values), curves
    )
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
        **(mtf50 if mtf50["mtf50_cyc_per_pixel"] is not None else {}),
        **with_ends("mtf_at_nyquist", lambda values: float(values[NYQUIST]), curves),
        **beyond("overshoot", int(np.argmax(level)), 1.0, 1.0),
        **beyond("undershoot", int(np.argmin(level)), 0.0, -1.0),
    )
    return EdgeMtf(
        curves=curves,
        record=record,
        box=box,
        centre_px=(curve.x + left, curve.y + top),
        alias=float(alias[: NYQUIST + 1].max()),
        distance_px=distance_px,
        profile=(values @ means - dark) / contrast,
    )
