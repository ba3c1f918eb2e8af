"""Conditions compared: the records of a result, with their tables, sentences, figures and warnings."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

from msgspec import Struct
from msgspec.structs import replace

from todframes.base._typing import Json
from todframes.enhancement.contrast_gain import ContrastPoint
from todframes.results.data import Fit, Group, Interval, Positive, Record, ResultWarning, observer_names
from todframes.results.figures import (
    INK,
    PAPER,
    CurveStyle,
    ReportFigure,
    add_legend,
    curve_style,
    label_text,
    plain_ticks,
    reference_style,
    within,
)
from todframes.results.tables import TAKEN as THRESHOLDS_TAKEN
from todframes.results.tables import Column, Table, field_text, group_columns, group_record
from todframes.results.tables import thresholds as thresholds_table
from todframes.results.thresholds import Thresholds, check_fits
from todframes.results.wording import (
    column_heading,
    count,
    group_phrase,
    group_phrases,
    interval_phrase,
    level_heading,
    level_name,
    listed,
    plain,
    size_column,
    subsample,
    threshold_heading,
    unit_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NO_DIFFERENCE = "no difference shown"

REACHED = {
    "never_reached": "is never reached",
    "always_exceeded": "is always exceeded",
    "falling": "does not exist, as answers get worse with the level",
    "too_few_levels": "cannot be found from one level",
}
"""Phrases about the criterion if there is no threshold, by status."""

BY = {
    "paired_trials": "show{s} the same trials as {reference}: they are compared trial by trial.",
    "separate_trials": "show{s} other trials than {reference}: the experiments are repeated apart.",
    "intervals": "ha{ve} no trials here: thresholds are drawn from their intervals, on the log scale.",
    "same_thresholds": "ha{ve} the thresholds of {reference}.",
}
"""Phrases about how ratios were found."""

RATIO_COLUMNS = (
    Column(key="ratio", digits=3),
    Column(key="ratio_above", header="ratio above", digits=3, none=""),
    Column(key="ratio_below", header="ratio below", digits=3, none=""),
    Column(key="ratio_ci95", header="95 % interval", interval="ratio", none="", digits=3),
    Column(key="verdict", none="reference", wraps=True),
    Column(key="beyond_gain", header="beyond gain", digits=3, none="", rank=2),
    Column(key="beyond_gain_ci95", interval="beyond_gain", in_file_only=True),
    Column(key="p_value", in_file_only=True),
    Column(key="p_value_holm", header="p (Holm)", digits=2, none="", rank=1, bound_if="p_value_is_least"),
    Column(key="p_value_is_least", in_file_only=True),
    Column(key="contrast_gain", header="gain", digits=3, none="", rank=5),
)

NOT_ALWAYS = ("ratio_above", "ratio_below", "contrast_gain", "beyond_gain", "beyond_gain_ci95")
"""Columns that a comparison does not have where all thresholds are reached, or answers are drawn."""

MEASURE_COLUMNS = (
    Column(key="domain", header="works on", is_detail=True, is_key=True),
    Column(key="psnr_db", header="PSNR (dB)"),
    Column(key="psnr_change_db", header="change (dB)", digits=3, rank=2),
    Column(key="ssim", header="SSIM"),
    Column(key="ssim_change", header="change", digits=3, rank=2),
    Column(key="verdict", header="the observer says", none="reference", wraps=True),
    Column(key="disagrees", header="measures that disagree", none="", wraps=True),
    Column(key="n_clipped", header="values clipped", is_detail=True),
    Column(key="cpu_s", header="CPU time (s)", digits=3, rank=1),
    Column(key="cpu_ms_per_frame", header="a frame (ms)", digits=3, rank=2),
)

DISPLACED = ("displaced_right_px", "displaced_down_px")
"""Columns of the displacement that an algorithm has along x and y, if it has one."""

MEASURED = ("psnr_db", "ssim", "n_clipped", "cpu_s", "cpu_ms_per_frame")
"""Columns of `compare.csv` that are measured on an algorithm as a whole."""

TAKEN = THRESHOLDS_TAKEN | {"condition", "spec", *MEASURED, *(column.key for column in RATIO_COLUMNS)}
"""Column names in use; a group column with one of these names is renamed."""

CONDITION = Column(key="condition", is_name=True, wraps=True)

SAME_DISPLACEMENT_PX = 0.25
"""Largest standard deviation of an algorithm's displacement that counts as none: noise causes 0.2 after some."""

CLEAR = 1.1
"""Factor by which the signal of a band has to change beyond its interval."""

MOST_COMPARED, MOST_GROUPS, MOST_NAMED_SIZES, MOST_GROUPS_OF_CURVES = 12, 24, 6, 6
"""Largest numbers of conditions and groups in a figure, of sizes that are named one by one, and of groups whose
psychometric functions are drawn."""


FARTHEST_NYQUIST = 3.0
"""Largest Nyquist frequency that is drawn beside TOD curves, over the largest of 1 / size."""


class Ratio(Struct, frozen=True, kw_only=True):
    """A condition's threshold divided by that of the reference, in one group or, without `group`, in all.

    Where a threshold is missing, `ratio_above` or `ratio_below` is a bound of the ratio, by the end of the levels.
    `p_value_is_least`: the p-value is the smallest that the resamples allow, so the true one may be smaller.
    `contrast_gain` is an algorithm's gain of the triangle's displayed contrast, and `beyond_gain` its threshold
    divided by that of a plain gain of the same amount: below 1, it does more than to amplify.
    """

    verdict: str
    group: Group = {}
    ratio: Positive | None = None
    ratio_ci95: Interval | None = None
    ratio_above: Positive | None = None
    ratio_below: Positive | None = None
    p_value: float | None = None
    p_value_holm: float | None = None
    p_value_is_least: bool = False
    contrast_gain: Positive | None = None
    beyond_gain: Positive | None = None
    beyond_gain_ci95: Interval | None = None


class ContrastResponse(Struct, frozen=True, kw_only=True):
    """Displayed contrast after an algorithm against that before it, level by level, in one group."""

    group: Group = {}
    points: tuple[ContrastPoint, ...] = ()

    @property
    def is_contrast(self) -> bool:
        """Whether the contrast before grows with the level as a contrast does.

        A flat contrast with sizes as levels, or noise about 0, does not: it has to rise by at least the square
        root of what the level does.
        """
        points = [point for point in self.points if point.before > 0.0]
        if not points:
            return False
        first, last = points[0], points[-1]
        return len(self.points) == 1 or last.before / first.before > math.sqrt(last.level / first.level)


class BandSignal(Struct, frozen=True, kw_only=True):
    """Signal of a condition in one band of the observer's pyramid, without noise: the part of the score of the
    triangle's orientation, over the mean of all four, per unit of level.

    Attributes
    ----------
    cycles_per_mrad : float
        Centre of the band, which is an octave wide, at the eye.
    share : float
        Part of the condition's whole signal.
    ratio, ratio_ci95 : float and pair
        Signal over that of the reference in the band, and its interval; it is None for the reference itself.
    """

    cycles_per_mrad: Positive
    share: float
    ratio: float
    ratio_ci95: Interval | None = None


class ComparedCondition(Struct, frozen=True, kw_only=True):
    """A condition of `compare`: a camera or display, a curve, or an algorithm on one of them; the first is the
    reference, which has no ratios.

    Attributes
    ----------
    name, spec : str
        Name, and the text of `--enhance`.
    source : str or None
        Dataset or result behind it; None for the dataset of the result.
    by : str or None
        How its ratios were found: "paired_trials", the same trials as the reference, drawn together;
        "separate_trials", each drawn apart; "intervals", drawn from the intervals or numerical errors;
        "same_thresholds", the thresholds are those of the reference.
    what, library, domain : str or None
        Description of the algorithm, the library that does the work, and the values that it takes.
    parameters : dict
        Values of its parameters.
    pixel_size : float or None
        Pitch of its detectors or pixels in the unit of the sizes.
    magnification : float
        Factor by which it enlarges the frame.
    displacement_px : tuple of float or None
        Displacement of its pictures to the right and down, in pixels of the frame: the observer looks there. None
        if they do not show it.
    displacement_scatter_px : float or None
        Standard deviation of the displacement over trials, along an axis.
    fits : tuple of Fit
        Its thresholds.
    ratios : tuple of Ratio
        Ratio of the thresholds in each group that the reference has, too, or two sizes about it.
    overall : Ratio or None
        The same for the geometric mean of all groups, if there are several; its weights are equal for algorithms
        on one dataset, and else those of a meta-analysis with random effects.
    verdict : str or None
        That of `overall`, or of the only group.
    contrast_responses : tuple of ContrastResponse
        Displayed contrast before and after the algorithm, in each group.
    bands : tuple of BandSignal
        Its signal in each band of the first observer's pyramid, where frames are there.
    n_scenes : int or None
        Number of scenes that the interval takes as drawn from many; None if the dataset names none.
    psnr_db, psnr_change_db, ssim, ssim_change : float or None
        PSNR and SSIM against `reference_frame`, and their changes by the algorithm.
    disagrees : tuple of str
        Those of psnr and ssim that contradict the verdict.
    edge_factor : float or None
        Factor by which it changes the luminance of a frame's outermost pixels, divided by that around the
        triangle: the median over the frames.
    repeat_difference : float or None
        Largest difference between pictures of the same frame, in units of their mean luminance.
    n_clipped : int or None
        Number of values that were clipped.
    cpu_s, cpu_ms_per_frame : float or None
        Processor time of the algorithm over all frames, and for a frame.
    """

    name: str
    spec: str | None = None
    source: str | None = None
    by: str | None = None
    what: str | None = None
    library: str | None = None
    domain: str | None = None
    parameters: Record = {}
    pixel_size: Positive | None = None
    magnification: float = 1.0
    displacement_px: tuple[float, float] | None = None
    displacement_scatter_px: float | None = None
    fits: tuple[Fit, ...] = ()
    ratios: tuple[Ratio, ...] = ()
    overall: Ratio | None = None
    verdict: str | None = None
    contrast_responses: tuple[ContrastResponse, ...] = ()
    bands: tuple[BandSignal, ...] = ()
    n_scenes: int | None = None
    psnr_db: float | None = None
    psnr_change_db: float | None = None
    ssim: float | None = None
    ssim_change: float | None = None
    disagrees: tuple[str, ...] = ()
    edge_factor: float | None = None
    repeat_difference: float | None = None
    n_clipped: int | None = None
    cpu_s: float | None = None
    cpu_ms_per_frame: float | None = None


class JudgedBy(Struct, frozen=True, kw_only=True):
    """A further observer or gaze of `compare`: its settings, and the conditions as it judges them."""

    settings: Record
    conditions: tuple[ComparedCondition, ...] = ()


def named(each: Sequence[JudgedBy]) -> list[tuple[str, JudgedBy]]:
    """Return what each observer finds with its name, "" if it is alone."""
    names = observer_names([judged.settings for judged in each]) if len(each) > 1 else [""]
    return list(zip(names, each, strict=True))


class Comparison(Thresholds, frozen=True, kw_only=True):
    """Thresholds of several conditions. `compare` gives it.

    Attributes
    ----------
    conditions : tuple of ComparedCondition
        An object for each condition, the reference first.
    observers : tuple of JudgedBy
        What the second and further observers or gazes find.
    data_range_cd_m2 : float or None
        Range of luminance for PSNR and SSIM.
    verdict : tuple of str
        A sentence for each condition.
    basis : tuple of str
        How conditions were compared, and what was left out, in sentences.
    eye : tuple of Fit
        Thresholds of the observer without a display in between, where the sizes are angles at the eye and the
        levels contrasts.
    """

    conditions: tuple[ComparedCondition, ...] = ()
    observers: tuple[JudgedBy, ...] = ()
    data_range_cd_m2: float | None = None
    verdict: tuple[str, ...] = ()
    basis: tuple[str, ...] = ()
    eye: tuple[Fit, ...] = ()

    inference: ClassVar[str] = "Intervals and verdicts"

    @property
    def thresholds(self) -> tuple[Fit, ...]:
        """All thresholds as `Fit` records, with the condition's name in their group."""
        return thresholds_of(self.conditions)

    def _each_settings(self) -> list[Record]:
        return [judged.settings for _, judged in self._each_observer()]

    def _each_observer(self) -> list[tuple[str, JudgedBy]]:
        return named([JudgedBy(settings=self.settings, conditions=self.conditions), *self.observers])

    @property
    def has_findings_in_table(self) -> bool:  # type: ignore[override]
        """Whether the verdicts stand at the tables: those on cameras are above them."""
        return not self.is_of_algorithms

    @property
    def name(self) -> str:
        """Return the name of the dataset, or those of the conditions."""
        return super().name if self.is_of_algorithms else listed(condition.name for condition in self.conditions)

    @property
    def is_of_algorithms(self) -> bool:
        """Whether the conditions are algorithms on one dataset; its frames as they are count as one, too."""
        return bool(self.conditions) and self.conditions[0].spec is not None

    def _curve_styles(self) -> dict[object, CurveStyle]:
        """Return the style of each condition, the same in all figures; the reference has the ink's."""
        reference, *others = (condition.name for condition in self.conditions)
        styles: dict[object, CurveStyle] = {reference: reference_style()}
        return styles | {name: curve_style(number, len(others)) for number, name in enumerate(others)}

    def table(self) -> Table:
        """Return the thresholds of all conditions."""
        return thresholds_table(self.thresholds)

    def tables(self) -> list[Table]:
        """List the ratios for each observer, the conditions, and folded tables with all else."""
        measures, responses = measures_table(self.conditions), responses_table(self.conditions)
        is_measured = any(
            condition.psnr_db is not None or condition.ssim is not None for condition in self.conditions
        )
        folded = [self.table(), *([] if responses is None else [responses])]
        folded += [bands_table(self.conditions)] if self.conditions[0].bands else []
        of_algorithms = [measures if is_measured else measures.extra()] * self.is_of_algorithms
        return [
            *(ratios_table(judged.conditions, observer) for observer, judged in self._each_observer()),
            *of_algorithms,
            *(table.folded() for table in folded),
            *self.tables_behind(),
        ]

    def findings(self) -> list[str]:
        """Return a sentence for each condition, as stored when the result was made."""
        return list(self.verdict) or super().findings()

    def advice(self) -> list[str]:
        """Return how conditions were compared, and what a reader of thresholds must know."""
        return [*self.basis, *super().advice()]

    def notes(self) -> list[str]:
        """Return what was skipped, and how many values an algorithm clipped."""
        clipped = ((condition.spec, condition.n_clipped) for condition in self.conditions if condition.n_clipped)
        return [*super().notes(), *(f"note: {spec}: {n} values were clipped" for spec, n in clipped)]

    def figures(self) -> list[ReportFigure]:
        """List the ratios for each observer, contrasts before and after, TOD and psychometric functions."""
        from todframes.results.figures import psychometric_figures, tod_figures

        styles = self._curve_styles()
        curves = tod_figures(self.thresholds, styles, "" if self.is_of_algorithms else "tod_curve.png", bands=True)
        if curves:
            pixels = {one.name: one.pixel_size for one in self.conditions if one.pixel_size}
            finest = min(float(fit.group[size_column(self.thresholds) or ""]) for fit in self.thresholds)
            pixels = {name: pixel for name, pixel in pixels.items() if 2.0 * pixel * FARTHEST_NYQUIST >= finest}
            note = curves[0].note + " At Nyquist, a period is two pixels." * bool(pixels)
            note += " Dashed: the naked eye." * bool(self.eye)
            draw = partial(draw_limits, draw=curves[0].draw, pixels=pixels, styles=styles, eye=self.eye)
            curves = [curves[0]._replace(note=note, draw=draw)]
        listed = [] if self.is_of_algorithms else curves
        note = (
            "Below 1 is better than the reference. Filled: a difference is shown; open: none is. Lines are 95 % "
            "intervals, dotted where the data leave an end open."
        )
        for number, (observer, judged) in enumerate(self._each_observer()):
            if any(condition.ratios for condition in judged.conditions):
                title = "Thresholds over those of the reference" + (f", for {observer}" if observer else "")
                draw = partial(draw_ratios, conditions=judged.conditions, styles=styles)
                listed.append(ReportFigure(title, note, draw, "" if number else "compare.png"))
        if any(response.is_contrast for condition in self.conditions for response in condition.contrast_responses):
            note = (
                "Displayed contrast of the triangle after each algorithm against that before it, a line for each "
                "group; bars: two standard errors. A plain gain is parallel to the grey line, which changes "
                "nothing."
            )
            draw = partial(draw_responses, conditions=self.conditions, styles=styles)
            listed.append(ReportFigure("Contrast before and after", note, draw, "contrast_response.png"))
        if any(condition.bands for condition in self.conditions[1:]):
            note = (
                "Signal of the triangle per level in each band of the observer, without noise: an octave of "
                "frequency at the eye. A gain of contrast moves all bands alike, blur the fine ones. Bars: 95 %."
            )
            draw = partial(draw_bands, conditions=self.conditions, styles=styles)
            listed.append(ReportFigure("Signal in each band over that of the reference", note, draw, "bands.png"))
        listed += curves * self.is_of_algorithms
        groups: dict[str, list[Fit]] = {}
        for condition in self.conditions:
            for fit in condition.fits:
                curve = replace(fit, group={"condition": condition.name})
                groups.setdefault(group_phrase(fit.group) if fit.group else "", []).append(curve)
        for label, fits in subsample(list(groups.items()), MOST_GROUPS_OF_CURVES):
            title = "Psychometric functions" + (f": {label}" if label else "")
            listed += psychometric_figures(fits, styles, of=title)
        return listed

    def data_files(self) -> dict[str, bytes]:
        """Return trials, ratios, and contrasts before and after."""
        responses = responses_table(self.conditions)
        return {
            **super().data_files(),
            "compare.csv": ratios_table(self.conditions).csv().encode(),
            **({"bands.csv": bands_table(self.conditions).csv().encode()} if self.conditions[0].bands else {}),
            **({} if responses is None else {responses.file: responses.csv().encode()}),
        }

    def check(self, where: str) -> None:
        """Raise DataError unless the fits of all conditions have the columns of one table."""
        super().check(where)
        check_fits(self.thresholds, f"{where}: fits of all conditions")


def thresholds_of(conditions: Sequence[ComparedCondition]) -> tuple[Fit, ...]:
    """Return the fits of all conditions, each with the condition's name in its group."""
    return tuple(
        replace(fit, group={"condition": condition.name} | fit.group)
        for condition in conditions
        for fit in condition.fits
    )


def rows_of(condition: ComparedCondition) -> list[tuple[Group, Fit | None, Ratio | None]]:
    """Return the groups of a condition with threshold and ratio, numbers before texts."""
    fits = {tuple(fit.group.items()): fit for fit in condition.fits}
    rows: list[tuple[Group, Fit | None, Ratio | None]] = [
        (ratio.group, fits.pop(tuple(ratio.group.items()), None), ratio) for ratio in condition.ratios
    ]
    rows += [(fit.group, fit, None) for fit in fits.values()]
    return sorted(rows, key=lambda row: [(isinstance(value, str), value) for value in row[0].values()])


def ratios_table(conditions: Sequence[ComparedCondition], observer: str = "") -> Table:
    """Make the table of a comparison: a row for each condition and group, and one for all groups together.

    If there are several observers, the title names the one whose table it is.
    """
    first = conditions[0].fits[0] if conditions[0].fits else None
    names = list(first.group) if first is not None else []
    records: list[Record] = []
    for condition in conditions:
        common = {"condition": condition.name} | {key: getattr(condition, key) for key in ("spec", *MEASURED)}
        rows = rows_of(condition)
        rows += [(dict.fromkeys(names, "all"), None, condition.overall)] if condition.overall is not None else []
        for group, fit, ratio in rows:
            values = {name: getattr(fit, name, None) for name in ("status", "threshold", "threshold_ci95")}
            values |= {column.key: getattr(ratio, column.key, None) for column in RATIO_COLUMNS}
            if condition is conditions[0]:
                values["ratio"] = 1.0
            elif ratio is None:
                values["verdict"] = "no match"
            records.append(common | group_record(group, TAKEN) | values)
    odd = any(record["status"] not in ("ok", None) for record in records)
    columns = [
        CONDITION,
        Column(key="spec", in_file_only=True),
        *group_columns(names, TAKEN),
        Column(key="status", none="", rank=1 if odd else 3, is_key=True),
        Column(key="threshold", header=threshold_heading(first.level) if first else "threshold"),
        Column(
            key="threshold_ci95", header="its interval", interval="threshold", none="", is_detail=True, digits=3
        ),
        *RATIO_COLUMNS,
        *(Column(key=key, in_file_only=True) for key in MEASURED),
    ]
    title = "Threshold over that of the reference" + (f", for {observer}" if observer else "")
    table = Table.of(title, "compare.csv", columns, records)
    return table.without_empty_columns(*(column.key for column in columns if column.key not in NOT_ALWAYS))


def measures_table(conditions: Sequence[ComparedCondition]) -> Table:
    """Make the table of algorithms: the usual measures of image quality beside the observer's verdict."""
    records: list[Record] = [
        {
            "condition": condition.name,
            "spec": condition.spec,
            "parameters": ", ".join(f"{name} {field_text(value)}" for name, value in condition.parameters.items())
            or None,
            **{column.key: getattr(condition, column.key) for column in MEASURE_COLUMNS},
            **{key: px or None for key, px in zip(DISPLACED, condition.displacement_px or (), strict=False)},
            "disagrees": " and ".join(name.upper() for name in condition.disagrees) or None,
        }
        for condition in conditions
    ]
    columns = [
        CONDITION,
        Column(key="spec", header="as asked for", is_detail=True, rank=1, wraps=True),
        Column(key="parameters", is_detail=True, wraps=True),
        *MEASURE_COLUMNS,
        *(Column(key=key, header=key.replace("_", " ").replace(" px", " (px)"), none="") for key in DISPLACED),
    ]
    table = Table.of("Algorithms and the usual measures", "algorithms.csv", columns, records)
    return table.without_empty_columns("verdict")


def responses_table(conditions: Sequence[ComparedCondition]) -> Table | None:
    """Make the table of displayed contrasts before and after each algorithm; None if there are none."""
    keys = ContrastPoint.__struct_fields__
    records: list[Record] = [
        {"condition": condition.name}
        | group_record(response.group, TAKEN)
        | {key: getattr(point, key) for key in keys}
        for condition in conditions
        for response in condition.contrast_responses
        for point in response.points
    ]
    if not records:
        return None
    first = next(condition for condition in conditions if condition.contrast_responses)
    columns = [
        CONDITION,
        *group_columns(first.contrast_responses[0].group, TAKEN),
        Column(key="level", header=level_heading(first.fits[0].level)),
        Column(key="before", header="contrast before", digits=3),
        Column(key="after", header="contrast after", digits=3),
        Column(key="gain", digits=3),
        Column(key="gain_standard_error", header="standard error", sign="± ", digits=2),
        Column(key="n_trials", header="trials"),
    ]
    return Table.of("Contrast before and after", "contrast_response.csv", columns, records)


def bands_table(conditions: Sequence[ComparedCondition]) -> Table:
    """Make the table of the signals in each band of the observer."""
    records = [
        {"condition": condition.name} | {key: getattr(band, key) for key in BandSignal.__struct_fields__}
        for condition in conditions
        for band in condition.bands
    ]
    columns = [
        CONDITION,
        Column(key="cycles_per_mrad", header="band (cycles/mrad)", digits=3),
        Column(key="share", header="share of its signal", digits=2),
        Column(key="ratio", header="signal over that of the reference", digits=3),
        Column(key="ratio_ci95", header="95 % interval", interval="ratio", none="", digits=3),
    ]
    return Table.of("Signal in each band", "bands.csv", columns, records)


def draw_bands(axes: Axes, conditions: Sequence[ComparedCondition], styles: Mapping[object, CurveStyle]) -> None:
    """Draw the signal in each band over that of the reference."""
    axes.set(xscale="log", yscale="log", xlabel="band (cycles/mrad)", ylabel="signal ÷ that of the reference")
    for condition in [one for one in conditions[1:] if one.bands][:MOST_COMPARED]:
        bands = [band for band in condition.bands if band.ratio > 0.0]
        colour, marker = styles[condition.name]
        x, ratios = [band.cycles_per_mrad for band in bands], [band.ratio for band in bands]
        axes.plot(x, ratios, color=colour, marker=marker, label=label_text(condition.name))
        for band in bands:
            interval = band.ratio_ci95 or (None, None)
            ends = [end or band.ratio for end in interval]
            axes.plot([band.cycles_per_mrad] * 2, ends, ":" if None in interval else "-", color=colour)
    axes.axhline(1.0, color=INK, lw=0.8)
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, 0.8), max(high, 1.25))
    plain_ticks(axes.xaxis, axes.get_xlim())
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def draw_ratios(axes: Axes, conditions: Sequence[ComparedCondition], styles: Mapping[object, CurveStyle]) -> None:
    """Draw thresholds divided by the reference's, by condition and group, against the size where these are many;
    filled if a difference is shown.
    """
    others = [condition for condition in conditions if condition.ratios][:MOST_COMPARED]
    of_groups = [ratio for condition in others for ratio in condition.ratios]
    column = next(iter(of_groups[0].group), "")
    texts = list(dict.fromkeys(group_phrase(ratio.group) if ratio.group else "all groups" for ratio in of_groups))
    are_sizes = bool(unit_of(column)) and list(of_groups[0].group) == [column] and len(texts) > MOST_NAMED_SIZES
    if not are_sizes and any(condition.overall for condition in others):
        texts.append("all groups")
    texts = texts[:MOST_GROUPS]
    axes.set_yscale("log")
    for number, condition in enumerate(others):
        colour, marker = styles[condition.name]
        shift = 0.6 * ((number + 0.5) / len(others) - 0.5)
        points: Json = {"color": colour, "marker": marker, "ls": ""}
        label, overall = label_text(condition.name), condition.overall
        if are_sizes and overall is not None and overall.ratio is not None:
            label += f": {plain(overall.ratio)} over {len(condition.ratios)} sizes"
        axes.plot([], [], label=label, **points)
        for ratio in condition.ratios if are_sizes or overall is None else (*condition.ratios, overall):
            text = group_phrase(ratio.group) if ratio.group else "all groups"
            if ratio.ratio is None or (text not in texts and not are_sizes):
                continue
            x = within(float(ratio.group[column])) * 1.02**shift if are_sizes else texts.index(text) + shift
            interval = ratio.ratio_ci95 or (None, None)
            ends = [within(end or ratio.ratio) for end in interval]
            is_open = ratio.ratio_ci95 is not None and None in interval
            axes.plot([x] * 2, ends, ":" if is_open else "-", color=colour)
            face = colour if ratio.verdict in ("better", "worse") else PAPER
            axes.plot(x, within(ratio.ratio), **points, markerfacecolor=face)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.set(ylabel="threshold ÷ that of the reference")
    if are_sizes:
        axes.set(xscale="log", xlabel=column_heading(column))
        plain_ticks(axes.xaxis, axes.get_xlim())
    else:
        axes.set_xlim(-0.5, max(len(texts), 1) - 0.5)
        axes.set_xticks(range(len(texts)), map(label_text, texts), rotation=20 if len(texts) > 5 else 0)
        axes.tick_params(axis="x", length=0)
        axes.grid(False, axis="x")
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def draw_limits(
    axes: Axes,
    draw: Callable[[Axes], None],
    pixels: Mapping[str, float],
    styles: Mapping[object, CurveStyle],
    eye: Sequence[Fit],
) -> None:
    """Draw TOD curves and, faint, the eye's own, and the Nyquist frequency of each condition."""
    draw(axes)
    faint: Json = {"alpha": 0.6, "lw": 1.0, "zorder": 1}
    for pixel in dict.fromkeys(pixels.values()):
        names = [name for name, of_pixel in pixels.items() if of_pixel == pixel]
        nyquist, colour = 0.5 / pixel, styles[names[0]].colour if len(names) == 1 else INK
        axes.axvline(nyquist, color=colour, ls=":", **faint)
        place: Json = {"textcoords": "offset points", "xycoords": axes.get_xaxis_transform(), "rotation": 90}
        axes.annotate("Nyquist", (nyquist, 0.02), (-9.0, 0.0), fontsize="x-small", color=colour, **place)
    known = [(1.0 / float(fit.group["size_mrad"]), fit.threshold) for fit in eye if fit.threshold is not None]
    if known:
        axes.plot(*zip(*known, strict=True), color=INK, ls="--", **faint)
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, 0.8 * min(threshold for _, threshold in known)), high)
        plain_ticks(axes.yaxis, axes.get_ylim())


def draw_responses(
    axes: Axes, conditions: Sequence[ComparedCondition], styles: Mapping[object, CurveStyle]
) -> None:
    """Draw the displayed contrast of the triangle after each algorithm against that before it, on log axes."""
    axes.set(xscale="log", yscale="log", xlabel="displayed contrast before", ylabel="displayed contrast after")
    ends: list[float] = []
    for condition in [condition for condition in conditions if condition.contrast_responses][:MOST_COMPARED]:
        style: Json = {"color": styles[condition.name].colour, "marker": styles[condition.name].marker, "ms": 4}
        axes.plot([], [], label=label_text(condition.name), **style)
        for response in condition.contrast_responses[:MOST_GROUPS]:
            points = [point for point in response.points if point.before > 0.0 and point.after > 0.0]
            before, after = ([within(getattr(point, key)) for point in points] for key in ("before", "after"))
            errors = [2.0 * (point.gain_standard_error or 0.0) * point.before for point in points]
            axes.errorbar(before, after, yerr=errors, lw=1.0, elinewidth=0.8, **style)
            ends += before
    if ends:
        axes.plot([min(ends), max(ends)], [min(ends), max(ends)], color=INK, alpha=0.4, lw=0.8, zorder=0)
    plain_ticks(axes.xaxis, axes.get_xlim())
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def basis_of(conditions: Sequence[ComparedCondition], compared: Sequence[Any]) -> list[str]:
    """Return how conditions were compared with the first, in sentences: by which trials or intervals, whether
    sizes lie between two that were shown, and how many were left out. `compared` has the `ratios.Compared` of all
    others.
    """
    reference, *others = conditions
    texts = []
    for by, text in BY.items():
        names = [condition.name for condition in others if condition.by == by]
        ending = ("s", "s") if len(names) == 1 else ("", "ve")
        if names:
            texts.append(f"{listed(names)} {text.format(reference=reference.name, s=ending[0], ve=ending[1])}")
    if any(found.interpolated for found in compared):
        texts.append("Between two sizes that were shown, ln threshold is interpolated in 1 / size.")
    left_out = [
        f"{count(len(found.left_out), 'threshold')} beside {condition.name}"
        for condition, found in zip(others, compared, strict=True)
        if found.left_out
    ]
    if left_out:
        texts.append(f"What only one of two curves has is left out: {listed(left_out)}.")
    return texts


def comparisons(each_observer: Sequence[tuple[str, JudgedBy]]) -> tuple[str, ...]:
    """Return a sentence for each condition on which observers disagree, then each observer's paragraphs: whether
    a condition helps, and by how much. The first condition is the reference.
    """
    disagreements = []
    for number, condition in enumerate(each_observer[0][1].conditions[1:], 1):
        verdicts = {name: judged.conditions[number].verdict for name, judged in each_observer}
        if len(set(verdicts.values())) > 1:
            each = ", ".join(f"{verdict} for {name}" for name, verdict in verdicts.items())
            text = f"The observers disagree about {condition.name}: {each}."
            disagreements.append(("better" not in verdicts.values(), text))
    disagreements.sort(key=lambda item: item[0])
    paragraphs = (
        (f"{name}: " if name else "") + _paragraph(condition, judged.conditions[0])
        for name, judged in each_observer
        for condition in judged.conditions[1:]
    )
    return (*(text for _, text in disagreements), *paragraphs)


def bands_changed(conditions: Sequence[ComparedCondition]) -> Iterator[str]:
    """Yield a sentence for each condition with a band whose signal is clearly not the reference's: the band that
    differs most, and that which differs least.
    """
    for condition in conditions[1:]:
        bands = [(band, band.ratio_ci95) for band in condition.bands if band.ratio > 0.0 and band.ratio_ci95]
        bands.sort(key=lambda item: -abs(math.log(item[0].ratio)))
        if any((high or math.inf) * CLEAR < 1.0 or (low or 0.0) > CLEAR for _, (low, high) in bands):
            (first, its), (last, its_own) = bands[0], bands[-1]
            text = (
                f"The signal of {condition.name} is {plain(first.ratio)} times that of {conditions[0].name} "
                f"in the band at {plain(first.cycles_per_mrad, 2)} cycles/mrad ({interval_phrase(its)})"
            )
            if last is not first:
                at = plain(last.cycles_per_mrad, 2)
                text += f", and {plain(last.ratio)} times in that at {at} ({interval_phrase(its_own)})"
            yield f"{text}."


def _paragraph(condition: ComparedCondition, reference: ComparedCondition) -> str:
    if reference.spec is None:
        return _beside(condition, reference)
    text = f"{condition.name}: {condition.verdict}"
    whole = condition.overall or condition.ratios[0]
    mean = ", in the geometric mean of all groups" if condition.overall else ""
    level = level_name(condition.fits[0].level) if condition.fits else ""
    if whole.ratio is not None:
        sure = f"95 % interval {interval_phrase(whole.ratio_ci95 or (None, None))}{_not_alone(whole)}"
        text += f"; the threshold {level} is {plain(whole.ratio)} times that without it ({sure}){mean}"
    elif condition.overall and (bound := _bound(whole)):
        text += f"; the threshold {level} is {bound} times that without it{mean}"
    sentences = [text + _each_verdict(condition), *_beyond_gain(condition, whole)]
    if condition.displacement_px and any(condition.displacement_px):
        ways = zip(condition.displacement_px, (" to the left", " up"), (" to the right", " down"), strict=True)
        parts = [f"{plain(abs(px))} px{(before, behind)[px > 0.0]}" for px, before, behind in ways if px]
        sentences.append(f"Its pictures lie {' and '.join(parts)}; the observer looks there")
    sentences += _without_ratio(condition, reference, "with it", "without")
    if condition.disagrees:
        changes = {
            "psnr": f"PSNR changes by {_signed(condition.psnr_change_db, '.1f')} dB",
            "ssim": f"SSIM by {_signed(condition.ssim_change, '.3f')}",
        }
        sentences.append(
            f"The usual measures disagree: {' and '.join(changes[name] for name in condition.disagrees)}"
        )
    return ". ".join(sentences) + "."


def _beside(condition: ComparedCondition, reference: ComparedCondition) -> str:
    """Return what a condition needs of the reference's thresholds: over all groups, at the first and the last."""
    if not condition.ratios:
        return f"{condition.name} and {reference.name} have no sizes in common."
    whole, level = condition.overall or condition.ratios[0], level_name(condition.fits[0].level)
    amount = plain(whole.ratio) if whole.ratio is not None else _bound(whole)
    text = f"{condition.name} needs {amount} times the {level} of {reference.name}"
    if not amount:
        text = f"{condition.name} and {reference.name} have no threshold to compare"
    if whole.ratio is not None:
        text += f" ({interval_phrase(whole.ratio_ci95 or (None, None))}{_not_alone(whole)})"
    ratios = [ratio for ratio in condition.ratios if ratio.ratio is not None]
    if condition.overall is not None and ratios:
        are_all = len(ratios) == len(condition.fits) == len(reference.fits)
        what = "sizes" if all(map(unit_of, condition.ratios[0].group)) else "groups"
        text += f" over {'all' if are_all else len(ratios)} {what}"
        ends = [
            f"{plain(ratio.ratio)} times at {group_phrase(ratio.group)}"
            for ratio in (*ratios[:1], *ratios[1:][-1:])
        ]
        text += f"; {', '.join(ends)}" * bool(ends)
    text += f": {condition.verdict}{_each_verdict(condition)}"
    by, without = f"with {condition.name}", f"with {reference.name}"
    return ". ".join([text, *_without_ratio(condition, reference, by, without)]) + "."


def _not_alone(ratio: Ratio) -> str:
    """Return that an interval leaves out 1, and yet no difference is shown among all that are compared."""
    low, high = ratio.ratio_ci95 or (None, None)
    if ratio.verdict != NO_DIFFERENCE or (low or 0.0) < 1.0 < (high or math.inf) or low == high == 1.0:
        return ""
    return f" of this ratio alone; p is {plain(ratio.p_value_holm, 2)} with all that are compared"


def _each_verdict(condition: ComparedCondition) -> str:
    """Return the groups of each verdict, if these differ."""
    groups_of = {
        verdict: [ratio.group for ratio in condition.ratios if ratio.verdict == verdict]
        for verdict in ("better", "worse", NO_DIFFERENCE)
    }
    if not condition.overall or len({ratio.verdict for ratio in condition.ratios}) < 2:
        return ""
    texts = (f"{verdict} at {group_phrases(groups)}" for verdict, groups in groups_of.items() if groups)
    return f"; {'; '.join(texts)}"


def _beyond_gain(condition: ComparedCondition, ratio: Ratio) -> list[str]:
    """Return a sentence on an algorithm that helps: whether it does more than a plain gain of the same amount.

    Where its gain is another near the threshold, no plain gain is of the same amount.
    """
    if ratio.verdict not in ("better", "mixed") or ratio.beyond_gain is None or ratio.beyond_gain_ci95 is None:
        return []
    if any(not_proportional([condition])):
        return [
            "Whether it does more than amplify stays open: its contrast gain near the threshold is not that at "
            "the highest level"
        ]
    low, high = ratio.beyond_gain_ci95
    if high is not None and high < 1.0:
        amount = "more than"
    else:
        amount = "less than" if low is not None and low > 1.0 else "no more than"
    return [
        f"It does {amount} its contrast gain of {plain(ratio.contrast_gain)}: the threshold is "
        f"{plain(ratio.beyond_gain)} times that of a plain gain of as much (95 % interval "
        f"{interval_phrase(ratio.beyond_gain_ci95)})"
    ]


def _without_ratio(condition: ComparedCondition, reference: ComparedCondition, by: str, without: str) -> list[str]:
    """Return the reasons why groups have no ratio, a sentence for each with the groups for which it is true."""
    reasons: dict[str, list[Group]] = {}
    before = {tuple(fit.group.items()): fit for fit in reference.fits}
    for group, fit, ratio in rows_of(condition):
        if ratio is None or ratio.ratio is not None or fit is None:
            continue
        what = f"{100 * fit.p_correct:g} % correct"
        own, other = (REACHED.get(either.status, "is reached") for either in (fit, before[tuple(group.items())]))
        text = f"{what} {own} {by} or {without}" if own == other else f"{what} {own} {by} and {other} {without}"
        if own != other and (bound := _bound(ratio)):
            text += f": the threshold is {bound} times that {'without it' if without == 'without' else without}"
        reasons.setdefault(text, []).append(group)
    return [
        f"At {group_phrases(groups)} {reason}" if groups[0] else reason[0].upper() + reason[1:]
        for reason, groups in reasons.items()
    ]


def _bound(ratio: Ratio) -> str:
    """Return the bound of a ratio that is not known; empty if there is none."""
    if ratio.ratio_above is not None:
        return f"more than {plain(ratio.ratio_above)}"
    return "" if ratio.ratio_below is None else f"less than {plain(ratio.ratio_below)}"


def _signed(value: float | None, form: str) -> str:
    return f"{value or 0.0:+{form}}".replace("-", "−")


def not_proportional(conditions: Sequence[ComparedCondition]) -> Iterator[ResultWarning]:
    """Yield a warning where an algorithm's gain of contrast is another at threshold than at the highest level.

    A comparison with a plain gain, which has the gain of the highest level, then compares with a wrong one.
    """
    for condition in conditions:
        for fit, response, ratio in zip(
            condition.fits, condition.contrast_responses, condition.ratios, strict=False
        ):
            points = [point for point in response.points if point.gain is not None and point.gain > 0.0]
            if ratio.beyond_gain is None or fit.threshold is None or len(points) < 2:
                continue
            near = min(points, key=lambda point, at=fit.threshold: abs(math.log(point.level / at)))  # type: ignore[misc]
            top = points[-1]
            assert near.gain is not None and top.gain is not None
            difference = abs(near.gain - top.gain)
            error = math.hypot(near.gain_standard_error or 0.0, top.gain_standard_error or 0.0)
            if difference <= 0.1 * top.gain or difference <= 3.0 * error:
                continue  # no more than is usual, or than the errors allow
            message = (
                f"its gain of contrast is {plain(near.gain)} ± {plain(near.gain_standard_error, 1)} near the "
                f"threshold, at {near.level:.3g}, and {plain(top.gain)} at the highest level: beyond_gain, "
                "which takes the latter, does not hold; see the table of the contrast before and after"
            )
            group = {"condition": condition.name} | fit.group
            yield ResultWarning(
                code="not_proportional", group=group, message=message, found=near.gain, expected=top.gain
            )


def frame_warnings(conditions: Sequence[ComparedCondition]) -> Iterator[ResultWarning]:
    """Yield warnings about algorithms that change the edge of frames otherwise, displace each frame by another
    distance, or change a frame otherwise each time.
    """
    for condition in conditions:
        group: Group = {"condition": condition.name}
        edge, difference = condition.edge_factor, condition.repeat_difference
        if edge is not None and abs(edge - 1.0) > 0.02:
            kind = "brighter" if edge > 1.0 else "darker"
            message = (
                "compared with what surrounds the triangle, it makes the outermost pixels of a frame "
                f"{plain(100.0 * abs(edge - 1.0), 2)} % {kind}, as a network does that takes pixels "
                "beyond the frame as black. Contrast refers to what surrounds the triangle. If triangles lie near "
                "the edge, take larger frames, or let the algorithm mirror them"
            )
            yield ResultWarning(code="edge_brightness", group=group, message=message, found=edge, expected=1.0)
        scatter = condition.displacement_scatter_px
        if scatter is not None and scatter > SAME_DISPLACEMENT_PX:
            message = (
                "the displacement of its pictures differs from trial to trial, with a standard deviation of "
                f"{plain(scatter, 2)} px. The observer looks at the middle of all, so part of a higher threshold "
                "is that the triangle lies elsewhere. Let the algorithm keep the grid of the frames"
            )
            yield ResultWarning(
                code="displacement_varies", group=group, message=message, found=scatter, expected=0.0
            )
        if difference:
            message = (
                f"its pictures of the same frame differ by up to {plain(100.0 * difference, 2)} % of "
                "their mean luminance: it depends on chance, on other frames or on a file that has changed. Its "
                "ratio holds for this run alone. Give it a fixed seed, declare it with clip if it needs earlier "
                "frames, and leave its files as they are"
            )
            yield ResultWarning(
                code="not_repeatable",
                group=group,
                message=message,
                found=difference,
                expected=0.0,
            )
