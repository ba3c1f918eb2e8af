"""Algorithms compared: the records of a result, with their tables, sentences, figures and warnings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, ClassVar

from msgspec import Struct
from msgspec.structs import replace

from todframes.base._typing import Json
from todframes.results.data import Fit, Group, Interval, Positive, Record, ResultWarning, observer_names
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import (
    INK,
    PAPER,
    CurveStyle,
    add_legend,
    curve_style,
    label_text,
    plain_ticks,
    reference_style,
    within,
)
from todframes.results.table import Column, Table, field_text
from todframes.results.tables import TAKEN as THRESHOLDS_TAKEN
from todframes.results.tables import group_columns, group_record
from todframes.results.tables import thresholds as thresholds_table
from todframes.results.thresholds import Thresholds, check_fits
from todframes.results.wording import (
    group_phrase,
    group_phrases,
    interval_phrase,
    level_heading,
    level_name,
    plain,
    subsample,
    threshold_heading,
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

TAKEN = THRESHOLDS_TAKEN | {"algorithm", "spec", *MEASURED, *(column.key for column in RATIO_COLUMNS)}
"""Column names in use; a group column with one of these names is renamed."""

ALGORITHM = Column(key="algorithm", is_name=True, wraps=True)

SAME_DISPLACEMENT_PX = 0.25
"""Largest standard deviation of an algorithm's displacement that counts as none: noise causes 0.2 after some."""

MOST_COMPARED, MOST_GROUPS, MOST_GROUPS_OF_CURVES = 12, 24, 6
"""Largest numbers of algorithms and groups in a figure, and of groups whose psychometric functions are drawn."""


class Ratio(Struct, frozen=True, kw_only=True):
    """An algorithm's threshold divided by that of the reference, in one group or, without `group`, in all.

    Where a threshold is missing, `ratio_above` or `ratio_below` is a bound of the ratio, by the end of the levels.
    `p_value_is_least`: the p-value is the smallest that the resamples allow, so the true one may be smaller.
    `contrast_gain` is the algorithm's gain of the triangle's displayed contrast, and `beyond_gain` its threshold
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


class ContrastPoint(Struct, frozen=True):
    """Displayed contrast of the triangle at a level, before and after an algorithm: means over `n_trials` trials.

    `gain` is their quotient, and `gain_standard_error` its standard error over the trials.
    """

    level: Positive
    before: float
    after: float
    gain: float | None = None
    gain_standard_error: float | None = None
    n_trials: int = 0


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


class Algorithm(Struct, frozen=True, kw_only=True):
    """An algorithm of `compare`; the reference has no ratios.

    Attributes
    ----------
    name, spec : str
        Short name, and the text of `--enhance`.
    what, library, domain : str or None
        Its description, the library that does the work, and the values that it takes.
    parameters : dict
        Values of its parameters.
    magnification : float
        Factor by which it enlarges the frame.
    displacement_px : tuple of float or None
        Displacement of its pictures to the right and down, in pixels of the frame: the observer looks there. None
        if they do not show it.
    displacement_scatter_px : float or None
        Standard deviation of the displacement over trials, along an axis.
    fits : tuple of Fit
        Thresholds with the algorithm.
    ratios : tuple of Ratio
        Ratio of the thresholds in each group.
    overall : Ratio or None
        The same for the geometric mean of all groups, if there are several.
    verdict : str or None
        That of `overall`, or of the only group.
    contrast_responses : tuple of ContrastResponse
        Displayed contrast before and after the algorithm, in each group.
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
    what: str | None = None
    library: str | None = None
    domain: str | None = None
    parameters: Record = {}
    magnification: float = 1.0
    displacement_px: tuple[float, float] | None = None
    displacement_scatter_px: float | None = None
    fits: tuple[Fit, ...] = ()
    ratios: tuple[Ratio, ...] = ()
    overall: Ratio | None = None
    verdict: str | None = None
    contrast_responses: tuple[ContrastResponse, ...] = ()
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
    """A further observer or gaze of `compare`: its settings, and the algorithms as it judges them."""

    settings: Record
    algorithms: tuple[Algorithm, ...] = ()


def named(each: Sequence[JudgedBy]) -> list[tuple[str, JudgedBy]]:
    """Return what each observer finds with its name, "" if it is alone."""
    names = observer_names([judged.settings for judged in each]) if len(each) > 1 else [""]
    return list(zip(names, each, strict=True))


class Comparison(Thresholds, frozen=True, kw_only=True):
    """Thresholds with and without algorithms. `compare` gives it.

    Attributes
    ----------
    algorithms : tuple of Algorithm
        An object for each algorithm, the reference `none` first.
    observers : tuple of JudgedBy
        What the second and further observers or gazes find.
    data_range_cd_m2 : float or None
        Range of luminance for PSNR and SSIM.
    verdict : tuple of str
        A sentence for each algorithm.
    """

    algorithms: tuple[Algorithm, ...] = ()
    observers: tuple[JudgedBy, ...] = ()
    data_range_cd_m2: float | None = None
    verdict: tuple[str, ...] = ()

    has_findings_in_table: ClassVar[bool] = False
    inference: ClassVar[str] = "Intervals and verdicts"

    @property
    def thresholds(self) -> tuple[Fit, ...]:
        """All thresholds as `Fit` records, with the algorithm's name in their group."""
        return thresholds_of(self.algorithms)

    def _each_settings(self) -> list[Record]:
        return [judged.settings for _, judged in self._each_observer()]

    def _each_observer(self) -> list[tuple[str, JudgedBy]]:
        return named([JudgedBy(settings=self.settings, algorithms=self.algorithms), *self.observers])

    def _curve_styles(self) -> dict[object, CurveStyle]:
        """Return the style of each algorithm, the same in all figures; the reference has the ink's."""
        reference, *others = (algorithm.name for algorithm in self.algorithms)
        styles: dict[object, CurveStyle] = {reference: reference_style()}
        return styles | {name: curve_style(number, len(others)) for number, name in enumerate(others)}

    def table(self) -> Table:
        """Return the thresholds of all algorithms."""
        return thresholds_table(self.thresholds)

    def tables(self) -> list[Table]:
        """List the ratios for each observer, the algorithms, and folded tables with all else."""
        measures, responses = measures_table(self.algorithms), responses_table(self.algorithms)
        is_measured = any(
            algorithm.psnr_db is not None or algorithm.ssim is not None for algorithm in self.algorithms
        )
        folded = [self.table(), *([] if responses is None else [responses])]
        return [
            *(ratios_table(judged.algorithms, observer) for observer, judged in self._each_observer()),
            measures if is_measured else measures.extra(),
            *(table.folded() for table in folded),
            *self.tables_behind(),
        ]

    def findings(self) -> list[str]:
        """Return a sentence for each algorithm, as stored when the result was made."""
        return list(self.verdict) or super().findings()

    def notes(self) -> list[str]:
        """Return what was skipped, and how many values an algorithm clipped."""
        clipped = ((algorithm.spec, algorithm.n_clipped) for algorithm in self.algorithms if algorithm.n_clipped)
        return [*super().notes(), *(f"note: {spec}: {n} values were clipped" for spec, n in clipped)]

    def figures(self) -> list[ReportFigure]:
        """List the ratios for each observer, contrasts before and after, TOD and psychometric functions."""
        from todframes.results.figures import psychometric_figures, tod_figures

        listed, styles = [], self._curve_styles()
        note = (
            "Below 1 the algorithm helps. Filled: a difference is shown; open: none is. Lines are 95 % intervals, "
            "dotted where the data leave an end open."
        )
        for number, (observer, judged) in enumerate(self._each_observer()):
            if any(algorithm.ratios for algorithm in judged.algorithms):
                title = "Thresholds with and without" + (f", for {observer}" if observer else "")
                draw = partial(draw_ratios, algorithms=judged.algorithms, styles=styles)
                listed.append(ReportFigure(title, note, draw, "" if number else "compare.png"))
        if any(response.is_contrast for algorithm in self.algorithms for response in algorithm.contrast_responses):
            note = (
                "Displayed contrast of the triangle after each algorithm against that before it, a line for each "
                "group; bars: two standard errors. A plain gain is parallel to the grey line, which changes "
                "nothing."
            )
            draw = partial(draw_responses, algorithms=self.algorithms, styles=styles)
            listed.append(ReportFigure("Contrast before and after", note, draw, "contrast_response.png"))
        listed += tod_figures(self.thresholds, styles)
        groups: dict[str, list[Fit]] = {}
        for algorithm in self.algorithms:
            for fit in algorithm.fits:
                curve = replace(fit, group={"algorithm": algorithm.name})
                groups.setdefault(group_phrase(fit.group) if fit.group else "", []).append(curve)
        for label, fits in subsample(list(groups.items()), MOST_GROUPS_OF_CURVES):
            title = "Psychometric functions" + (f": {label}" if label else "")
            listed += psychometric_figures(fits, styles, of=title)
        return listed

    def data_files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return trials, ratios, and contrasts before and after."""
        responses = responses_table(self.algorithms)
        return {
            **super().data_files(),
            "compare.csv": ratios_table(self.algorithms).csv().encode(),
            **({} if responses is None else {responses.file: responses.csv().encode()}),
        }

    def check(self, where: str) -> None:
        """Raise DataError unless the fits of all algorithms have the columns of one table."""
        super().check(where)
        check_fits(self.thresholds, f"{where}: fits of all algorithms")


def thresholds_of(algorithms: Sequence[Algorithm]) -> tuple[Fit, ...]:
    """Return the fits of all algorithms, each with the algorithm's name in its group."""
    return tuple(
        replace(fit, group={"algorithm": algorithm.name} | fit.group)
        for algorithm in algorithms
        for fit in algorithm.fits
    )


def ratios_table(algorithms: Sequence[Algorithm], observer: str = "") -> Table:
    """Make the table of a comparison: a row for each algorithm and group, and one for all groups together.

    If there are several observers, the title names the one whose table it is.
    """
    first = algorithms[0].fits[0] if algorithms[0].fits else None
    names = list(first.group) if first is not None else []
    records: list[Record] = []
    for algorithm in algorithms:
        common = {"algorithm": algorithm.name} | {key: getattr(algorithm, key) for key in ("spec", *MEASURED)}
        rows: list[tuple[Group, Fit | None, Ratio | None]] = [
            (fit.group, fit, ratio)
            for fit, ratio in zip(algorithm.fits, algorithm.ratios or (None,) * len(algorithm.fits), strict=True)
        ]
        rows += [(dict.fromkeys(names, "all"), None, algorithm.overall)] if algorithm.overall is not None else []
        for group, fit, ratio in rows:
            values = {name: getattr(fit, name, None) for name in ("status", "threshold", "threshold_ci95")}
            values |= {column.key: getattr(ratio, column.key, None) for column in RATIO_COLUMNS}
            values["ratio"] = 1.0 if ratio is None else ratio.ratio
            records.append(common | group_record(group, TAKEN) | values)
    odd = any(record["status"] not in ("ok", None) for record in records)
    columns = [
        ALGORITHM,
        Column(key="spec", in_file_only=True),
        *group_columns(names, TAKEN),
        Column(key="status", none="", rank=1 if odd else 3, is_key=True),
        Column(key="threshold", header=threshold_heading(first.level) if first else "threshold"),
        Column(key="threshold_ci95", interval="threshold", in_file_only=True),
        *RATIO_COLUMNS,
        *(Column(key=key, in_file_only=True) for key in MEASURED),
    ]
    title = "Threshold over that of the reference" + (f", for {observer}" if observer else "")
    table = Table.of(title, "compare.csv", columns, records)
    return table.without_empty_columns(*(column.key for column in columns if column.key not in NOT_ALWAYS))


def measures_table(algorithms: Sequence[Algorithm]) -> Table:
    """Make the table of algorithms: the usual measures of image quality beside the observer's verdict."""
    records: list[Record] = [
        {
            "algorithm": algorithm.name,
            "spec": algorithm.spec,
            "parameters": ", ".join(f"{name} {field_text(value)}" for name, value in algorithm.parameters.items())
            or None,
            **{column.key: getattr(algorithm, column.key) for column in MEASURE_COLUMNS},
            **{key: px or None for key, px in zip(DISPLACED, algorithm.displacement_px or (), strict=False)},
            "disagrees": " and ".join(name.upper() for name in algorithm.disagrees) or None,
        }
        for algorithm in algorithms
    ]
    columns = [
        ALGORITHM,
        Column(key="spec", header="as asked for", is_detail=True, rank=1, wraps=True),
        Column(key="parameters", is_detail=True, wraps=True),
        *MEASURE_COLUMNS,
        *(Column(key=key, header=key.replace("_", " ").replace(" px", " (px)"), none="") for key in DISPLACED),
    ]
    table = Table.of("Algorithms and the usual measures", "algorithms.csv", columns, records)
    return table.without_empty_columns("verdict")


def responses_table(algorithms: Sequence[Algorithm]) -> Table | None:
    """Make the table of displayed contrasts before and after each algorithm; None if there are none."""
    keys = ContrastPoint.__struct_fields__
    records: list[Record] = [
        {"algorithm": algorithm.name}
        | group_record(response.group, TAKEN)
        | {key: getattr(point, key) for key in keys}
        for algorithm in algorithms
        for response in algorithm.contrast_responses
        for point in response.points
    ]
    if not records:
        return None
    first = next(algorithm for algorithm in algorithms if algorithm.contrast_responses)
    columns = [
        ALGORITHM,
        *group_columns(first.contrast_responses[0].group, TAKEN),
        Column(key="level", header=level_heading(first.fits[0].level)),
        Column(key="before", header="contrast before", digits=3),
        Column(key="after", header="contrast after", digits=3),
        Column(key="gain", digits=3),
        Column(key="gain_standard_error", header="standard error", sign="± ", digits=2),
        Column(key="n_trials", header="trials"),
    ]
    return Table.of("Contrast before and after", "contrast_response.csv", columns, records)


def draw_ratios(axes: Axes, algorithms: Sequence[Algorithm], styles: Mapping[object, CurveStyle]) -> None:
    """Draw thresholds divided by the reference's, by algorithm and group; filled if a difference is shown."""
    others = [algorithm for algorithm in algorithms if algorithm.ratios][:MOST_COMPARED]
    compared = [
        {group_phrase(ratio.group) if ratio.group else "all groups": ratio for ratio in each if ratio}
        for each in ((*algorithm.ratios, algorithm.overall) for algorithm in others)
    ]
    labels = list(dict.fromkeys(label for ratios in compared for label in ratios))[:MOST_GROUPS]
    axes.set_yscale("log")
    for number, (algorithm, ratios) in enumerate(zip(others, compared, strict=True)):
        colour, marker = styles[algorithm.name]
        shift = 0.6 * ((number + 0.5) / len(others) - 0.5)
        points: Json = {"color": colour, "marker": marker, "ls": ""}
        axes.plot([], [], label=label_text(algorithm.name), **points)
        for x, label in enumerate(labels):
            ratio = ratios.get(label)
            if ratio is None or ratio.ratio is None:
                continue
            interval = ratio.ratio_ci95 or (None, None)
            ends = [within(end or ratio.ratio) for end in interval]
            is_open = ratio.ratio_ci95 is not None and None in interval
            axes.plot([x + shift] * 2, ends, ":" if is_open else "-", color=colour)
            face = colour if ratio.verdict in ("better", "worse") else PAPER
            axes.plot(x + shift, within(ratio.ratio), **points, markerfacecolor=face)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.set(ylabel="threshold ÷ that of the reference", xlim=(-0.5, max(len(labels), 1) - 0.5))
    rotation = 20 if len(labels) > 5 else 0
    axes.set_xticks(range(len(labels)), [label_text(label) for label in labels], rotation=rotation)
    axes.tick_params(axis="x", length=0)
    axes.grid(False, axis="x")
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)


def draw_responses(axes: Axes, algorithms: Sequence[Algorithm], styles: Mapping[object, CurveStyle]) -> None:
    """Draw the displayed contrast of the triangle after each algorithm against that before it, on log axes."""
    axes.set(xscale="log", yscale="log", xlabel="displayed contrast before", ylabel="displayed contrast after")
    ends: list[float] = []
    for algorithm in [algorithm for algorithm in algorithms if algorithm.contrast_responses][:MOST_COMPARED]:
        style: Json = {"color": styles[algorithm.name].colour, "marker": styles[algorithm.name].marker, "ms": 4}
        axes.plot([], [], label=label_text(algorithm.name), **style)
        for response in algorithm.contrast_responses[:MOST_GROUPS]:
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


def comparisons(each_observer: Sequence[tuple[str, JudgedBy]]) -> tuple[str, ...]:
    """Return a sentence for each algorithm on which observers disagree, then each observer's paragraphs: whether
    an algorithm helps, and by how much. The first algorithm is the reference.
    """
    disagreements = []
    for number, algorithm in enumerate(each_observer[0][1].algorithms[1:], 1):
        verdicts = {name: judged.algorithms[number].verdict for name, judged in each_observer}
        if len(set(verdicts.values())) > 1:
            each = ", ".join(f"{verdict} for {name}" for name, verdict in verdicts.items())
            text = f"The observers disagree about {algorithm.name}: {each}."
            disagreements.append(("better" not in verdicts.values(), text))
    disagreements.sort(key=lambda item: item[0])
    paragraphs = (
        (f"{name}: " if name else "") + _paragraph(algorithm, judged.algorithms[0])
        for name, judged in each_observer
        for algorithm in judged.algorithms[1:]
    )
    return (*(text for _, text in disagreements), *paragraphs)


def _paragraph(algorithm: Algorithm, reference: Algorithm) -> str:
    text = f"{algorithm.name}: {algorithm.verdict}"
    whole = algorithm.overall or algorithm.ratios[0]
    mean = ", in the geometric mean of all groups" if algorithm.overall else ""
    if whole.ratio is not None:
        interval = whole.ratio_ci95 or (None, None)
        sure = f"95 % interval {interval_phrase(interval)}"
        if whole.verdict == NO_DIFFERENCE and not (interval[0] or 0.0) < 1.0 < (interval[1] or math.inf):
            sure += f" of this ratio alone; p is {plain(whole.p_value_holm, 2)} with all that are compared"
        level = level_name(algorithm.fits[0].level)
        text += f"; the threshold {level} is {plain(whole.ratio)} times that without it ({sure}){mean}"
    elif algorithm.overall and (bound := _bound(whole)):
        text += f"; the threshold {level_name(algorithm.fits[0].level)} is {bound} times that without it{mean}"
    groups_of = {
        verdict: [ratio.group for ratio in algorithm.ratios if ratio.verdict == verdict]
        for verdict in ("better", "worse", NO_DIFFERENCE)
    }
    if algorithm.overall and len({ratio.verdict for ratio in algorithm.ratios}) > 1:
        texts = (f"{verdict} at {group_phrases(groups)}" for verdict, groups in groups_of.items() if groups)
        text += f"; {'; '.join(texts)}"
    sentences = [text, *_beyond_gain(algorithm, whole)]
    if algorithm.displacement_px and any(algorithm.displacement_px):
        ways = zip(algorithm.displacement_px, (" to the left", " up"), (" to the right", " down"), strict=True)
        parts = [f"{plain(abs(px))} px{(before, behind)[px > 0.0]}" for px, before, behind in ways if px]
        sentences.append(f"Its pictures lie {' and '.join(parts)}; the observer looks there")
    for reason, groups in _without_ratio(algorithm, reference).items():
        sentences.append(f"At {group_phrases(groups)} {reason}" if groups[0] else reason[0].upper() + reason[1:])
    if algorithm.disagrees:
        changes = {
            "psnr": f"PSNR changes by {_signed(algorithm.psnr_change_db, '.1f')} dB",
            "ssim": f"SSIM by {_signed(algorithm.ssim_change, '.3f')}",
        }
        sentences.append(
            f"The usual measures disagree: {' and '.join(changes[name] for name in algorithm.disagrees)}"
        )
    return ". ".join(sentences) + "."


def _beyond_gain(algorithm: Algorithm, ratio: Ratio) -> list[str]:
    """Return a sentence on an algorithm that helps: whether it does more than a plain gain of the same amount.

    Where its gain is another near the threshold, no plain gain is of the same amount.
    """
    if ratio.verdict not in ("better", "mixed") or ratio.beyond_gain is None or ratio.beyond_gain_ci95 is None:
        return []
    if any(not_proportional([algorithm])):
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


def _without_ratio(algorithm: Algorithm, reference: Algorithm) -> dict[str, list[Group]]:
    """Return the reasons why groups have no ratio: phrases, and the groups for which each is true."""
    reasons: dict[str, list[Group]] = {}
    for ratio, fit, before in zip(algorithm.ratios, algorithm.fits, reference.fits, strict=True):
        if ratio.ratio is None:
            what = f"{100 * fit.p_correct:g} % correct"
            after, without = (REACHED.get(either.status, "is reached") for either in (fit, before))
            same, other = f"{what} {after} with it or without", f"{what} {after} with it and {without} without"
            if bound := _bound(ratio):
                other += f": the threshold is {bound} times that without it"
            reasons.setdefault(same if after == without else other, []).append(fit.group)
    return reasons


def _bound(ratio: Ratio) -> str:
    """Return the bound of a ratio that is not known; empty if there is none."""
    if ratio.ratio_above is not None:
        return f"more than {plain(ratio.ratio_above)}"
    return "" if ratio.ratio_below is None else f"less than {plain(ratio.ratio_below)}"


def _signed(value: float | None, form: str) -> str:
    return f"{value or 0.0:+{form}}".replace("-", "−")


def not_proportional(algorithms: Sequence[Algorithm]) -> Iterator[ResultWarning]:
    """Yield a warning where an algorithm's gain of contrast is another at threshold than at the highest level.

    A comparison with a plain gain, which has the gain of the highest level, then compares with a wrong one.
    """
    for algorithm in algorithms:
        for fit, response, ratio in zip(
            algorithm.fits, algorithm.contrast_responses, algorithm.ratios, strict=False
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
            group = {"algorithm": algorithm.name} | fit.group
            yield ResultWarning(
                code="not_proportional", group=group, message=message, found=near.gain, expected=top.gain
            )


def frame_warnings(algorithms: Sequence[Algorithm]) -> Iterator[ResultWarning]:
    """Yield warnings about algorithms that change the edge of frames otherwise, displace each frame by another
    distance, or change a frame otherwise each time.
    """
    for algorithm in algorithms:
        group: Group = {"algorithm": algorithm.name}
        edge, difference = algorithm.edge_factor, algorithm.repeat_difference
        if edge is not None and abs(edge - 1.0) > 0.02:
            kind = "brighter" if edge > 1.0 else "darker"
            message = (
                "compared with what surrounds the triangle, it makes the outermost pixels of a frame "
                f"{plain(100.0 * abs(edge - 1.0), 2)} % {kind}, as a network does that takes pixels "
                "beyond the frame as black. Contrast refers to what surrounds the triangle. If triangles lie near "
                "the edge, take larger frames, or let the algorithm mirror them"
            )
            yield ResultWarning(code="edge_brightness", group=group, message=message, found=edge, expected=1.0)
        scatter = algorithm.displacement_scatter_px
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
