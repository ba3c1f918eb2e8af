"""Three-dimensional noise: closed forms, unbiased variances, honest intervals, and the way back into a sensor."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from todframes.camera.noise3d import DRAWS, PARTS, FrameSums, NoisePart, fit_drift, snr_of, variances_of
from todframes.charts.layout import Chart, Markers, Page, Patch, Triangle, marker_bits, marker_ids, write_chart
from todframes.recordings.arrays import memory_recording
from todframes.results.wording import plain

AXES = {"t": 0, "v": 1, "h": 2}

REAL = Path(__file__).parents[1] / "recordings"


def cube(rng, shape, sd):
    """Draw Gaussian parts of given standard deviations and add them: the model itself."""
    sides = {name: [shape[AXES[one]] if one in name else 1 for one in "tvh"] for name in sd}
    return sum((rng.normal(0, sd[name], sides[name]) for name in sd), np.zeros(shape))


def noise_of(values, **settings):
    return tod.noise(values, **settings).noise


def codes_of(values, **settings):
    return [warning.code for warning in tod.noise(values, **settings).warnings]


def anova(values):
    """Return mean squares and degrees of freedom straight from the definition, part by part."""
    squares, degrees = {}, {}
    for name in PARTS:
        effect = values
        for axis in range(3):
            mean = effect.mean(axis, keepdims=True)
            effect = effect - mean if "tvh"[axis] in name else mean
        degrees[name] = math.prod(values.shape[AXES[one]] - 1 for one in name)
        squares[name] = (np.broadcast_to(effect, values.shape) ** 2).sum() / degrees[name]
    return squares, degrees


@pytest.mark.parametrize("shape", [(5, 6, 7), (2, 3, 2), (9, 2, 4)])
def test_the_sums_over_frames_give_the_analysis_of_variance(shape):
    # A pattern and a mean a thousand times the noise: differences from the first frame keep the digits.
    rng = np.random.default_rng(3)
    values = 1e4 + 100 * rng.normal(size=shape[1:]) + rng.normal(size=shape)
    squares, _ = anova(values.astype(np.float32).astype(float))
    noise = noise_of(values.astype(np.float32))
    for name, expected in list(variances_of(squares, *shape).items())[:7]:
        # Sums of n < 300 squares of 32-bit numbers, exact to 1e-16 of (1e2)² each: far below 1e-9.
        assert noise.parts[name].variance == pytest.approx(expected, abs=1e-9, rel=1e-9)
    assert noise.mean == pytest.approx(values.mean(), rel=1e-7)


def expected_mean_squares(shape, sd):
    """Return E[MS] by counting: a part is in the mean squares of subsets of its axes, times its values."""
    return {
        name: sum(
            sd[one] ** 2 * math.prod(shape[AXES[axis]] for axis in "tvh" if axis not in one)
            for one in PARTS
            if set(one) >= set(name)
        )
        for name in PARTS
    }


def test_variances_are_unbiased():
    # Weights applied to expected mean squares give the variances exactly; they differ by 1e-12 of rounding.
    shape, sd = (7, 5, 6), dict(zip(PARTS, (0.3, 0.5, 0.7, 0.4, 0.6, 1.0, 2.0), strict=True))
    expected = expected_mean_squares(shape, sd)
    found = variances_of(expected, *shape)
    together = {"dynamic": 0.4**2 + 0.6**2 + 2.0**2, "fixed_pattern": 0.5**2 + 0.7**2 + 1.0**2}
    assert found == pytest.approx({name: one**2 for name, one in sd.items()} | together, rel=1e-12)


def test_one_frame_gives_rows_columns_and_the_rest():
    rng = np.random.default_rng(2)
    sd = dict.fromkeys(PARTS, 0.0) | {"v": 2.0, "h": 3.0, "vh": 1.0}
    result = tod.noise(cube(rng, (1, 200, 300), sd), signal=10.0)
    noise = result.noise
    assert list(noise.parts) == ["v", "h", "vh"]
    assert noise.dynamic is None
    assert codes_of(np.ones((1, 4, 5))) == ["one_frame"]
    for name in noise.parts:  # 95 % intervals; the seed is one of those for which all three hold
        low, high = noise.parts[name].ci95
        assert low < sd[name] < high
    with pytest.raises(tod.DataError, match="found one frame, expected 2 or more: one cannot separate"):
        result.sensor_toml()
    total = sum(one.variance for one in noise.parts.values())
    assert [one.snr for one in noise.snr] == [pytest.approx(10 / math.sqrt(total))]
    none, two = NoisePart(0.0, (0.0, 1.0), -1.0), NoisePart(2.0, (1.0, 3.0), 4.0)
    assert snr_of(10.0, {"dynamic": none, "fixed_pattern": two}) == 5.0
    assert snr_of(10.0, {"dynamic": two, "fixed_pattern": none}, 4) == 10.0
    assert snr_of(1.0, {"vh": none}) == math.inf


def test_the_interval_of_one_mean_square_is_that_of_a_variance():
    # s² (n − 1) / χ² is the textbook's interval; χ² of 0.025 and 0.975 at 10 degrees: 3.24697, 20.48318.
    values = np.random.default_rng(1).normal(size=(1, 2, 11))
    sums = FrameSums(memory_recording(values, frames_per_second=None), None)
    sums.add(values[0])
    square = sums.mean_squares()[0]["vh"]
    part = NoisePart.of(sums.variances()["vh"], None)
    assert part.variance == square
    # Of 4,000 draws the outer 2.5 % are 100 ± 10; the density there makes 3 % of the ends of it.
    assert DRAWS == 4000
    assert part.ci95 == pytest.approx(
        (math.sqrt(10 * square / 20.48318), math.sqrt(10 * square / 3.24697)), rel=0.06
    )


def test_a_negative_variance_is_no_noise():
    part = NoisePart.of(np.append(-0.05, np.linspace(-0.1, 0.02, 101)), None)
    assert (part.sd, part.ci95[0], part.variance) == (0, 0, -0.05) and part.ci95[1] > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(30, 24, 32), (3, 12, 16)])
def test_intervals_hold_the_truth(shape):
    sd = dict(zip(PARTS, (0.3, 0.5, 0.7, 0.4, 0.6, 1.0, 2.0), strict=True))
    n_seeds = 400
    held = dict.fromkeys([*PARTS, "dynamic", "fixed"], 0)
    sums = dict.fromkeys(held, 0.0)
    together = {"dynamic": ("tv", "th", "tvh"), "fixed": ("v", "h", "vh")}
    true = sd | {name: math.hypot(*(sd[one] for one in parts)) for name, parts in together.items()}
    for seed in range(n_seeds):
        noise = noise_of(50 + cube(np.random.default_rng(seed), shape, sd))
        for name, part in (noise.parts | {"dynamic": noise.dynamic, "fixed": noise.fixed_pattern}).items():
            held[name] += part.ci95[0] <= true[name] <= part.ci95[1]
            sums[name] += part.variance
    # A true coverage of 95 % gives 0.95 ± 4 · √(0.95 · 0.05 / 400) = ± 0.044. The large-sample interval is
    # conservative where a part is small against what is taken off, so there is no bound above.
    assert min(held.values()) / n_seeds >= 0.95 - 0.044, held
    # Each variance is near the truth, if 5 standard errors of the largest spread (t, with 2 or 29 degrees).
    for name, total in sums.items():
        spread = 5 * math.sqrt(2 / (shape[0] - 1) / n_seeds)
        assert total / n_seeds == pytest.approx(true[name] ** 2, rel=max(spread, 0.1), abs=0.1)


def test_drift_is_a_straight_line_with_its_error():
    rng = np.random.default_rng(4)
    values = 100 + np.linspace(0, 1, 50)[:, np.newaxis, np.newaxis] + rng.normal(0, 0.1, (50, 20, 30))
    drift = noise_of(values, frames_per_second=10).drift
    # 49 steps of 0.1 s: the slope is 1 / 4.9 per second. The mean of 600 pixels has the SD 0.1 / √600, so the
    # slope's is that over √(Σ t²) = √(50 (50² − 1) / 12) / 10; the estimate of it varies by 1 / √(2 · 48) = 10 %.
    error = 0.1 / math.sqrt(600) / math.sqrt(50 * (50**2 - 1) / 12) * 10
    assert drift.slope_error == pytest.approx(error, rel=0.4)
    assert abs(drift.slope - 1 / 4.9) < 4 * error
    assert drift.change == pytest.approx(4.9 * drift.slope)
    assert codes_of(values) == ["drift"]
    assert fit_drift(np.array([1.0, 2.0]), [None, None]) is None


CUT = {
    "14 bits half cut": (16383, 40.0, 16383, np.uint16, "16383"),
    "12 bits, a tenth": (4095 - 12.816, 10.0, 4095, np.uint16, "4095"),
    "12 bits, 0.2 %": (4095 - 115.1, 40.0, 4095, np.float32, "4095"),
    "shifted up by 4": (4095 * 16, 160.0, 4095 * 16, np.uint16, "65520"),
    "with an offset": (-90, 20.0, -90, np.int16, "-90"),
}


@pytest.mark.parametrize(("mean", "sd", "ceiling", "dtype", "where"), CUT.values(), ids=CUT)
def test_values_are_cut_off_where_they_pile_up(mean, sd, ceiling, dtype, where):
    values = np.minimum(np.random.default_rng(3).normal(mean, sd, (20, 64, 64)), ceiling)
    values = np.rint(values / 16) * 16 if where == "65520" else np.rint(values)
    share = 100.0 * float((values == ceiling).mean())
    scaled = -values / np.float32(65535)
    for stored, end in ((values.astype(dtype), where), (scaled.astype(np.float32), f"{-ceiling / 65535:.6g}")):
        (warning,) = tod.noise(stored).warnings
        assert warning.code == "saturated"
        assert warning.message.startswith(f"{share:.3g} % of the values are at an end of the scale ({end})")


def draws(*distribution, dtype=np.uint16):
    return np.rint(np.random.default_rng(2).normal(*distribution, (20, 64, 64))).astype(dtype)


HONEST = {
    "low noise between two values": (draws(100.5, 0.2), "quantised"),
    "low noise at a value": (draws(100.9, 0.2), "quantised"),
    "noise of half a step": (draws(100.3, 0.5), ""),
    "steps of 16, noise 3.2, half-way": (16 * draws(100.5, 0.2), "quantised"),
    "12 bits repeated in 16": ((lambda v: 16 * v + v // 256)(draws(2000.4, 0.2)), "quantised"),
    "scaled to 1": ((draws(2000.4, 0.2) / 4095).astype(np.float32), "quantised"),
    "continuous": (np.random.default_rng(2).normal(0.5, 1e-4, (20, 64, 64)).astype(np.float32), ""),
    "few photons": (np.random.default_rng(2).poisson(0.5, (20, 64, 64)).astype(np.float32), ""),
    "every value as often": (np.random.default_rng(2).integers(0, 1000, (20, 64, 64)).astype(np.int16), ""),
    "counts of 16 bits": (draws(20000, 3000.0), ""),
}


@pytest.mark.parametrize(("values", "code"), HONEST.values(), ids=HONEST)
def test_few_values_and_coarse_steps_are_not_cut_off(values, code):
    assert codes_of(values) == ([code] if code else [])


def test_bits_state_the_ceiling_and_refuse_values_beyond():
    # 1.5 % of the values at 1023, fewer than at 1022: the data alone do not show a ceiling.
    values = np.minimum(draws(1018, 2.5), 1023)
    assert codes_of(values) == [] and codes_of(values, bits=10) == ["saturated"]
    for call, given in ((tod.noise, 9), (tod.mtf, 9)):
        with pytest.raises(tod.DataError, match=r"found the value 1023, expected at most 511 \(bits 9\)"):
            call(values, bits=given)
    with pytest.raises(tod.SettingsError, match="bits: found 0, expected 1 to 32"):
        tod.noise(values, bits=0)


WALL = np.random.default_rng(21).normal(0, 5, (90, 40, 50)) + np.random.default_rng(22).normal(100, 1, (40, 50))
PATTERNS = np.random.default_rng(23).normal(0, 4, (2, 40, 50))
NO_PATTERN, OTHER_FRAMES = np.zeros((40, 50)), (np.arange(90) % 10 == 3)[:, None, None]


@pytest.mark.parametrize(
    ("added", "after", "n"),
    [
        (np.array([PATTERNS[0] if k >= 30 else NO_PATTERN for k in range(90)]), "30", 60),
        (np.array([NO_PATTERN if k < 20 else PATTERNS[int(k > 75)] for k in range(90)]), "20, 76", 56),
        (
            np.array([20 * PATTERNS[1] if k in (40, 41) else (k > 40) * PATTERNS[0] for k in range(90)]),
            "40, 42",
            48,
        ),
        (OTHER_FRAMES * PATTERNS[0], None, 90),  # a frame that differs leaves no new pattern
        (0.0, None, 90),
    ],
)
def test_a_new_fixed_pattern_within_a_film_is_found(added, after, n):
    """A shutter leaves a new pattern at the same level, which counted as noise from frame to frame."""
    found = tod.noise(WALL + added)
    assert found.noise.n_frames == n
    assert [warning.code for warning in found.warnings] == ["pattern_changes"] * bool(after)
    if after:
        assert f"the fixed pattern changes after {after} of 90 frames" in found.warnings[0].message
        # 95,000 degrees of freedom and more: 5 ± 4 · 5 / √190,000.
        assert found.noise.dynamic.sd == pytest.approx(5.0, abs=0.05)


@pytest.mark.parametrize("changed", [0.0, 0.002, 1.0])
@pytest.mark.parametrize("times", [2, 3, 10])
def test_frames_that_are_delivered_several_times_count_once(times, changed):
    rng = np.random.default_rng(5)
    frames = np.repeat(WALL[:30], times, axis=0)
    frames += (rng.random(frames.shape) < changed) * rng.choice([-1.0, 1.0], frames.shape)
    found = tod.noise(frames, frames_per_second=20.0 * times)
    assert (found.noise.n_frames, found.noise.frames_per_second) == (30, 20.0)
    assert "frames_integrated = 2\n" in found.sensor_toml()
    # 58,000 degrees of freedom: 4 · 5 / √116,000. Values that are one off have a variance of up to 1.
    assert found.noise.dynamic.sd == pytest.approx(math.sqrt(25.0 + changed), abs=0.06)
    (warning,) = found.warnings
    assert (
        warning.code == "doubled_frames" and f"{30 * times - 30} of {30 * times} frames repeat" in warning.message
    )


def test_colour_is_measured_as_luma():
    rng = np.random.default_rng(6)
    grey = rng.normal(10, 1, (5, 8, 9))
    coloured = np.repeat(grey[..., np.newaxis], 3, 3)
    one, two = noise_of(grey), noise_of(coloured)
    # The weights add up to 1; 1e-6 for 32-bit values.
    assert two.dynamic.sd == pytest.approx(one.dynamic.sd, rel=1e-6)


def test_a_region_is_that_part_of_the_frames(tmp_path):
    values = np.random.default_rng(7).normal(10, 1, (5, 20, 30)).astype(np.float32)
    np.save(tmp_path / "a.npy", values)
    part = tod.noise(tmp_path / "a.npy", region=(4, 3, 12, 10))
    whole = tod.noise(np.ascontiguousarray(values[:, 3:13, 4:16]))
    assert part.noise.parts == whole.noise.parts
    np.testing.assert_array_equal(part.images.mean, whole.images.mean)
    for region in ((0, 0, 31, 5), (-1, 0, 5, 5), (0, 0, 1, 5)):
        with pytest.raises(tod.SettingsError, match="expected at least 2 x 2 pixels within the frame of 30 x 20"):
            tod.noise(tmp_path / "a.npy", region=region)


def test_the_maps_are_those_of_numpy():
    values = np.random.default_rng(8).normal(1000, 3, (9, 10, 11)).astype(np.float32)
    images = tod.noise(values).images
    # 32-bit values near 1000, sums in 64 bits.
    np.testing.assert_allclose(images.mean, values.mean(0, dtype=float), rtol=1e-12)
    np.testing.assert_allclose(images.temporal_sd, values.std(0, dtype=float, ddof=1), rtol=1e-9)
    np.testing.assert_allclose(images.frame_means, values.mean((1, 2), dtype=float), rtol=1e-12)


def test_patches_give_the_signal_transfer(tmp_path, todframes):
    levels, rng = (10.0, 20.0, 40.0, 80.0), np.random.default_rng(15)
    scene = np.repeat(np.repeat([[100 + 3 * one for one in levels]], 20, 0), 25, 1)
    frames = scene + rng.normal(0, 1, scene.shape) + rng.normal(0, 2, (30, *scene.shape))
    np.save(tmp_path / "a.npy", frames)
    places = {(25 * k, 0, 25, 20): level for k, level in enumerate(levels)}
    result = tod.noise(tmp_path / "a.npy", patches=places)
    noise, (*_, table) = result.noise, result.tables()
    assert [one["fixed_pattern"] for one in table.records] == [one.fixed.sd for one in noise.patches]
    # A mean of 500 pixels has the SD √(1 + 4/30) / √500 = 0.048; the gain's is that over √Σ(x − x̄)² = 53.6: 9e-4.
    assert noise.signal_transfer.gain == pytest.approx(3, abs=4 * 9e-4)
    assert noise.signal_transfer.offset == pytest.approx(100, abs=4 * 0.05)
    assert noise.signal_transfer.gain_error < 4 * 9e-4
    assert noise.signal_transfer.nonlinearity < 4 * 0.048 / 210
    gain, error = plain(noise.signal_transfer.gain, 4), plain(noise.signal_transfer.gain_error, 2)
    assert result.sentences()[-1] == (
        f"Signal transfer: {gain} ± {error} code values per unit of level; patches deviate from a straight line "
        f"by up to {plain(100 * noise.signal_transfer.nonlinearity, 2)} % of its range."
    )
    assert noise.patches[0].snr == 0
    for one, level in zip(noise.patches[1:], levels[1:], strict=True):
        # The noise of a pixel is √5, its fixed part known to 1 / √(2 · 499) = 3 %.
        assert one.snr == pytest.approx(3 * (level - 10) / math.sqrt(5), rel=0.05)
    pairs = [(",".join(map(str, place)), level) for place, level in places.items()]
    given = [text for place, level in pairs for text in ("--patch", f"{place}={level}")]
    status, out, _ = todframes("noise", tmp_path / "a.npy", *given, "--json")
    assert status == 0 and json.loads(out)["noise"]["signal_transfer"]["gain"] == noise.signal_transfer.gain
    with pytest.raises(tod.SettingsError, match=r"patches: found levels \[5.0\], expected at least two different"):
        tod.noise(tmp_path / "a.npy", patches={(0, 0, 5, 5): 5.0, (5, 5, 5, 5): 5.0})
    dark = tod.noise(np.full((3, 20, 20), 7.0), patches={(0, 0, 5, 5): 1.0, (5, 5, 5, 5): 2.0})
    assert (dark.noise.signal_transfer.gain, dark.noise.signal_transfer.nonlinearity) == (0, 0)


def page_of_patches(chart, scale, patches):
    """Draw a page by hand: markers and patches of known values on 200, `scale` pixels a mm."""
    image = np.full((round(chart.page_height_mm * scale), round(chart.page_width_mm * scale)), 200.0)

    def fill(x_mm, y_mm, width_mm, height_mm, value):
        left, top = round((x_mm - width_mm / 2) * scale), round((y_mm - height_mm / 2) * scale)
        image[top : top + round(height_mm * scale), left : left + round(width_mm * scale)] = value

    module_mm = chart.markers.side_mm / 7
    for (x_mm, y_mm), one in zip(chart.markers.centres_mm, marker_ids(0, chart.key), strict=True):
        fill(x_mm, y_mm, chart.markers.side_mm, chart.markers.side_mm, 20)
        for row, column in np.argwhere(marker_bits(one)):
            fill(x_mm + (column - 3) * module_mm, y_mm + (row - 3) * module_mm, module_mm, module_mm, 200)
    for patch, value in zip(chart.pages[0].patches, patches, strict=True):
        fill(patch.x_mm, patch.y_mm, patch.width_mm, patch.height_mm, value)
    return image


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_the_patches_of_a_chart_are_found(tmp_path, turn):
    levels = (0.1, 0.3, 0.6, 0.8)
    up = Triangle(orientation="up", size_mrad=5.0, size_mm=10.0, x_mm=100.0, y_mm=50.0, contrast=-0.5)
    patches = tuple(
        Patch(x_mm=60 + 25 * k, y_mm=100, width_mm=20, height_mm=16, reflectance=one)
        for k, one in enumerate(levels)
    )
    markers = Markers.in_corners(width_mm=200, height_mm=150, module_mm=4, margin_mm=4)
    sides = {"distance_m": 2.0, "page_width_mm": 200.0, "page_height_mm": 150.0, "polarity": -1}
    pages = (Page(number=0, triangles=(up,), patches=patches),)
    chart = Chart(kind="print", name="patches", key=7, markers=markers, pages=pages, **sides)
    write_chart(tmp_path / "chart.toml", chart)
    image = np.rot90(page_of_patches(chart, 3.0, [40 + 200 * one for one in levels]), turn)
    frames = image + np.random.default_rng(16).normal(0, 1, (5, *image.shape))
    np.save(tmp_path / "a.npy", frames.astype(np.float32))
    result = tod.noise(tmp_path / "a.npy", chart=tmp_path / "chart.toml")
    transfer = result.noise.signal_transfer
    # A patch shows only its own value: 5 · 33 · 42 pixels and more, SD 1, so means to 0.012, 0.01 of them in gain.
    assert [one.level for one in result.noise.patches] == list(levels)
    assert transfer.gain == pytest.approx(200, abs=0.2)
    assert transfer.offset == pytest.approx(40, abs=0.1)
    # 70 % of 60 × 48 pixels.
    assert sorted(result.noise.region[2:]) == pytest.approx([0.7 * 48, 0.7 * 60], abs=1.5)
    np.save(tmp_path / "b.npy", np.full((2, 300, 400), 100.0))
    with pytest.raises(tod.DataError, match=r"found no frame of the page of .*chart\.toml with patches, expected"):
        tod.noise(tmp_path / "b.npy", chart=tmp_path / "chart.toml")
    write_chart(tmp_path / "chart.toml", replace(chart, key=8))
    with pytest.raises(tod.DataError, match=r"with patches \(but a chart with the key 7\), expected"):
        tod.noise(tmp_path / "a.npy", chart=tmp_path / "chart.toml")


@pytest.mark.parametrize(("rate_hz", "n_averaged"), [(None, [1]), (5, [1]), (60, [1, 6]), (160, [1, 16])])
def test_averaging_the_frames_of_0_1_s_lowers_dynamic_noise_alone(rate_hz, n_averaged):
    """The eye averages 6 frames at 60 frames a second, as in the paper."""
    sd = dict.fromkeys(PARTS, 0.0) | {"vh": 1.0, "tvh": 2.0}
    frames = cube(np.random.default_rng(9), (40, 60, 70), sd)
    noise = noise_of(frames, frames_per_second=rate_hz, signal=10.0)
    assert [one.frames for one in noise.snr] == n_averaged
    # SD of estimates: below 1/√(2 · 4199) of 1 + 4/40, and less; 4 % is more than 3 of them.
    for one in noise.snr:
        assert one.snr == pytest.approx(10 / math.sqrt(1 + 4 / one.frames), rel=0.04)


def test_a_measured_camera_is_a_sensor(tmp_path):
    sd = dict.fromkeys(PARTS, 0.0) | {"vh": 3.0, "tvh": 5.0}
    np.save(tmp_path / "a.npy", 7000 + cube(np.random.default_rng(10), (30, 80, 80), sd))
    first = tod.noise(tmp_path / "a.npy", mk_per_count=8.0)
    whole = (REAL.parents[1] / "sample_frames" / "star_like.toml").read_text()
    before, rest = whole.partition("[noise]")[0], whole.partition("[electronics]")[2]
    (tmp_path / "sensor.toml").write_text(before + first.sensor_toml() + "\n[electronics]" + rest)
    noise = ss.load_sensor(tmp_path / "sensor.toml").noise
    assert noise.distribution == "gaussian"
    assert noise.frames_integrated == 1
    assert noise.netd_mk == pytest.approx(40, rel=0.01)  # 5 counts of 8 mK, to 1/√(2 · 29 · 79²) and far less
    assert noise.fixed_pattern_ratio == pytest.approx(3 / 5, rel=0.04)  # three times 1/√(2 · 79²) and 1 %


def test_a_real_thermal_frame_is_measured_in_mk(todframes):
    status, out, _ = todframes("noise", REAL / "frame_000000.fff", "--region", "200,150,200,200", "--strict")
    assert status == 1
    assert "one frame: its temporal noise cannot be separated from its fixed pattern" in out
    assert "mK" in out
    found = tod.noise(REAL / "frame_000000.fff")
    # Planck's law by differences: dT/dS = T² (r1/(r2 (S + o)² )) / (b (r1/(r2 (S + o)) + f)), over the emissivity;
    # at 285 K and the file's constants about 25 mK a count.
    radiance = found.noise.mean / 0.93994 - 0.06006 / 0.93994 * 2570 - 228
    argument = 364058 / radiance + 1
    kelvin = 1428 / math.log(argument)
    slope = kelvin**2 * 364058 / radiance**2 / argument / 1428 / 0.93994
    assert found.noise.mk_per_unit == pytest.approx(1000 * slope, rel=0.01)


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        (["--mk-per-count", "0"], 2, "--mk-per-count: found 0.0, expected a finite number > 0"),
        (["--patch", "1,2,3,4=a"], 2, "--patch: found '1,2,3,4=a', expected X,Y,W,H=LEVEL"),
        (["--sensor"], 1, "found one frame, expected 2 or more"),
        (["--sensor", "--json"], 2, "found --sensor and --json, expected one of them"),
        (["--signal", "a"], 2, "--signal: found 'a', expected numbers"),
    ],
)
def test_bad_requests_are_told_in_one_line(tmp_path, todframes, options, status, message):
    np.save(tmp_path / "a.npy", np.zeros((4, 5)))
    found, out, err = todframes("noise", tmp_path / "a.npy", "--quiet", *options)
    assert (found, out) == (status, "")
    assert message in err.splitlines()[-1]


def test_two_recordings_and_frames_without_noise_are_refused(tmp_path):
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.zeros((3, 4, 5)))
    with pytest.raises(tod.DataError, match="noise: found 2 recordings"):
        tod.noise([tmp_path / "a.npy", tmp_path / "b.npy"])
    with pytest.raises(tod.DataError, match="found none from frame to frame, expected some"):
        tod.noise(tmp_path / "a.npy").sensor_toml()
