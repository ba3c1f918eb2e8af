"""Figures show the numbers of their results: lines, bars, bands and marks, read back from matplotlib."""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from test_emva import LEVELS, stacks

import todframes as tod
from sensor_sim.sweeps.result import Sweep
from todframes.comparison.records import ComparedCondition, Comparison, ContrastResponse, Ratio
from todframes.enhancement.contrast_gain import ContrastPoint
from todframes.psychometrics.curves import FitPoint
from todframes.results.data import Fit
from todframes.results.figures import MOST_CURVES, MOST_IN_LEGEND, PAPER
from todframes.results.result import Result, read_result
from todframes.results.thresholds import Thresholds
from todframes.results.wording import subsample


def drawn(result: Result, number: int = 0) -> Axes:
    axes = Figure().subplots()
    result.figures()[number].draw(axes)
    return axes


def points(axes: Axes) -> dict[str, Any]:
    """Points of each line of the legend."""
    return {line.get_label(): line.get_xydata().tolist() for line in axes.lines if line.get_label()[0] != "_"}


def unnamed(axes: Axes, style: str | None = None) -> list[Any]:
    """Points of the lines that are not in the legend, of one line style."""
    lines = [line for line in axes.lines if line.get_label()[0] == "_"]
    return [line.get_xydata().tolist() for line in lines if style in (None, line.get_linestyle())]


def legend(axes: Axes) -> list[str]:
    found = axes.get_legend()
    return [] if found is None else [text.get_text() for text in found.get_texts()]


def fit(size: float, threshold: float | None, status: str = "ok", **more: Any) -> Fit:
    shown = {"group": {"size_mrad": size}, "level": "contrast", "p_correct": 0.75, "guess_rate": 0.25}
    return Fit(**shown | {"threshold": threshold, "status": status, "n_trials": 40} | more)


def fitted(*fits: Fit) -> Result:
    return Thresholds.made("fit", 0.0, fits=fits)


def segments(axes: Axes) -> list[Any]:
    """Ends of the bars and lines of collections."""
    return [
        one.tolist()
        for lines in axes.collections
        if hasattr(lines, "get_segments")
        for one in lines.get_segments()
    ]


def test_tod_curves_have_thresholds_intervals_and_open_ends() -> None:
    group = [{"eye": eye, "size_mrad": size} for eye in ("left", "right") for size in (1.0, 2.0)]
    fits = (
        fit(1.0, 0.4, group=group[0], threshold_ci95=(0.3, 0.6)),
        fit(2.0, 0.2, "extrapolated", group=group[1], threshold_ci95=(0.1, None)),
        fit(1.0, 0.8, group=group[2]),
        fit(2.0, None, "never_reached", group=group[3]),
    )
    axes = drawn(fitted(*fits))
    assert points(axes) == {"eye left": [[1.0, 0.4], [0.5, 0.2]], "eye right": [[1.0, 0.8]]}
    assert legend(axes) == ["eye left", "eye right"]
    assert unnamed(axes, "-") == [[[1.0, 0.3], [1.0, 0.6]], [[0.5, 0.1], [0.5, 0.2]], [[0.5, 0.2]]]
    assert unnamed(axes, ":") == [[[0.5, 0.2], [0.5, axes.get_ylim()[1]]]]
    assert [tick.get_text() for tick in axes.child_axes[0].get_xticklabels()] == ["2", "1"]  # 1 / size = 0.5 and 1
    # Of sizes that nearly coincide one is named.
    close = [fit(size, 0.1 / size, group={"size_mrad": size}) for size in (1.0, 2.0, 3.0, 3.1, 4.0)]
    top = drawn(fitted(*close)).child_axes[0]
    assert [tick.get_text() for tick in top.get_xticklabels()] == ["4", "3.1", "2", "1"]
    assert legend(drawn(fitted(*fits[:2]))) == []
    note = "Threshold contrast at 75 % correct against 1 / size."
    assert fitted(*fits).figures()[0].note == (
        f"{note} Filled: within the levels shown; open: extrapolated. Vertical lines are 95 % intervals, dotted "
        "where the data leave an end open."
    )
    computed = [fit(size, 0.4, n_trials=0, threshold_ci95=(0.3, 0.5)) for size in (1.0, 2.0)]
    assert fitted(*computed).figures()[0].note == f"{note} Vertical lines are 95 % intervals."
    heated = [fit(size, snr, level="snr", delta_t_mk=20.0 * snr) for size, snr in ((1.0, 2.0), (2.0, 1.0))]
    right = drawn(fitted(*heated)).child_axes[1]
    right.figure.draw_without_rendering()
    assert right.get_ylabel() == "ΔT (mK)"
    assert right.get_ylim() == pytest.approx([20.0 * end for end in right._parent.get_ylim()])


@pytest.mark.parametrize("n", [1, MOST_IN_LEGEND, MOST_IN_LEGEND + 1, MOST_CURVES + 6])
def test_psychometric_functions_have_points_curve_criterion_and_guess_rate(n: int) -> None:
    """Weibull functions in closed form: 1 − δ − (1 − δ − γ) 2^−(x/α)^β; of very many, some are drawn."""
    levels, trials = (0.1, 0.2, 0.4), (10, 40, 20)
    shown = tuple(FitPoint(*one) for one in zip(levels, trials, (0.3, 0.6, 0.9), strict=True))
    curve = {"alpha": 0.2, "beta": 2.0, "lapse_rate": 0.02, "points": shown}
    fits = [fit(1.0 + number, 0.2, **curve) for number in range(n)]
    axes = drawn(fitted(fit(0.5, 0.2), *fits), -1)
    curves, dots = [line for line in axes.lines if len(line.get_xdata()) == 100], axes.collections
    chosen = subsample(fits, MOST_CURVES)
    assert len(curves) == len(dots) == len(chosen) == min(n, MOST_CURVES)
    assert [one.get_label() for one in dots] == [f"{one.group['size_mrad']:g} mrad" for one in chosen]
    assert len(legend(axes)) == (n if n <= MOST_IN_LEGEND else 0)
    x = np.geomspace(0.1, 0.4, 100)
    np.testing.assert_allclose(curves[0].get_xdata(), x)
    np.testing.assert_allclose(curves[0].get_ydata(), 0.98 - 0.73 * 2.0 ** -((x / 0.2) ** 2.0))
    assert dots[0].get_offsets().tolist() == [[0.1, 0.3], [0.2, 0.6], [0.4, 0.9]]
    assert dots[0].get_sizes()[1] == max(dots[0].get_sizes()) > dots[0].get_sizes()[0]
    assert [line.get_ydata()[0] for line in axes.lines[-2:]] == [0.75, 0.25]
    assert (axes.get_ylim(), axes.get_ylabel()) == ((0.0, 1.02), "proportion correct")


def test_computed_points_are_joined_where_no_curve_was_fitted() -> None:
    shown = tuple(FitPoint(level, 0, p) for level, p in ((0.1, 0.3), (0.2, 0.6)))
    axes = drawn(fitted(fit(1.0, 0.15, points=shown)))
    assert unnamed(axes, "-") == [[[0.1, 0.3], [0.2, 0.6]]]
    with pytest.raises(tod.DataError, match="plot: the result of fit has nothing to draw"):
        fitted(fit(1.0, None, "never_reached")).plot()
    assert len(set(axes.collections[0].get_sizes())) == 1


def test_persons_have_marks_and_their_models_lines(results) -> None:
    made = results["calibrate"]
    person = made["persons"][0]
    person["predicted"] = [one | {"threshold": 1.5 * one["threshold"]} for one in person["predicted"]]
    axes = drawn(read_result(json.dumps(made).encode(), "made"))
    model, *_ = axes.lines
    assert model.get_xydata().tolist() == [[1.0, 1.5], [0.5, 0.75], [0.25, 0.375]]
    marks = [line for line in axes.lines if line.get_label() in ("subject m1", "subject p2")]
    assert [line.get_xydata().tolist() for line in marks] == [[[1.0, 1.0], [0.5, 0.5], [0.25, 0.25]]] * 2
    assert [line.get_linestyle() for line in marks] == ["None"] * 2


FITS = (fit(1.0, 0.2), fit(2.0, 0.1))


def test_compared_curves_have_the_eye_and_the_nyquist_frequency_of_each_camera() -> None:
    """A period of two pixels of 0.3 and 0.2 mrad; pixels of 0.01 mrad are too far from sizes of 1 mrad."""
    pixels = {"a": 0.3, "b": 0.2, "c": 0.01, "d": 0.2}
    conditions = tuple(ComparedCondition(name=name, fits=FITS, pixel_size=of) for name, of in pixels.items())
    axes = drawn(Comparison.made("compare", 0.0, conditions=conditions, eye=(fit(1.0, 0.05), fit(2.0, 0.02))))
    names = [text for text in axes.texts if text.get_text() == "Nyquist"]
    assert [text.xy[0] for text in names] == pytest.approx([1 / 0.6, 1 / 0.4])
    ((_, below),) = (line.get_xydata().T for line in axes.lines if line.get_linestyle() == "--")
    assert below.tolist() == [0.05, 0.02]
    assert axes.get_ylim()[0] < 0.02


def test_ratios_have_intervals_and_are_filled_where_a_difference_is_shown() -> None:
    names, whole = ("ratio", "verdict", "ratio_ci95"), Ratio(ratio=1.5, verdict="worse", ratio_ci95=(1.2, 1.8))
    each = {
        "blur": ((2.0, "worse", (1.5, 2.5)), (1.2, "no difference shown", (0.5, None))),
        "sharp": ((0.5, "better", (0.4, 0.6)), (None, "lost", (None, None))),
    }
    compared = []
    for name, values in each.items():
        own = (dict(zip(names, one, strict=True)) for one in values)
        ratios = tuple(Ratio(group=at.group, **one) for at, one in zip(FITS, own, strict=True))
        compared.append(ComparedCondition(name=name, fits=FITS, ratios=ratios, overall=whole))
    none = ComparedCondition(name="none", spec="none", fits=FITS)
    axes = drawn(Comparison.made("compare", 0.0, conditions=(none, *compared)))
    assert legend(axes) == ["blur", "sharp"]
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["1 mrad", "2 mrad", "all groups"]
    left, right = -0.15, 0.15  # two algorithms share 0.6 of the width of a group
    bars = [(left, 1.5, 2.5), (2 + left, 1.2, 1.8), (right, 0.4, 0.6), (2 + right, 1.2, 1.8)]
    assert unnamed(axes, "-")[:-1] == [pytest.approx(np.array([[x, low], [x, high]])) for x, low, high in bars]
    assert unnamed(axes, "-")[-1] == [[0.0, 1.0], [1.0, 1.0]]  # the reference
    assert unnamed(axes, ":") == [[[1 + left, 0.5], [1 + left, 1.2]]]
    marks = [line for line in axes.lines if line.get_linestyle() == "None" and len(line.get_xdata())]
    assert [line.get_ydata()[0] for line in marks] == [2.0, 1.2, 1.5, 0.5, 1.5]
    assert [line.get_markerfacecolor() == PAPER for line in marks] == [False, True, False, False, False]
    assert axes.get_xlim() == (-0.5, 2.5)


def test_contrasts_after_an_algorithm_have_errors_and_the_line_of_no_change() -> None:
    shown = tuple(
        ContrastPoint(level=before, before=before, after=2.0 * before, gain=2.0, gain_standard_error=0.1)
        for before in (0.1, 0.4, 0.0)
    )
    twice = ComparedCondition(name="twice", fits=FITS, contrast_responses=(ContrastResponse(points=shown),))
    none = ComparedCondition(name="none", spec="none", fits=FITS)
    result = Comparison.made("compare", 0.0, conditions=(none, twice))
    (number,) = (k for k, one in enumerate(result.figures()) if one.file == "contrast_response.png")
    axes = drawn(result, number)
    assert legend(axes) == ["twice"]
    of_points, no_change = (one for one in unnamed(axes, "-") if len(one) == 2)
    assert (of_points, no_change) == ([[0.1, 0.2], [0.4, 0.8]], [[0.1, 0.1], [0.4, 0.4]])
    ends = np.array(segments(axes))[..., 1]
    np.testing.assert_allclose(ends, [[0.18, 0.22], [0.72, 0.88]])  # two standard errors of the gain


def test_noise_has_bars_with_intervals_the_means_of_frames_and_images() -> None:
    frames = 100.0 + 5.0 * np.arange(6)[:, None, None] + np.random.default_rng(1).normal(0.0, 1.0, (6, 16, 12))
    result = tod.noise(frames, frames_per_second=50.0)
    _, mean, drift = result.sentences()
    assert re.fullmatch(r"Mean 112\.\d\d code values in 6 frames\.", mean)
    assert re.fullmatch(r"Drift of the mean: 250 ± \d\.\d+ per s, 25\.0 in all\.", drift)  # 5 a frame
    axes = drawn(result)
    parts = result.noise.parts
    assert [bar.get_height() for bar in axes.patches] == [one.sd for one in parts.values()]
    assert axes.get_ylabel() == "SD (code values)"
    most = 3.0 * max(one.sd for one in parts.values())
    for ((_, low), (_, high)), one in zip(segments(axes), parts.values(), strict=True):
        assert (low, high) == pytest.approx((min(one.ci95[0], one.sd), max(min(one.ci95[1], most), one.sd)))
    titles = [one.title for one in result.figures()]
    (means,) = drawn(result, titles.index("Mean of each frame")).lines
    assert means.get_xdata() == pytest.approx(np.arange(6) / 50.0)
    assert means.get_ydata() == pytest.approx(frames.mean(axis=(1, 2)))
    (image,) = drawn(result, titles.index("Mean of each frame") + 1).images
    assert image.get_clim() == pytest.approx(np.percentile(np.asarray(image.get_array()), (0.5, 99.5)))


def test_photon_transfer_and_signal_to_noise_are_those_of_the_points() -> None:
    result = tod.emva_noise(**stacks(n=2))
    numbers = result.noise.emva1288
    names = ("signal_dn", "variance_dn2", "snr")
    x, variances, snr = ([getattr(one, name) for one in numbers.points] for name in names)
    ratios, transfer = (
        {name: np.array(xy) for name, xy in points(drawn(result, number)).items()} for number in (0, 1)
    )
    np.testing.assert_array_equal(transfer.pop("in the fit"), np.transpose([x, variances]))
    (line,) = transfer.values()
    np.testing.assert_allclose(line, [[0.0, 0.0], [max(x), numbers.system_gain * max(x)]])
    light, ideal = ratios["ideal: every photon counts"].T
    np.testing.assert_allclose(ideal, light**0.5)
    measured = ratios["measured"]
    np.testing.assert_array_equal(measured[:, 1], snr)
    # 2 frames of 4,096 pixels: the photons that the points have, and the noise of the fitted camera, by 5 %.
    np.testing.assert_allclose(measured[:, 0], [*LEVELS.values()], rtol=0.05)
    temporal, total = (ratios[name][:, 1] for name in ("temporal noise", "with DSNU and PRNU"))
    np.testing.assert_allclose(np.interp(measured[:, 0], light, temporal), snr, rtol=0.05)
    assert (total < temporal).all() and (temporal < ideal).all()


def swept(values: dict[str, list[float]], columns: dict[str, list[Any]], *minimise: str) -> Result:
    """A sweep at 4 and 6 detectors whose numbers are given; rows of a design are together."""
    n = len(next(iter(values.values())))
    settings = {"sensor": {"name": "camera"}, "size_detectors": [4.0, 6.0], "maximise": []}
    settings |= {"minimise": ["threshold_snr", *minimise], "keep_fill_factor": False, "couple_netd": False}
    snr, keys = columns["threshold_snr"], {key: np.repeat(value, 2).tolist() for key, value in values.items()}
    full = {"design": np.repeat(np.arange(1, n + 1), 2).tolist(), **keys, "reason": [None] * 2 * n}
    full |= {
        "status": ["never_reached" if one is None else "ok" for one in snr],
        "on_front": [0.0] * 2 * n,
    } | columns
    more = {"columns": full, "keys": tuple(values), "n_designs": n, "n_computed": n}
    return Sweep.made("sweep", 0.0, **more, settings=settings)


GRID = {"optics.aperture_mm": [10.0, 10.0, 20.0, 20.0], "noise.netd_mk": [16.0, 48.0, 16.0, 48.0]}
SNR: list[float | None] = [4.0, 3.0, 8.0, 6.0, 2.0, 1.0, None, 2.0]


def on_map(axes: Axes) -> list[list[float]]:
    """Places of the designs and their values, those that are drawn last in the end."""
    shown = axes.collections[0]
    return np.column_stack([shown.get_offsets(), shown.get_array()]).tolist()


def test_a_sweep_has_its_curves_map_and_front() -> None:
    result = swept(GRID, {"threshold_snr": SNR})
    curves = [(3.0, 4.0), (6.0, 8.0), (1.0, 2.0)]  # a design with one threshold has none
    assert segments(result.plot_tod()) == [[[1 / 6, six], [1 / 4, four]] for six, four in curves]
    assert result.plot_tod().collections[0].get_array().tolist() == [10.0, 10.0, 20.0]
    assert on_map(result.plot_map()) == [[10.0, 48.0, 8.0], [10.0, 16.0, 4.0], [20.0, 16.0, 2.0]]
    assert sorted(at[2] for at in on_map(result.plot_map(1))) == [1.0, 2.0, 3.0, 6.0]
    assert [one.title for one in result.figures()] == ["Map at 4 detectors", "Map at 6 detectors", "TOD curves"]
    (problem,) = result.tables()[1].records
    assert [problem[key] for key in ("status", "thresholds", "first_design")] == ["never_reached", 1, 4]
    # A longer range is better where a third key hides designs behind one another.
    both = {key: value * 2 for key, value in GRID.items()} | {"display.gain": [1.0] * 4 + [2.0] * 4}
    of_range = {"range_km": np.repeat([1.0, 2.0, 3.0, None, 5.0, 1.0, 2.0, 4.0], 2).tolist()}
    of_range |= {"range_at_least_km": [None] * 14 + [4.0] * 2, "range_status": ["ok"] * 16}
    longest = swept(both, of_range | {"threshold_snr": SNR * 2})
    on_top = {(x, y): value for x, y, value in on_map(longest.plot_range_map())}
    assert on_top == {(10.0, 16.0): 5.0, (20.0, 16.0): 3.0, (10.0, 48.0): 2.0, (20.0, 48.0): 4.0}
    assert longest.figures()[0].title == "Map of range"
    assert "The range of 1 design is beyond the smallest size, at 4.00 km or more" in " ".join(longest.sentences())
    on_front = {"on_front": [1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]}
    keys = ("optics.aperture_mm", "noise.netd_mk")
    traded, three = (swept(GRID, {"threshold_snr": SNR} | on_front, *keys[:n]) for n in (1, 2))
    axes = traded.plot_front()
    assert [one.plot_front().lines[0].get_linestyle() for one in (traded, three)] == ["-", "None"]
    assert axes.collections[0].get_offsets().tolist() == [[10.0, 4.0], [10.0, 8.0], [20.0, 2.0]]
    assert points(axes) == {"trade-off front": [[10.0, 4.0], [20.0, 2.0]]}
    assert [one["design"] for one in traded.tables()[0].records] == [3, 1]
    assert traded.figures()[0].title == "Trade-off at 4 detectors"


def test_impossible_and_never_reached_designs_look_different_on_the_map() -> None:
    snr: list[float | None] = [None] * 6 + [2.0, 2.0]
    statuses = ["impossible", "never_reached", "always_exceeded", "ok"]
    status = {"status": np.repeat(statuses, 2).tolist(), "threshold_snr": snr}
    _, *marked = swept(GRID, status).plot_map().collections
    assert [one.get_offsets().tolist() for one in marked] == [[[10.0, 16.0]], [[10.0, 48.0]], [[20.0, 16.0]]]
    assert len({one.get_paths()[0].vertices.tobytes() for one in marked}) == 3
    with pytest.raises(tod.DataError, match="plot_map: found no threshold at this size"):
        swept(GRID, {"threshold_snr": [None] * 8}).plot_map()


def test_one_varied_number_has_a_line_for_each_size() -> None:
    axes = drawn(swept({"noise.netd_mk": [48.0, 16.0]}, {"threshold_snr": [2.0, 3.0, None, 1.0]}))
    assert legend(axes) == list(points(axes)) == ["4 detectors", "6 detectors"]
    np.testing.assert_array_equal(list(points(axes).values()), [[[16, np.nan], [48, 2]], [[16, 1], [48, 3]]])
    assert [axes.get_xscale(), axes.get_yscale()] == ["linear", "log"]
    wide = drawn(swept({"noise.netd_mk": [5.0, 50.5]}, {"threshold_snr": [2.0, 3.0, 4.0, 1.0]}))
    assert wide.get_xscale() == "log"
