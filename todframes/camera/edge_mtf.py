"""MTF of one slanted edge in an array (e-SFR), with its 95 % band.

The edge-based spatial frequency response of ISO 12233:2023, at any angle: the distance of each pixel from the edge
makes a finely sampled edge profile, whose derivative has the MTF as its Fourier transform. The standard sorts the
distances into bins. Here a cubic spline is fitted to them by least squares, together with the curve of the edge:
the MTF is then a linear function of the pixels, and its covariance follows from their residuals.

- The spline has knots every quarter of a pixel at the edge. Farther out its intervals grow with the distance, as a
  real profile gets smoother there; what is farther still is a level that is approached as 1 / distance. Every
  aperture with a rim has such a tail, because the OTF has a kink at frequency 0 (for a circle: 1 - 4 f / (π f_c)).
  The levels are those that the tail approaches, so a tail beyond the box does not raise the MTF.
- The transforms of splines and tail are closed forms or exact to rounding. What the fit itself passes, the
  counterpart of the correction for bins and differences in the standard, is found at the very same pixels from an
  edge whose transform is a closed form: a Gaussian one with the same MTF50.
- The modulus of a noisy transform is too large. It is replaced by the value whose mean it would be: Koay & Basser
  2006, "Analytically exact correction scheme for signal extraction from noisy magnitude MR signals", J. Magn.
  Reson. 179. The band is the exact interval of a modulus under Gaussian noise (noncentral χ²). Its upper end is no
  lower than that of the modulus which noise alone exceeds in half of all cases: Cowan et al. 2011,
  "Power-constrained limits", arXiv:1105.3166. Without this, a small modulus would have a band of no width.
- Noise that pixels share is known from the products of residuals by lag, up to the largest lags at which they are
  seen. Its covariance is that of stationary noise whose strength changes with the distance from the edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import NDArray

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.camera.mtf_table import mtf50_of
from todframes.psychometrics.bootstrap import NORMAL_95

Box = tuple[int, int, int, int]

FREQUENCY_CYC_PER_PIXEL: FloatArray = np.arange(65) / 64.0
"""Frequencies of an MTF: up to twice the Nyquist frequency, with the steps that files of MTF Mapper have."""

NYQUIST = 32
"""Index of half a cycle/pixel, the Nyquist frequency of the pixels."""

LEAST_SIDE_PX = 20
"""Least width and height of a box: the tail begins 6 pixels from the edge or farther, and needs pixels behind."""

KNOTS_PX = 0.25
"""Interval of the knots at the edge. A spline with such knots passes 1 cycle/pixel but for 1 part in 2,000."""

UNIFORM_PX, UNIFORM_RISES = 3.0, 1.2
"""Distance up to which knots are uniform: at least, and in units of the profile's rise from 10 to 90 %."""

GROWTH = 1.0 / 6.0
"""Interval of the knots farther out, relative to the distance."""

TAIL_PX, TAIL_RISES = 6.0, 2.5
"""Distance at which the tail begins: at least, and in units of the rise. A Gaussian's is 0 from there on,
and that of a diffraction-limited lens 1 / distance to 3 parts in 10,000 of the contrast."""

FARTHEST_TAIL = 0.6
"""Largest distance at which the tail begins, relative to the distance of the farthest pixels."""

WIDEST_PX = 48.0
"""Largest distance of pixels that are used: what is farther adds shading, and no precision."""

WIDEST_GAP_PX = 0.75
"""Largest distance between neighbouring pixels of the profile: 0.71 at 45° exactly, and 1 for an upright edge;
frequencies up to 0.5 cycles/pixel are then still sampled twice."""

DEGREE = 3
"""Degree of the polynomial that the edge may follow: lenses bend it by a parabola, and more at one end."""

LEAST_STEP = 5.0
"""Least contrast of an edge in units of the noise of a pixel."""

PART_PX = 1.0
"""Length of the parts of an edge whose places are compared with its curve."""

COARSE_PX = 1.0
"""Interval of the knots of the profile for that."""

ROUGHEST_PX = 0.15
"""Largest standard deviation of the edge from its curve. It lowers the MTF at the Nyquist frequency by 10 %."""

ROUGHNESS_ERRORS = 5.0
"""Least square of a roughness in units of what noise gives, for independent parts of the edge."""

QUARTILE, LEAST_SIGMA_PX = 0.6745, 0.4
"""Upper quartile of a Gaussian, and the least width of the one that stands for the edge's slope."""

DEAD_ERRORS, DEAD_CONTRAST, DEAD_NEIGHBOURS = 8.0, 0.05, 3.0
"""Least residual of a pixel that is left out as dead: in units of the noise, of the contrast, and of the largest
residual beside it."""

MOST_SATURATED_EDGE = 0.01
"""Largest share of the pixels of a box at an end of the scale."""

LEAST_SHADING, SHADING_ERRORS, UNEVEN_PX = 0.01, 2.0, 33
"""Least change of light across one side of the edge that is fitted, relative to the contrast and to its error; and
the width of means that are uneven light, not noise."""

NOISE_PIXELS = 100
"""Number of pixels at about the same distance from the edge whose noise is averaged."""

STRUCTURE_ERRORS = 4.0
"""Least agreement of the halves of an edge about what the splines do not follow, in units of that of chance."""

MOST_SHARED_PX = 16
"""Largest distance of pixels, in rows and in columns, whose noise may be correlated."""

SHARED_CHANCE = 0.01
"""Probability that independent noise shows a correlation that is taken for one."""

LEAST_POWER = 0.01
"""Least power of noise at any frequency, relative to its mean."""

LARGEST_ERROR = 0.25
"""Largest half-width of the interval of MTF50, relative to it."""


class EdgeValue(NamedTuple):
    """A value with its 95 % interval; an end is None where the data do not give one."""

    value: float
    ci95: tuple[float | None, float | None]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MtfBand:
    """An MTF at `FREQUENCY_CYC_PER_PIXEL` with its 95 % band, point by point.

    Attributes
    ----------
    mtf, lower, upper : ndarray (65,)
    """

    mtf: FloatArray
    lower: FloatArray
    upper: FloatArray

    @property
    def mtf50_cyc_per_pixel(self) -> EdgeValue | None:
        """Frequency at which the MTF falls to 0.5, and those at which its band does; None if it stays above."""
        value, *ends = (mtf50_of(FREQUENCY_CYC_PER_PIXEL, one) for one in (self.mtf, self.lower, self.upper))
        return None if value is None else EdgeValue(value, (ends[0], ends[1]))

    @property
    def mtf_at_nyquist(self) -> EdgeValue:
        """MTF at 0.5 cycles/pixel."""
        return EdgeValue(float(self.mtf[NYQUIST]), (float(self.lower[NYQUIST]), float(self.upper[NYQUIST])))

    def at(self, frequency_cyc_per_pixel: float) -> float:
        """Return the MTF at a frequency of 0 to 1 cycles/pixel."""
        return float(np.interp(frequency_cyc_per_pixel, FREQUENCY_CYC_PER_PIXEL, self.mtf))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EdgeMtf(MtfBand):
    """The MTF across one edge, and the edge.

    Attributes
    ----------
    box : (int, int, int, int)
        Left column, top row, width and height of the pixels that were used.
    centre_px : (float, float)
        A point of the edge, x and y; (0, 0) is the centre of the frame's first pixel.
    normal_deg : float
        Direction in which the MTF is measured, from dark to bright: 0 is right, 90 is down.
    bend_px : float
        Largest distance of the edge from a straight line.
    dark, bright : float
        Levels beside the edge, in units of the values.
    noise_sd : float
        Standard deviation of a pixel from the fitted edge, in units of the values.
    overshoot, undershoot : EdgeValue
        How far the profile, averaged over one pixel, goes beyond the bright and the dark level, relative to the
        contrast; 0 where it stays between them.
    distance_px, profile : ndarray (n,)
        The fitted edge profile: 0 is the dark level, 1 the bright one.
    """

    box: Box
    centre_px: tuple[float, float]
    normal_deg: float
    bend_px: float
    dark: float
    bright: float
    noise_sd: float
    overshoot: EdgeValue
    undershoot: EdgeValue
    distance_px: FloatArray
    profile: FloatArray

    @property
    def angle_deg(self) -> float:
        """Angle of the edge against rows or columns of pixels, whichever is nearer: 0 to 45."""
        return abs((self.normal_deg + 45.0) % 90.0 - 45.0)

    def without_steps(self, step_px: float) -> EdgeMtf:
        """Return the edge with what steps of this width, along the normal, take from its MTF divided out.

        A regular stair, averaged along the edge, is a straight edge whose light is spread evenly over one step.
        """
        if step_px == 0.0:
            return self
        of_steps = np.sinc(step_px * FREQUENCY_CYC_PER_PIXEL)
        return replace(self, mtf=self.mtf / of_steps, lower=self.lower / of_steps, upper=self.upper / of_steps)

    @property
    def relative_noise(self) -> float:
        """Noise of a pixel in units of the contrast."""
        return self.noise_sd / (self.bright - self.dark)


def mean_band(bands: Sequence[MtfBand]) -> MtfBand:
    """Return the mean of MTFs, with the band that follows from theirs if their noise is independent."""
    mean = np.mean([one.mtf for one in bands], 0)
    down, up = (
        np.sqrt(np.sum([(getattr(one, end) - one.mtf) ** 2 for one in bands], 0)) / len(bands)
        for end in ("lower", "upper")
    )
    return MtfBand(mtf=mean, lower=np.maximum(mean - down, 0.0), upper=mean + up)


def measure_edge(image: FloatArray, box: Box, *, saturated: NDArray[np.bool_] | None = None) -> EdgeMtf:
    """Measure the MTF across the one edge in a box.

    Parameters
    ----------
    image : ndarray (rows, columns)
        Values proportional to light.
    box : (int, int, int, int)
        Left column, top row, width and height.
    saturated : ndarray of bool (rows, columns), optional
        Whether a pixel was at an end of its scale.

    Raises
    ------
    SettingsError
        If the box is not in the image, or smaller than `LEAST_SIDE_PX`.
    DataError
        If there is no edge, it is saturated, too upright for a finely sampled profile or not smooth, or noise
        leaves MTF50 uncertain by more than a quarter.
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
        if share > MOST_SATURATED_EDGE:
            raise DataError(
                f"{where}{100 * share:.0f} % of the pixels are at an end of the scale: the edge is saturated and "
                "its MTF is lost; change exposure or gain"
            )
    curve = _fitted_curve(values, where)
    fit = _fitted(values, curve, where)
    found = _edge_mtf(fit, box)
    mtf50 = found.mtf50_cyc_per_pixel
    if mtf50 is not None:
        low, high = mtf50.ci95
        if low is None or high is None or high - low > 2 * LARGEST_ERROR * mtf50.value:
            ends = f"{low or 0:.2g} to {'above 1' if high is None else f'{high:.2g}'}"
            raise DataError(
                f"{where}noise of {100 * found.relative_noise:.1f} % of the contrast leaves MTF50 at {ends} "
                "cycles/pixel, expected an interval within a quarter of it; average frames, or use a longer edge"
            )
    return found


class _Curve(NamedTuple):
    """A smooth line in an image: a point, the unit normal from dark to bright, and a polynomial.

    In coordinates t along the normal and s across it, from the point, the edge is t = polynomial(s); its first two
    coefficients are 0.
    """

    x: float
    y: float
    normal: tuple[float, float]
    polynomial: FloatArray

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
    slopes = [gaussian_filter(values, smooth_px, order=one, mode="nearest") for one in ((0, 1), (1, 0))]
    squares = slopes[0] ** 2 + slopes[1] ** 2
    if not squares.max() > 0.0:
        raise DataError(f"{where}found no edge: all values are the same")
    places = np.indices(values.shape).astype(np.float64)
    y, x = places[0], places[1]
    # The direction of the steepest slopes: the principal axis of the structure tensor.
    gx, gy = slopes
    jxx, jyy, jxy = (float((squares * one * other).sum()) for one, other in ((gx, gx), (gy, gy), (gx, gy)))
    angle = 0.5 * math.atan2(2 * jxy, jxx - jyy)
    normal = (math.cos(angle), math.sin(angle))
    if float((squares * (slopes[0] * normal[0] + slopes[1] * normal[1])).sum()) < 0.0:
        normal = (-normal[0], -normal[1])
    weight = squares**2
    start = (float((weight * x).sum() / weight.sum()), float((weight * y).sum() / weight.sum()))
    curve = _Curve(*start, normal, np.zeros(DEGREE + 1))
    reach_px = max(values.shape) / 3.0
    for n_done in range(12):
        distance, s = curve.distance(x, y)
        rising = np.maximum(slopes[0] * curve.normal[0] + slopes[1] * curve.normal[1], 0.0)
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


class _Profile:
    """Functions of the distance from an edge whose sum is its profile, and their Fourier transforms.

    A constant; a step from 0 to 1 that is a spline; cubic B-splines between the two points at which the tails
    begin; and, if it has one, the tail: -1 / distance, continued between those points by a quintic with the same
    value and first two derivatives.
    """

    DARK, STEP = 0, 1
    """Columns of the constant and of the step, whose weights are the dark level and the contrast."""

    def __init__(self, tail_px: float, uniform_px: float, knots_px: float, *, has_tail: bool) -> None:
        self.has_tail = has_tail
        places = [0.0]
        while places[-1] < tail_px:
            places.append(
                places[-1] + (knots_px if places[-1] < uniform_px else max(knots_px, GROWTH * places[-1]))
            )
        half = np.array(places[1:])
        inner = np.concatenate([-half[::-1], [0.0], half])
        self.end_px = float(half[-1])
        last = half[-1] - half[-2]
        outer = last * np.arange(1, 4)
        self.knots = np.concatenate([inner[0] - outer[::-1], inner, inner[-1] + outer])
        self.inner = inner
        d = self.end_px
        rows = [[d, d**3, d**5], [1.0, 3 * d**2, 5 * d**4], [0.0, 6 * d, 20 * d**3]]
        odd = np.linalg.solve(rows, [-1 / d, 1 / d**2, -2 / d**3])
        self.bridge = np.array([0.0, odd[0], 0.0, odd[1], 0.0, odd[2]])

    def columns(self, distance_px: FloatArray) -> FloatArray:
        """Return the functions at distances, (n, n_functions)."""
        from scipy.interpolate import BSpline

        inside = np.abs(distance_px) < self.end_px
        splines = BSpline.design_matrix(distance_px[inside], self.knots, 3).toarray()
        # Without those that reach beyond the ends.
        found = np.zeros((len(distance_px), 3 + splines.shape[1] - 6))
        found[:, self.DARK] = 1.0
        found[:, self.STEP] = distance_px > 0.0
        found[inside, self.STEP] = splines @ self._in_step()
        found[inside, 2:-1] = splines[:, 3:-3]
        found[~inside, -1] = -1.0 / distance_px[~inside]
        found[inside, -1] = polyval(distance_px[inside], self.bridge)
        return found if self.has_tail else found[:, :-1]

    def _in_step(self) -> FloatArray:
        """Return the weights of the splines in the step: half of that in the middle, and all to the right."""
        n = len(self.knots) - 4
        return np.where(np.arange(n) == n // 2, 0.5, np.arange(n) > n // 2)

    def slopes(self, distance_px: FloatArray) -> FloatArray:
        """Return the derivatives of the functions between the ends, (n, n_functions)."""
        from scipy.interpolate import BSpline

        of_splines = BSpline(self.knots, np.eye(len(self.knots) - 4), 3).derivative()(distance_px)
        others = (0.0 * distance_px, of_splines @ self._in_step(), of_splines[:, 3:-3])
        of_tail = [polyval(distance_px, polyder(self.bridge))] if self.has_tail else []
        return np.column_stack([*others, *of_tail])

    def transforms(self, frequency: FloatArray) -> ComplexArray:
        """Return the Fourier transforms of the derivatives of the functions, (n_frequencies, n_functions).

        Between the knots by Gauss-Legendre quadrature: with 16 points it is exact to 1e-9 for intervals of up to 3
        pixels and frequencies of up to 1 cycle/pixel. The tail's, 1 / distance², by the sine integral.
        """
        from scipy.special import sici

        points, weights = np.polynomial.legendre.leggauss(16)
        middle, half = (self.inner[1:] + self.inner[:-1]) / 2, np.diff(self.inner) / 2
        places = (middle[:, np.newaxis] + half[:, np.newaxis] * points).ravel()
        each = (half[:, np.newaxis] * weights).ravel()
        waves = np.exp(-2j * np.pi * np.outer(frequency, places)) * each
        found: ComplexArray = np.asarray(waves @ self.slopes(places), np.complex128)
        if not self.has_tail:
            return found
        omega = 2 * np.pi * frequency
        far = np.cos(omega * self.end_px) / self.end_px - omega * (np.pi / 2 - sici(omega * self.end_px)[0])
        found[:, -1] += 2 * far
        return found


class _Fit(NamedTuple):
    """A fitted edge: weights of the functions of its profile, and their covariance from the residuals."""

    curve: _Curve
    profile: _Profile
    weights: FloatArray
    covariance: FloatArray
    pass_through: FloatArray
    residual_sd: float
    bend_px: float

    @property
    def contrast(self) -> float:
        """Difference of the levels far from the edge."""
        return float(self.weights[_Profile.STEP])


class _Pixels(NamedTuple):
    """Places and values of the pixels of a box, and the distance from the edge up to which they are used."""

    x: FloatArray
    y: FloatArray
    values: FloatArray
    is_alive: NDArray[np.bool_]
    widest_px: float


class _Solved(NamedTuple):
    """A profile fitted to pixels for a given curve; arrays hold one number for each pixel that is used."""

    used: NDArray[np.bool_]
    """Whether a pixel of the box is used, (rows, columns)."""
    distance: FloatArray
    along: FloatArray
    profile: _Profile
    columns: FloatArray
    factor: tuple[FloatArray, bool]
    weights: FloatArray
    residual: FloatArray
    widest_px: float
    across: tuple[FloatArray, FloatArray]
    """Changes of light across the edge, on its bright and its dark side."""
    shape: tuple[FloatArray, FloatArray]
    """Distances, and the profile there from 0 to 1."""

    @property
    def contrast(self) -> float:
        return float(self.weights[_Profile.STEP])

    @property
    def rise_px(self) -> float:
        """Distance from the last 10 % to the first 90 % of the profile."""
        grid, profile = self.shape
        high = grid[int(np.argmax(profile > 0.9))]
        low = grid[len(profile) - 1 - int(np.argmax(profile[::-1] < 0.1))]
        return max(float(high - low), KNOTS_PX)

    def without(self, change: FloatArray) -> FloatArray:
        """Return a change of the pixels without what the fitted functions can follow."""
        from scipy.linalg import cho_solve

        return np.asarray(change - self.columns @ cho_solve(self.factor, self.columns.T @ change))


def _fitted(values: FloatArray, curve: _Curve, where: str) -> _Fit:
    """Fit curve and profile in turn, then find their covariance."""
    from scipy.linalg import cho_solve

    y, x = (one.ravel() for one in np.indices(values.shape, np.float64))
    distance, s = curve.distance(x, y)
    # The farthest pixels, as many as the edge has along it, lie in corners of the box.
    n_left_out = min(int(np.ptp(s)), len(s) // 4)
    ordered = np.sort(distance)
    widest_px = min(WIDEST_PX, float(ordered[-1 - n_left_out]), float(-ordered[n_left_out]))
    farthest_px = FARTHEST_TAIL * widest_px
    if farthest_px < TAIL_PX:
        raise DataError(
            f"{where}found an edge with {max(widest_px, 0.0):.1f} pixels beside it, expected at least "
            f"{TAIL_PX / FARTHEST_TAIL:.0f} on both sides"
        )
    pixels = _Pixels(x, y, values.ravel(), np.ones(values.shape, bool), widest_px)
    # First with knots everywhere, as the width of the profile is not known.
    tail_px = uniform_px = min(farthest_px, 1.5 * TAIL_PX)
    is_shaded, shape = False, None
    for n_done in range(4):
        solved = _solve(pixels, curve, tail_px, uniform_px, shape, is_shaded=is_shaded, where=where)
        curve, shape = _improved(curve, solved), solved.shape
        if n_done > 0:
            tail_px = min(max(TAIL_PX, TAIL_RISES * solved.rise_px), farthest_px)
            uniform_px = min(max(UNIFORM_PX, UNIFORM_RISES * solved.rise_px), tail_px)
        if n_done == 1:
            pixels = pixels._replace(is_alive=~_dead(solved))
        if n_done == 2:
            is_shaded = _is_shaded(solved)
    solved = _solve(pixels, curve, tail_px, uniform_px, shape, is_shaded=is_shaded, where=where)
    while tail_px < farthest_px and _has_structure(solved):
        tail_px = min(1.4 * tail_px, farthest_px)
        solved = _solve(pixels, curve, tail_px, uniform_px, shape, is_shaded=is_shaded, where=where)
    coarse = _solve(
        pixels, curve, tail_px, uniform_px, shape, is_shaded=is_shaded, where=where, least_knots_px=COARSE_PX
    )
    _check_smooth(coarse, where)
    columns, residual = solved.columns, solved.residual
    inverse = cho_solve(solved.factor, np.eye(columns.shape[1]))
    leverage = np.minimum(np.einsum("ij,ij->i", columns @ inverse, columns), 0.9)
    meat = _noise(solved, leverage).covariance(solved)
    n = len(solved.weights)
    visible = solved.along[np.abs(solved.distance) < 1.0]
    ends = np.linspace(visible.min(), visible.max(), 101)
    line = polyval(ends, curve.polynomial)
    chord = line - np.polyval(np.polyfit(ends, line, 1), ends)
    return _Fit(
        curve=curve,
        profile=solved.profile,
        weights=solved.weights,
        covariance=(inverse @ meat @ inverse)[:n, :n],
        pass_through=_pass_through(solved),
        residual_sd=float(residual.std()),
        bend_px=float(np.ptp(chord)),
    )


def _solve(
    pixels: _Pixels,
    curve: _Curve,
    tail_px: float,
    uniform_px: float,
    shape: tuple[FloatArray, FloatArray] | None,
    *,
    is_shaded: bool,
    where: str,
    least_knots_px: float = KNOTS_PX,
) -> _Solved:
    """Fit a profile to pixels by least squares, for a given curve and, from an earlier fit, a rough profile."""
    from scipy.linalg import cho_factor, cho_solve

    distance, along = curve.distance(pixels.x, pixels.y)
    used = (np.abs(distance) <= pixels.widest_px) & pixels.is_alive.ravel()
    distance, along, values = distance[used], along[used], pixels.values[used]
    knots_px = max(_knots_px(distance, uniform_px, curve, where), least_knots_px)
    profile = _Profile(tail_px, uniform_px, knots_px, has_tail=not is_shaded)
    functions = profile.columns(distance)
    of_step = functions[:, _Profile.STEP] if shape is None else np.interp(distance, *shape)
    # On either side light may change along the edge and, in place of the tail, across it.
    sides = (of_step, 1.0 - of_step)
    across = (sides[0] * distance / pixels.widest_px, sides[1] * distance / pixels.widest_px)
    shading = [side * along / np.abs(along).max() for side in sides] + list(across) * is_shaded
    columns = np.column_stack([functions, *shading])
    try:
        factor = cho_factor(columns.T @ columns)
    except np.linalg.LinAlgError:
        raise DataError(f"{where}found too few pixels at the edge for a profile, expected a larger box") from None
    solved = cho_solve(factor, columns.T @ values)
    residual = values - columns @ solved
    weights = solved[: functions.shape[1]]
    contrast = float(weights[_Profile.STEP])
    if not contrast > LEAST_STEP * residual.std():
        raise DataError(
            f"{where}found no edge: along a smooth curve the steepest step is {max(contrast, 0.0):.3g} against "
            f"noise of {residual.std():.3g}, expected at least {LEAST_STEP:g} times the noise; is it straight "
            "and alone in the box?"
        )
    grid = np.linspace(-0.999 * profile.end_px, 0.999 * profile.end_px, 401)
    rising = (profile.columns(grid) @ weights - weights[_Profile.DARK]) / contrast
    found = grid, np.clip(rising, 0.0, 1.0)
    return _Solved(
        used.reshape(pixels.is_alive.shape),
        distance,
        along,
        profile,
        columns,
        factor,
        weights,
        residual,
        pixels.widest_px,
        across,
        found,
    )


def _improved(curve: _Curve, solved: _Solved) -> _Curve:
    """Return the curve after a Gauss-Newton step: moved by what the residuals say along the edge."""
    slope = np.zeros(len(solved.distance))
    inside = np.abs(solved.distance) < solved.profile.end_px
    slope[inside] = solved.profile.slopes(solved.distance[inside]) @ solved.weights
    length, powers = float(np.abs(solved.along).max()), np.arange(1, DEGREE + 1)
    changes = -slope[:, np.newaxis] * (solved.along[:, np.newaxis] / length) ** powers
    step = np.linalg.lstsq(solved.without(changes), solved.residual, rcond=None)[0] / length**powers
    return curve.moved(np.concatenate([[0.0], step]))


def _knots_px(distance: FloatArray, uniform_px: float, curve: _Curve, where: str) -> float:
    """Return the interval of the knots at the edge: no smaller than the widest gap between pixels."""
    near = np.sort(distance[np.abs(distance) <= uniform_px])
    gap_px = float(np.diff(near).max()) if len(near) > 1 else math.inf
    if gap_px > WIDEST_GAP_PX:
        angle = abs((math.degrees(math.atan2(curve.normal[1], curve.normal[0])) + 45.0) % 90.0 - 45.0)
        raise DataError(
            f"{where}found an edge {angle:.2f}° from rows or columns, whose pixels leave a gap of {gap_px:.3g} "
            f"pixels in its profile, expected at most {WIDEST_GAP_PX}; turn target or camera by 2° to 10°, or use "
            "a longer edge"
        )
    return max(KNOTS_PX, 1.02 * gap_px)


def _has_structure(solved: _Solved) -> bool:
    """Return whether residuals beyond the splines have the same means, pixel by pixel, in both halves of the edge.

    Noise that neighbouring pixels share has means as well, but different ones.
    """
    far = np.abs(solved.distance) >= solved.profile.end_px
    residual, bins = solved.residual[far], np.floor(solved.distance[far]).astype(np.intp)
    first = solved.along[far] < np.median(solved.along[far])
    bins -= bins.min()
    counts = np.array([np.bincount(bins[half], minlength=bins.max() + 1) for half in (first, ~first)])
    sums = np.array([np.bincount(bins[half], residual[half], bins.max() + 1) for half in (first, ~first)])
    filled = (counts > 1).all(0)
    means = sums[:, filled] / counts[:, filled]
    scale = math.sqrt(float((means[0] @ means[0]) * (means[1] @ means[1])) / max(int(filled.sum()), 1))
    return bool(means[0] @ means[1] > STRUCTURE_ERRORS * scale)


def _dead(solved: _Solved) -> NDArray[np.bool_]:
    """Return which pixels are far from the fit while all that surround them are not."""
    from scipy.ndimage import maximum_filter

    residual = np.zeros(solved.used.shape)
    residual[solved.used] = np.abs(solved.residual)
    noise_sd = float(np.median(np.abs(solved.residual))) / QUARTILE
    others = maximum_filter(residual, footprint=[[1, 1, 1], [1, 0, 1], [1, 1, 1]], mode="constant")
    least = max(DEAD_ERRORS * noise_sd, DEAD_CONTRAST * solved.contrast)
    return np.asarray((residual > least) & (residual > DEAD_NEIGHBOURS * others))


def _is_shaded(solved: _Solved) -> bool:
    """Return whether light changes across one side of the edge, beyond what the tail explains.

    One edge cannot hold a tail and a change of light apart, so that a fit of both loses the levels.
    """
    from scipy.ndimage import uniform_filter

    free = np.column_stack([solved.without(change) for change in solved.across])
    explained = free @ np.linalg.lstsq(free, solved.residual, rcond=None)[0]
    # Noise that neighbours share is what is left without the mean about each pixel: uneven light is none.
    images = np.zeros((2, *solved.used.shape))
    images[0, solved.used] = solved.residual - explained
    images[1] = solved.used
    total, n = (uniform_filter(one, UNEVEN_PX, mode="constant")[solved.used] for one in images)
    rest = solved._replace(residual=solved.residual - explained - total / n)
    variance = _noise(rest).gain * float(rest.residual.var())
    power = (free**2).sum(0)
    size, error = np.abs(free.T @ solved.residual) / power, np.sqrt(variance / power)
    return bool(((size > LEAST_SHADING * solved.contrast) & (size > SHADING_ERRORS * error)).any())


def _check_smooth(solved: _Solved, where: str) -> None:
    """Raise DataError if parts of the edge are displaced from the curve by more than noise would displace them.

    The same filter beside the edge shows what noise does, also noise that neighbouring pixels share. `solved` is a
    fit with coarse knots: a finer profile follows what distant parts of a wavy edge have in common.
    """
    grid, rising = solved.shape
    highest = np.maximum.accumulate(rising)
    quarters = [float(grid[np.searchsorted(highest, level)]) for level in (0.25, 0.75)]
    sigma_px = max((quarters[1] - quarters[0]) / (2 * QUARTILE), LEAST_SIGMA_PX)
    part = np.floor((solved.along - solved.along.min()) / PART_PX).astype(np.intp)

    def power_at(place_px: float) -> tuple[FloatArray, FloatArray]:
        """Return the slope of an edge at a distance, and the sum of its squares in each part."""
        slope = np.exp(-0.5 * ((solved.distance - place_px) / sigma_px) ** 2)
        slope *= solved.contrast / (sigma_px * math.sqrt(2 * math.pi))
        return slope, np.asarray(np.bincount(part, slope**2), np.float64)

    least_power = 0.5 * float(np.median(power_at(0.0)[1]))

    def displacements(place_px: float) -> FloatArray:
        """Return those that residuals at a distance show, less the polynomial that the curve may follow."""
        slope, power = power_at(place_px)
        # Parts at the ends, and at corners of the box, have few pixels.
        seen = np.flatnonzero(power > least_power)
        if len(seen) < 2 * DEGREE + 2:
            return np.zeros(0)
        shift = np.bincount(part, slope * solved.residual)[seen] / power[seen]
        shift -= np.polyval(np.polyfit(seen, shift, DEGREE), seen)
        return np.asarray(shift / math.sqrt(1.0 - (DEGREE + 1) / len(seen)))

    farthest_px = max(solved.widest_px - 2 * sigma_px, solved.widest_px / 2)
    beside_px = np.append(np.arange(farthest_px - 4 * sigma_px, 4 * sigma_px, -4 * sigma_px), farthest_px)
    beside = [one for place in beside_px for side in (1.0, -1.0) if len(one := displacements(side * place))]
    found = displacements(0.0)
    noise = float(np.mean([one @ one / len(one) for one in beside]))
    # Parts that share noise are fewer: the variance of a mean of squares (Bartlett).
    lags = range(1, min(MOST_SHARED_PX, len(found) // 4))
    shared = [
        np.mean([one[lag:] @ one[:-lag] / len(one) for one in beside if len(one) > lag]) / noise for lag in lags
    ]
    n_parts = len(found) / (1.0 + 2.0 * float(np.sum(np.square(shared)))) if noise > 0.0 else math.inf
    excess = float(found @ found) / len(found) - noise
    if excess > max(ROUGHEST_PX**2, ROUGHNESS_ERRORS * math.sqrt(2.0 / n_parts) * noise):
        raise DataError(
            f"{where}found an edge that departs from a smooth curve by {math.sqrt(excess):.2f} pixels, expected "
            f"at most {ROUGHEST_PX}; is it straight and smooth, and alone in the box?"
        )


class _Noise(NamedTuple):
    """Noise of the pixels of a fit: its standard deviation there, and the power of its correlation by frequency.

    Power is relative to its mean, at the frequencies of a real transform of the box, padded to `padded`.
    """

    sd: FloatArray
    power: FloatArray
    padded: tuple[int, int]

    def covariance(self, solved: _Solved) -> FloatArray:
        """Return the covariance of the sums of noise times columns."""
        terms = _in_frequency(solved, solved.columns * self.sd[:, np.newaxis], self.padded)
        # The transform of real columns has but half of all frequencies.
        n = self.padded[1]
        weight = np.where((np.arange(n // 2 + 1) == 0) | (2 * np.arange(n // 2 + 1) == n), 1.0, 2.0)
        scaled = (terms * np.sqrt(self.power * weight)[..., np.newaxis]).reshape(-1, terms.shape[2])
        return np.asarray((scaled.real.T @ scaled.real + scaled.imag.T @ scaled.imag) / math.prod(self.padded))

    @property
    def gain(self) -> float:
        """Variance of the mean of many pixels, in units of that of independent noise; at least 1."""
        return max(float(self.power[0, 0]), 1.0)


def _noise(solved: _Solved, leverage: FloatArray | float = 0.0) -> _Noise:
    """Estimate the noise from the residuals of a fit.

    Its standard deviation depends on the distance from the edge, as it differs with the light; its correlation,
    which interpolation, compression and sharpening make, is the same everywhere.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    squares = solved.residual**2 / (1.0 - leverage)
    sd = np.zeros(len(squares))
    for group in np.array_split(np.argsort(solved.distance), max(len(squares) // NOISE_PIXELS, 1)):
        sd[group] = math.sqrt(float(squares[group].mean()))
    rows, columns = (next_fast_len(one + MOST_SHARED_PX, real=True) for one in solved.used.shape)
    relative = np.divide(solved.residual, sd, out=np.zeros_like(sd), where=sd > 0.0)
    both = _in_frequency(solved, np.column_stack([relative, np.ones(len(sd))]), (rows, columns))
    products, counts = np.moveaxis(irfft2(np.abs(both) ** 2, (rows, columns), axes=(0, 1)), 2, 0)
    power = rfft2(_correlation(products, np.maximum(np.rint(counts), 1.0))).real
    # An estimate of correlations by lag may have a negative power at some frequencies.
    return _Noise(sd, np.maximum(power, LEAST_POWER), (rows, columns))


def _in_frequency(solved: _Solved, values: FloatArray, padded: tuple[int, int]) -> ComplexArray:
    """Return the two-dimensional transforms of values of the pixels that are used, (n_pixels, n)."""
    from scipy.fft import rfft2

    images = np.zeros((*solved.used.shape, values.shape[1]))
    images[solved.used] = values
    return np.asarray(rfft2(images, padded, axes=(0, 1)))


def _correlation(products: FloatArray, pairs: FloatArray) -> FloatArray:
    """Return the correlation of noise by cyclic lag, 0 beyond the lags at which it is seen.

    Parameters
    ----------
    products, pairs : ndarray (rows, columns)
        Sums of products of pixels, and numbers of pairs, by cyclic lag.
    """
    from scipy.special import gammaincc

    found = np.zeros_like(products)
    if not products[0, 0] > 0.0:
        found[0, 0] = 1.0
        return found
    estimate = products / pairs * (pairs[0, 0] / products[0, 0])

    def lags(down: int, right: int) -> tuple[NDArray[np.intp], ...]:
        """Return all lags up to two."""
        return np.ix_(np.arange(-down, down + 1), np.arange(-right, right + 1))

    def is_seen(strip: tuple[Any, ...], of_chance: float) -> bool:
        """Return whether lags have correlations that chance would rarely give (Bartlett's formula)."""
        chi2 = float((pairs[strip] * estimate[strip] ** 2).sum()) / of_chance
        return bool(gammaincc(estimate[strip].size / 2, chi2 / 2) < SHARED_CHANCE)

    down = right = 0
    while True:
        of_chance = float((estimate[lags(down, right)] ** 2).sum())
        # Correlations of sharpened noise pass through 0: the second strip may have some where the first has none.
        rows = [n for n in (down + 1, down + 2) if n <= MOST_SHARED_PX]
        columns = [n for n in (right + 1, right + 2) if n <= MOST_SHARED_PX]
        down, right, before = (
            max((n for n in rows if is_seen((n, np.arange(-right - 1, right + 2)), of_chance)), default=down),
            max((n for n in columns if is_seen((np.arange(-down - 1, down + 2), n), of_chance)), default=right),
            (down, right),
        )
        if (down, right) == before:
            break
    found[lags(down, right)] = estimate[lags(down, right)]
    return found


def _pass_through(solved: _Solved) -> FloatArray:
    """Return the share that the fit passes of each frequency of a Gaussian edge with the same MTF50."""
    from scipy.linalg import cho_solve
    from scipy.special import ndtr

    frequency = FREQUENCY_CYC_PER_PIXEL
    transforms = solved.profile.transforms(frequency)
    mtf50 = mtf50_of(frequency, np.abs(transforms @ solved.weights) / solved.contrast) or 1.0
    sigma_px = math.sqrt(math.log(2.0) / 2.0) / (math.pi * mtf50)
    gaussian = ndtr(solved.distance / sigma_px)
    weights = cho_solve(solved.factor, solved.columns.T @ gaussian)[: len(solved.weights)]
    expected = np.exp(-2.0 * (np.pi * sigma_px * frequency) ** 2)
    found = np.abs(transforms @ weights) / weights[_Profile.STEP]
    # Beyond, the Gaussian has too little to compare with.
    known = int(np.flatnonzero(expected > 0.02)[-1])
    share = found[: known + 1] / expected[: known + 1]
    return np.concatenate([share, np.full(len(frequency) - known - 1, share[-1])])


def _edge_mtf(fit: _Fit, box: Box) -> EdgeMtf:
    """Return MTF, band and overshoot of a fitted edge."""
    transforms = fit.profile.transforms(FREQUENCY_CYC_PER_PIXEL)
    ratio = transforms @ fit.weights / fit.contrast
    # Derivatives of the ratio, turned so that the real part is along it.
    derivative = transforms / fit.contrast
    derivative[:, _Profile.STEP] -= ratio / fit.contrast
    derivative *= np.exp(-1j * np.angle(ratio))[:, np.newaxis]
    along, across = (
        np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", one, fit.covariance, one), 0.0))
        for one in (derivative.real, derivative.imag)
    )
    mtf, lower, upper = _without_noise(np.abs(ratio), along, across)
    mtf, lower, upper = (one / fit.pass_through for one in (mtf, lower, upper))
    left, top, _, _ = box
    curve, dark = fit.curve, float(fit.weights[_Profile.DARK])
    grid, profile, overshoot, undershoot = _overshoots(fit)
    return EdgeMtf(
        mtf=mtf,
        lower=lower,
        upper=upper,
        box=box,
        centre_px=(curve.x + left, curve.y + top),
        normal_deg=math.degrees(math.atan2(curve.normal[1], curve.normal[0])),
        bend_px=fit.bend_px,
        dark=dark,
        bright=dark + fit.contrast,
        noise_sd=fit.residual_sd,
        overshoot=overshoot,
        undershoot=undershoot,
        distance_px=grid,
        profile=profile,
    )


def _without_noise(
    modulus: FloatArray, along: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the modulus without the share of noise in it, and the ends of its 95 % interval.

    `along` and `across` are the standard errors in the direction of the complex value and at right angles to it.
    """
    from scipy.special import chndtrinc, i0e, i1e

    known = along > 0.0
    sd = np.where(known, along, 1.0)
    # With the same error in both directions the modulus has Rice's distribution.
    seen = np.sqrt(np.maximum(modulus**2 - across**2 + along**2, 0.0)) / sd
    true = np.linspace(0.0, 30.0, 3001)
    half = true**2 / 4.0
    mean = math.sqrt(math.pi / 2.0) * ((1 + 2 * half) * i0e(half) + 2 * half * i1e(half))
    few = seen < 29.0
    value = np.where(few, np.interp(seen, mean, true), seen - 0.5 / np.maximum(seen, 1.0))
    lower, upper = value - NORMAL_95, value + NORMAL_95
    for end, least, p in ((lower, 0.0, 0.975), (upper, 2.0 * math.log(2.0), 0.025)):
        squares = np.maximum(seen[few] ** 2, least)
        # Below its quantile without signal, 0 is the end; the inverse gives some tiny number.
        is_above = squares > -2.0 * math.log(1.0 - p)
        end[few] = np.where(is_above, np.sqrt(np.nan_to_num(chndtrinc(squares, 2.0, p))), 0.0)
    value, lower, upper = (np.where(known, one * sd, modulus) for one in (value, lower, upper))
    return value, np.minimum(lower, value), np.maximum(upper, value)


def _overshoots(fit: _Fit) -> tuple[FloatArray, FloatArray, EdgeValue, EdgeValue]:
    """Return the profile from 0 to 1, and how far its means over a pixel go beyond both levels."""
    end = 0.999 * fit.profile.end_px
    n_in_pixel = 20
    grid = np.arange(-math.floor(end * n_in_pixel), math.floor(end * n_in_pixel) + 1) / n_in_pixel
    columns = fit.profile.columns(grid)
    sums = np.cumsum(columns, 0)
    means = (sums[n_in_pixel:] - sums[:-n_in_pixel]) / n_in_pixel
    level = (means @ fit.weights - fit.weights[_Profile.DARK]) / fit.contrast

    def beyond(k: int, height: float, sign: float) -> EdgeValue:
        derivative = means[k] / fit.contrast
        derivative[_Profile.DARK] -= 1.0 / fit.contrast
        derivative[_Profile.STEP] -= level[k] / fit.contrast
        error = NORMAL_95 * math.sqrt(max(float(derivative @ fit.covariance @ derivative), 0.0))
        value = max(sign * (float(level[k]) - height), 0.0)
        return EdgeValue(value, (max(value - error, 0.0), value + error))

    over, under = beyond(int(np.argmax(level)), 1.0, 1.0), beyond(int(np.argmin(level)), 0.0, -1.0)
    return grid, (columns @ fit.weights - fit.weights[_Profile.DARK]) / fit.contrast, over, under
