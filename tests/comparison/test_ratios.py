"""Conditions side by side: true ratios from paired and separate trials, intervals, curves between sizes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from todframes.base.errors import DataError, SettingsError
from todframes.comparison.conditions import comparable, split_by
from todframes.comparison.ratios import Measured, compare_measured, random_effects_weights
from todframes.comparison.records import ComparedCondition, basis_of, comparisons, named
from todframes.comparison.records import JudgedBy as Judged
from todframes.psychometrics.curves import weibull
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.results.data import Fit
from todframes.scoring.paired import TrialSeries

LEVELS = np.geomspace(0.5, 2.0, 7)
FAST = FitSettings(resamples=200)


def experiment(
    name: str,
    thresholds: dict[float, float],
    *,
    common: int,
    own: int,
    n_trials: int = 12,
    sampled: bool = False,
    noise: float = 0.2,
    own_noise: float = 0.2,
    settings: FitSettings = FAST,
    scenes: np.ndarray | None = None,
    levels: np.ndarray = LEVELS,
) -> Measured:
    """Simulate trials at sizes with true thresholds: answers of a Weibull curve with β = 2, to levels with noise.

    Noise of the seed `common` is in other experiments too, and that of `own` in this one.
    """
    shared, alone = np.random.default_rng(common), np.random.default_rng([1, own])
    shown, answers, rows, fits, records = [], [], [], [], []
    level = np.repeat(levels, n_trials)
    for number, (size, threshold) in enumerate(thresholds.items()):
        deviations = shared.normal(0.0, noise, level.size) + alone.normal(0.0, own_noise, level.size)
        seen = level * np.exp(deviations) / threshold
        p = weibull(seen, alpha=1.0 / math.sqrt(math.log2(3.0)), beta=2.0, guess_rate=0.25, lapse_rate=0.0)
        p = (alone.random(level.size) < p).astype(float) if sampled else p
        curve = "weibull" if sampled else "observer"
        fits.append(fit_trials(level, p, curve=curve, settings=settings, rng=np.random.default_rng(own)))
        records.append(Fit.of_counts({"size_mrad": size}, "contrast", fits[-1]))
        rows.append(np.arange(level.size) + number * level.size)
        shown.append(np.column_stack([np.zeros((level.size, 2)), level]))
        answers.append(p)
    trials = TrialSeries(np.concatenate(shown), np.concatenate(answers), rows, fits, scenes)
    return Measured(name=name, source=name, fits=tuple(records), trials=trials, fit_settings=settings)


def computed(name: str, thresholds: dict[float, float], error: float = 0.0, **more) -> Measured:
    fits = tuple(
        Fit(
            group={"size_mrad": size},
            level="contrast",
            status="ok",
            threshold=threshold,
            threshold_numerical_error=error * threshold,
            p_correct=0.75,
        )
        for size, threshold in thresholds.items()
    )
    return Measured(name=name, source=name, fits=fits, **more)


def compared(*conditions: Measured, weighted: bool = True, seed: int = 1):
    return compare_measured(conditions, seed=seed, weighted=weighted)


def sentences(*conditions: Measured) -> list[str]:
    """Return what a page says first."""
    found = compared(*conditions)
    records = [
        ComparedCondition(
            name=one.name,
            fits=one.fits,
            **(
                {"ratios": of.ratios, "overall": of.overall, "by": of.by, "verdict": of.ratios[0].verdict}
                if of
                else {}
            ),
        )
        for one, of in zip(conditions, [None, *found], strict=True)
    ]
    return [*comparisons(named([Judged(settings={}, conditions=tuple(records))])), *basis_of(records, found)]


A, B = {1.0: 1.0, 2.0: 0.8}, {1.0: 1.3, 2.0: 1.04}


@pytest.mark.parametrize("is_computed", [False, True])
def test_levels_need_not_lie_about_one(is_computed: bool) -> None:
    """A curve that was computed, and trials at other levels, hold the ratio 1.3 as closely as the same levels."""
    # In units of 1/30, as kelvins are of thresholds in them.
    first, second = ({size: threshold / 30.0 for size, threshold in of.items()} for of in (A, B))
    other = experiment("B", second, common=2, own=2, levels=LEVELS / 24.0)
    reference = (
        computed("A", first, 0.01)
        if is_computed
        else experiment("A", first, common=1, own=1, levels=LEVELS / 30.0)
    )
    (found,) = compared(reference, other)
    for ratio in (*found.ratios, found.overall):
        low, high = ratio.ratio_ci95
        assert low < 1.3 < high < 1.35 * low


def test_a_threshold_that_nobody_knows_shows_no_difference() -> None:
    reference = computed("A", {1.0: 30.0, 2.0: 20.0}, 0.01)
    unknown = computed("B", {1.0: 1.0, 2.0: 1.0})
    lost = [structs.replace(fit, threshold=None, status="never_reached", n_trials=40) for fit in unknown.fits]
    (found,) = compared(reference, replace(unknown, fits=tuple(lost)))
    assert {ratio.verdict for ratio in (*found.ratios, found.overall)} == {"no difference shown"}


def test_a_condition_against_itself_is_one_and_nothing_else() -> None:
    one = experiment("A", A, common=1, own=1)
    for same in (replace(one, name="again"), replace(one, name="without trials", trials=None)):
        (found,) = compared(one, same)
        assert found.by == ("paired_trials" if same.trials else "same_thresholds")
        for ratio in (*found.ratios, found.overall):
            assert (ratio.ratio, ratio.ratio_ci95, ratio.p_value_holm) == (1.0, (1.0, 1.0), 1.0)
            assert ratio.verdict == "no difference shown"


def test_paired_trials_know_the_ratio_better_than_separate_ones() -> None:
    """Both hold 1.3; what both experiments share is most of the noise, and vanishes from pairs."""
    how = {"noise": 0.3, "own_noise": 0.05}
    first, pair = (
        experiment(name, of, common=1, own=n, **how) for n, (name, of) in enumerate([("A", A), ("B", B)])
    )
    apart = experiment("B", B, common=2, own=2, n_trials=13, **how)
    (paired,), (separate,) = compared(first, pair), compared(first, apart)
    assert (paired.by, separate.by) == ("paired_trials", "separate_trials")
    widths = []
    for found in (paired.overall, separate.overall):
        low, high = found.ratio_ci95
        assert low < 1.3 < high and found.verdict == "worse"
        widths.append(math.log(high / low))
    assert widths[0] < 0.5 * widths[1]


def test_order_of_the_conditions_turns_the_ratio_over() -> None:
    one, other = experiment("A", A, common=1, own=1), experiment("B", B, common=2, own=2, n_trials=9)
    (forward,), (back,) = compared(one, other), compared(other, one)
    for there, again in zip((*forward.ratios, forward.overall), (*back.ratios, back.overall), strict=True):
        assert there.ratio * again.ratio == pytest.approx(1.0, rel=0.01)  # of the mean, weights are those of draws
        assert {there.verdict, again.verdict} <= {"better", "worse"} and there.verdict != again.verdict
    (third,) = compared(one, replace(other, name="C"))
    assert third.ratios == forward.ratios


def test_intervals_of_computed_curves_are_their_numerical_errors() -> None:
    """Independent errors of ± 1 % each make ± √2 % of the ratio; 2,000 draws know an end to 5 % of that."""
    exact, error = computed("A", {1.0: 0.1, 2.0: 0.05}), 0.01
    settings = {"fit_settings": FitSettings(resamples=2000)}
    (found,) = compared(
        computed("A", {1.0: 0.1, 2.0: 0.05}, error, **settings),
        computed("B", {1.0: 0.13, 2.0: 0.065}, error, **settings),
    )
    assert found.by == "intervals"
    for ratio in found.ratios:
        assert ratio.ratio == pytest.approx(1.3)
        assert [math.log(end / 1.3) for end in ratio.ratio_ci95] == pytest.approx([-0.0141, 0.0141], rel=0.1)
    assert math.log(found.overall.ratio_ci95[1] / 1.3) == pytest.approx(0.01, rel=0.1)  # the mean of two
    (sure,) = compared(exact, computed("B", {1.0: 0.13, 2.0: 0.065}))
    assert sure.ratios[0].ratio_ci95 == pytest.approx((1.3, 1.3))


def test_between_two_sizes_ln_threshold_is_linear_in_the_inverse_size() -> None:
    """On thresholds exp(1 / size) that is exact; sizes beyond the ends are left out."""
    one = computed("A", {size: math.exp(1.0 / size) for size in (0.5, 1.0, 2.0)})
    other = computed("B", {size: 1.3 * math.exp(1.0 / size) for size in (0.8, 1.0, 1.5, 4.0)})
    (found,) = compared(one, other)
    assert [ratio.group["size_mrad"] for ratio in found.ratios] == [0.8, 1.0, 1.5, 2.0]
    assert [ratio.ratio for ratio in found.ratios] == pytest.approx([1.3] * 4)
    assert [group["size_mrad"] for group in found.interpolated] == [0.8, 1.5, 2.0]
    assert [group["size_mrad"] for group in found.left_out] == [0.5, 4.0]
    texts = sentences(one, other)
    assert texts[0].startswith(
        "B needs 1.30 times the contrast of A (1.30 to 1.30) over 4 sizes; 1.30 times at 0.8 mrad"
    )
    assert "What only one of two curves has is left out: 2 thresholds beside B." in texts


def test_no_sizes_in_common_and_open_intervals_are_stated() -> None:
    one, other = computed("A", {1.0: 0.1}), computed("B", {2.0: 0.1})
    (found,) = compared(one, other)
    assert found.ratios == () and len(found.left_out) == 2
    open_end = replace(
        one, name="open", fits=(Fit(group={"size_mrad": 1.0}, level="contrast", status="ok", threshold=0.2,
                                    threshold_ci95=(0.15, None), p_correct=0.75, n_trials=9),),
    )  # fmt: skip
    (half,) = compared(one, open_end)
    low, high = half.ratios[0].ratio_ci95
    assert low == pytest.approx(1.5, rel=0.02) and high is None


def test_weights_are_those_of_dersimonian_and_laird() -> None:
    """Alike values have the weights of their variances; very unlike ones are weighed alike. By hand for two."""
    assert random_effects_weights(np.array([0.1, 0.1]), np.array([1.0, 2.0])) == pytest.approx([0.8, 0.2])
    assert random_effects_weights(np.array([0.0, 100.0]), np.array([1.0, 2.0])) == pytest.approx(
        [0.5, 0.5], abs=1e-3
    )
    # Weights 1 and 1/4 of 0 and 3 have the mean 0.6 and Q = 0.36 + 0.25 · 5.76 = 1.8, by which τ² is:
    between = 0.8 / (1.25 - 1.0625 / 1.25)
    weights = np.array([1.0 / (1.0 + between), 1.0 / (4.0 + between)])
    found = random_effects_weights(np.array([0.0, 3.0]), np.array([1.0, 2.0]))
    assert found == pytest.approx(weights / weights.sum())


# What cannot be compared


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"level": "delta_t_k"}, r"B cannot be compared with A: found thresholds in ΔT \(K\), expected contrast"),
        ({"group": {"size_detectors": 1.0}}, "found size_detectors, expected size_mrad"),
        ({"group": {"size_mrad": 1.0, "camera": "x"}}, "found size_mrad, camera, expected size_mrad"),
        ({"p_correct": 0.5}, r"found thresholds at 50 % correct, expected 75 % correct"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_a_line(change, message: str) -> None:
    from msgspec import structs

    one, other = computed("A", {1.0: 0.1, 2.0: 0.1}), computed("B", {1.0: 0.1, 2.0: 0.1})
    more = {"group": {"size_mrad": 2.0, "camera": "y"}} if "camera" in change.get("group", {}) else {}
    fits = tuple(
        structs.replace(fit, **change | (more if number else {})) for number, fit in enumerate(other.fits)
    )
    with pytest.raises(DataError, match=message):
        comparable([one, replace(other, fits=fits)])


def test_other_observers_are_refused_and_unknown_ones_are_stated() -> None:
    one = computed("A", {1.0: 0.1}, settings={"observer": "pyramid", "internal_noise": 0.5, "plan": "needed"})
    csf = replace(one, name="B", source="B", settings={"observer": "csf"})
    with pytest.raises(DataError, match="B cannot be compared with A: found observer csf, expected pyramid"):
        comparable([one, csf])
    louder = replace(one, name="B", source="B", settings=one.settings | {"internal_noise": 0.25, "plan": "full"})
    with pytest.raises(DataError, match=r"found internal_noise 0\.25, expected 0\.5"):
        comparable([one, louder])
    _, notes = comparable([one, replace(one, name="people", settings={})])
    assert notes == ["people does not say who answered: its ratio holds for the same observer."]


def test_columns_with_one_value_each_do_not_count() -> None:
    def of(camera: str) -> Measured:
        fits = computed(camera, {1.0: 0.1, 2.0: 0.2}).fits
        from msgspec import structs

        named = tuple(structs.replace(fit, group={"camera": camera, **fit.group}) for fit in fits)
        return replace(computed(camera, {1.0: 0.1}), fits=named)

    conditions, notes = comparable([of("left"), of("right")])
    assert [list(condition.fits[0].group) for condition in conditions] == [["size_mrad"]] * 2
    assert notes == ["The column camera has one value in each and does not count."]
    both = replace(of("left"), fits=(*of("left").fits, *of("right").fits))
    names = [condition.name for condition in split_by(both, "camera")]
    assert names == ["left, camera left", "left, camera right"]
    with pytest.raises(
        SettingsError, match="by: found 'lens', expected one of the columns of left: camera and size_mrad"
    ):
        split_by(both, "lens")


def test_temperatures_stand_for_snr_and_angles_for_detectors() -> None:
    """Two thermal cameras of other NETD and pitch: neither SNR nor sizes in detectors say anything of them."""
    from msgspec import structs

    def camera(name: str, pitch_um: float, mk_per_snr: float) -> Measured:
        fits = tuple(
            structs.replace(
                fit, group={"size_detectors": fit.group["size_mrad"]}, level="snr",
                delta_t_mk=fit.threshold * mk_per_snr,
            )
            for fit in computed(name, {2.0: 4.0, 4.0: 2.0}).fits
        )  # fmt: skip
        sensor = {"detector": {"pitch_um": pitch_um}, "optics": {"focal_length_mm": 10.0}}
        return replace(computed(name, {1.0: 1.0}), fits=fits, settings={"sensor": sensor})

    conditions, notes = comparable([camera("A", 10.0, 10.0), camera("B", 20.0, 5.0)])
    assert [fit.threshold for fit in conditions[0].fits] == [40.0, 20.0]
    sizes = [[fit.group["object_size_mrad"] for fit in condition.fits] for condition in conditions]
    assert sizes == [[2.0, 4.0], [4.0, 8.0]]
    (found,) = compared(*conditions)
    assert [(ratio.group["object_size_mrad"], ratio.ratio) for ratio in found.ratios] == [
        (4.0, pytest.approx(1.0))
    ]
    assert len(notes) == 2
    same, _ = comparable([camera("A", 10.0, 10.0), camera("B", 10.0, 5.0)])
    assert "size_detectors" in same[1].fits[0].group
