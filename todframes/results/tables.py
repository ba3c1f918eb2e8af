"""Tables of a result, used for the terminal, the page and the CSV files."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from todframes.results.data import (
    Algorithm,
    Content,
    DatasetRecord,
    Estimator,
    Fit,
    Group,
    Head,
    Record,
    ResultData,
    SceneResult,
)
from todframes.results.table import EXACT, Column, Table, field_text
from todframes.results.wording import (
    column_heading,
    group_phrase,
    level_heading,
    path_name,
    plain,
    threshold_heading,
)
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    pass

THRESHOLD_COLUMNS = (
    Column(key="threshold_ci95", header="95 % interval", interval="threshold_ci95"),
    Column(key="threshold_numerical_error", header="numerical error", sign="± ", digits=1),
    Column(key="threshold_displacement_error", header="displacement error", sign="± ", digits=2, rank=2),
    Column(key="delta_t_mk", header="ΔT (mK)"),
    Column(key="delta_t_as_printed_mk", header="ΔT by eq. 4 as printed (mK)", is_detail=True, rank=2),
    Column(key="n_trials", header="trials", rank=1),
    Column(key="status"),
    Column(key="points_threshold", header="from points", is_detail=True, rank=2),
    Column(key="p_correct", in_file_only=True),
    Column(key="curve", is_detail=True, rank=2),
    Column(key="weibull_threshold", header="Weibull", is_detail=True, rank=2),
    Column(key="alpha", header="α", digits=3, is_detail=True),
    Column(key="beta", header="β", digits=3, is_detail=True),
    Column(key="gamma", in_file_only=True),
    Column(key="delta", header="δ", digits=3, is_detail=True),
    Column(key="p_correct_error_bound", in_file_only=True),
    Column(key="p_correct_left_out_bound", in_file_only=True),
    Column(key="background_luminance_cd_m2", header="background (cd/m²)", is_detail=True, rank=2),
    Column(key="run_time_s", header="time (s)", digits=2, is_detail=True, rank=1),
)

RATE_COLUMNS = {"gamma": "guess_rate", "delta": "lapse_rate"}
"""Attributes of a fit whose columns have the names of the keys in JSON."""

RATIO_COLUMNS = (
    Column(key="ratio", none="1", digits=3),
    Column(key="ratio_ci95", header="95 % interval", interval="ratio", none="", digits=3),
    Column(key="verdict", none="reference", wraps=True),
    Column(key="beyond_gain", header="beyond gain", digits=3, none="", rank=2),
    Column(key="beyond_gain_ci95", interval="beyond_gain", in_file_only=True),
    Column(key="p_value", in_file_only=True),
    Column(key="p_value_holm", header="p (Holm)", digits=2, none="", rank=4, bound_if="p_value_is_least"),
    Column(key="p_value_is_least", in_file_only=True),
    Column(key="contrast_gain", header="gain", digits=3, none="", rank=5),
)

BEYOND_GAIN = ("contrast_gain", "beyond_gain", "beyond_gain_ci95")
"""Columns that a comparison of drawn answers does not have."""

MEASURE_COLUMNS = (
    Column(key="domain", header="works on", is_detail=True),
    Column(key="psnr_db", header="PSNR (dB)"),
    Column(key="psnr_change_db", header="change (dB)", digits=3, rank=2),
    Column(key="ssim", header="SSIM"),
    Column(key="ssim_change", header="change", digits=3, rank=2),
    Column(key="verdict", header="the observer says", none="reference", wraps=True),
    Column(key="disagrees", header="measures that disagree", none="", wraps=True),
    Column(key="n_clipped", header="values clipped", is_detail=True),
    Column(key="cpu_s", header="CPU time (s)", digits=3, rank=1),
    Column(key="cpu_ms_per_frame", header="a frame (ms)", digits=3, rank=2),
    Column(key="memory_mb", header="memory (MB)", digits=2, none="", rank=1),
)

MEASURED = ("psnr_db", "ssim", "n_clipped", "cpu_s", "cpu_ms_per_frame", "memory_mb")
"""Columns of `compare.csv` that are measured on an algorithm as a whole."""

ALGORITHM = Column(key="algorithm", is_name=True, wraps=True)

TAKEN = {
    *("algorithm", "spec", "threshold", "level", *MEASURED),
    *(one.key for one in THRESHOLD_COLUMNS + RATIO_COLUMNS),
}
"""Column names in use; a group column with one of these names is renamed."""


def _group_columns(names: Iterable[str]) -> list[Column]:
    return [
        Column(key=_group_key(name), header=column_heading(name), digits=EXACT, is_name=True) for name in names
    ]


def _group_key(name: str) -> str:
    return f"group {name}" if name in TAKEN else name


def _group_record(group: Group) -> Record:
    return {_group_key(name): value for name, value in group.items()}


def _fits(result: ResultData) -> list[tuple[Record, Fit]]:
    """Return each fit with the name of its algorithm, if it has one."""
    of_algorithms = [({"algorithm": one.name}, fit) for one in result.algorithms for fit in one.fits]
    return [*(({}, fit) for fit in result.fits), *of_algorithms]


def thresholds(result: ResultData, title: str = "") -> Table:
    """Make the table of thresholds, a row each; columns without any value are left out."""
    fits = _fits(result)
    computed = not any(fit.n_trials for _, fit in fits)
    names = ("threshold", *(one.key for one in THRESHOLD_COLUMNS))
    records = [
        more | _group_record(fit.group) | {name: getattr(fit, RATE_COLUMNS.get(name, name)) for name in names}
        for more, fit in fits
    ]
    if computed:
        for record in records:
            del record["n_trials"]
    groups, heading, criterion = [], "threshold", "?"
    if fits:
        first = fits[0][1]
        groups, heading = _group_columns(first.group), threshold_heading(first.level)
        criterion = f"{100 * first.p_correct:g}"
    table = Table.of(
        title or f"Thresholds at {criterion} % correct",
        "thresholds.csv",
        [
            *([ALGORITHM] if result.algorithms else []),
            *groups,
            Column(key="threshold", header=heading),
            *THRESHOLD_COLUMNS,
        ],
        records,
    )
    always = ["threshold", *(one.key for one in groups), *([] if computed else ["threshold_ci95"])]
    return table.without_empty_columns(*always)


def points(result: ResultData) -> Table | None:
    """Make the table of the points of each curve, a row for each level; None if there are no points."""
    fits = _fits(result)
    records = [
        more
        | _group_record(fit.group)
        | {"level": point.level, "n_trials": point.n_trials, "p_correct": point.p_correct}
        for more, fit in fits
        for point in fit.points
    ]
    if not records:
        return None
    computed = not any(record["n_trials"] for record in records)
    columns = [
        *([ALGORITHM] if result.algorithms else []),
        *_group_columns(fits[0][1].group),
        Column(key="level", header=level_heading(fits[0][1].level), digits=4 if computed else EXACT),
        Column(key="n_trials", header="trials", in_file_only=computed),
        Column(key="p_correct", header="proportion correct"),
    ]
    return Table.of("Points of the psychometric functions", "points.csv", columns, records)


def answers(result: ResultData) -> Table | None:
    """Make the table of answers in the strongest trials of groups without a threshold; None if there are none."""
    records: list[Record] = []
    for fit in result.fits:
        for shown, row in zip(ORIENTATIONS, fit.answers or (), strict=False):
            if n_trials := sum(row):
                percent = {
                    f"answered_{one.value}": 100.0 * n / n_trials for one, n in zip(ORIENTATIONS, row, strict=True)
                }
                records.append(
                    _group_record(fit.group)
                    | {"from_level": fit.answers_from_level, "shown": shown.value, **percent}
                    | {"n_answers": round(n_trials)}
                )
    if not records:
        return None
    columns = [
        *_group_columns(result.fits[0].group),
        Column(key="from_level", header=f"from {level_heading(result.fits[0].level)}", digits=EXACT),
        Column(key="shown"),
        *(Column(key=f"answered_{one.value}", header=f"{one.value} (%)", decimals=0) for one in ORIENTATIONS),
        Column(key="n_answers", header="trials", rank=1),
    ]
    return Table.of("Answers by orientation shown", "answers.csv", columns, records)


def ratios(algorithms: Sequence[Algorithm], observer: str = "", title: str = "") -> Table:
    """Make the table of a comparison: a row for each algorithm and group, and one for all groups together.

    Its CSV is `compare.csv`. If there are several observers, the title names the one whose table it is.
    """
    title = title or "Threshold over that of the reference"
    first = algorithms[0].fits[0] if algorithms[0].fits else None
    names = list(first.group) if first is not None else []
    records: list[Record] = []
    for one in algorithms:
        common = {"algorithm": one.name, "spec": one.spec}
        common |= {key: getattr(one, key) for key in MEASURED}
        of_groups = one.ratios or (None,) * len(one.fits)
        rows: list[tuple[Group, Any, Any]] = [
            (fit.group, fit, ratio) for fit, ratio in zip(one.fits, of_groups, strict=True)
        ]
        rows += [(dict.fromkeys(names, "all"), None, one.overall)] if one.overall is not None else []
        for group, fit, ratio in rows:
            values = {name: getattr(fit, name, None) for name in ("status", "threshold", "threshold_ci95")}
            values |= {column.key: getattr(ratio, column.key, None) for column in RATIO_COLUMNS}
            records.append(common | _group_record(group) | values)
    odd = any(record["status"] not in ("ok", None) for record in records)
    columns = [
        ALGORITHM,
        Column(key="spec", in_file_only=True),
        *_group_columns(names),
        Column(key="status", none="", rank=1 if odd else 3),
        Column(key="threshold", header=threshold_heading(first.level) if first else "threshold"),
        Column(key="threshold_ci95", interval="threshold", in_file_only=True),
        *RATIO_COLUMNS,
        *(Column(key=key, in_file_only=True) for key in MEASURED),
    ]
    table = Table.of(f"{title}, for {observer}" if observer else title, "compare.csv", columns, records)
    return table.without_empty_columns(*(one.key for one in columns if one.key not in BEYOND_GAIN))


def measures(algorithms: Sequence[Algorithm]) -> Table:
    """Make the table of algorithms: the usual measures of image quality beside the observer's verdict."""
    records: list[Record] = [
        {
            "algorithm": one.name,
            "spec": one.spec,
            "parameters": ", ".join(f"{name} {field_text(value)}" for name, value in one.parameters.items())
            or None,
            **{column.key: getattr(one, column.key) for column in MEASURE_COLUMNS},
            "disagrees": " and ".join(name.upper() for name in one.disagrees) or None,
        }
        for one in algorithms
    ]
    columns = [
        ALGORITHM,
        Column(key="spec", header="as asked for", is_detail=True, rank=1, wraps=True),
        Column(key="parameters", is_detail=True, wraps=True),
        *MEASURE_COLUMNS,
    ]
    return Table.of("Algorithms and the usual measures", "algorithms.csv", columns, records).without_empty_columns(
        "verdict"
    )


def contrast_responses(algorithms: Sequence[Algorithm]) -> Table | None:
    """Make the table of displayed contrasts before and after each algorithm; None if there are none.

    Its CSV is `contrast_response.csv`.
    """
    records: list[Record] = [
        {
            "algorithm": one.name,
            **_group_record(response.group),
            "level": point.level,
            "before": point.before,
            "after": point.after,
            "gain": point.gain,
            "gain_standard_error": point.gain_standard_error,
            "n_trials": point.n_trials,
        }
        for one in algorithms
        for response in one.contrast_responses
        for point in response.points
    ]
    if not records:
        return None
    first = next(one for one in algorithms if one.contrast_responses)
    columns = [
        ALGORITHM,
        *_group_columns(list(first.contrast_responses[0].group)),
        Column(key="level", header=level_heading(first.fits[0].level)),
        Column(key="before", header="contrast before", digits=3),
        Column(key="after", header="contrast after", digits=3),
        Column(key="gain", digits=3),
        Column(key="gain_standard_error", header="standard error", sign="± ", digits=2),
        Column(key="n_trials", header="trials"),
    ]
    return Table.of("Contrast before and after", "contrast_response.csv", columns, records)


def enhancements(found: Sequence[Record]) -> Table:
    """Make the table of registered algorithms, with a row for each parameter below its algorithm."""
    records: list[Record] = []
    for one in found:
        takes = one["domain"].replace("_", " ") + "s" * (one["domain"] == "code_value") + ", clips" * one["clip"]
        records.append({"name": one["name"], "what": one["what"], "takes": takes, "from": one["library"]})
        for parameter in one["parameters"]:
            default, ends = parameter["default"], parameter["range"] or ()
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = ", ".join(map(str, parameter["choices"] or ())) or " – ".join(f"{end:g}" for end in ends)
            records.append(
                {
                    "name": f"  {parameter['name']}",
                    "what": parameter["what"],
                    "default": " ".join(filter(None, (shown, parameter["unit"]))),
                    "range": span,
                }
            )
    columns = [
        Column(key="name"),
        Column(key="what", header="what it does; what a parameter is", none="", wraps=True),
        Column(key="default", none=""),
        Column(key="range", none="", wraps=True, rank=1),
        Column(key="takes", none="", rank=2),
        Column(key="from", none="", rank=3),
    ]
    return Table.of("Enhancement algorithms", "enhancements.csv", columns, records)


def plan(result: ResultData) -> Table:
    """Make the table of the steps that were computed or left out, for each threshold if each has a plan."""
    plans = [(group_phrase(fit.group), fit.plan) for fit in result.fits if fit.plan] or [("", result.plan)]
    records = [
        {"group": group or None}
        | {key: value for key, value in step.items() if key != "kept" and not (step.get("kept") and key in UNUSED)}
        | {"kept": "kept" if step.get("kept") else "left out"}
        for group, steps in plans
        for step in steps
    ]
    columns = [
        Column(key="group", is_name=True),
        Column(key="stage"),
        Column(key="kept", header="is"),
        Column(key="why", wraps=True),
        Column(key="bound", header="bound on P", digits=2, none=""),
        Column(key="saves_s", header="saves (s)", digits=2, none="", rank=1),
    ]
    return Table.of("Plan", "plan.csv", columns, records).without_empty_columns("stage")


LONGEST_LIST = 16
"""Largest number of values of a setting that are shown."""

UNUSED = ("bound", "saves_s")
"""Keys of a plan's step that have no meaning if the step is kept."""


def records_table(title: str, file: str, records: Sequence[Record]) -> Table:
    """Make a table of records whose keys are not known beforehand, with a column for each key."""
    return Table.of(title, file, dict.fromkeys(key for record in records for key in record), records)


def settings(head: Head, content: Content) -> Table:
    """Make the table of a result's settings and versions; names of nested settings are joined with dots."""
    made: Record = {
        "command": head.command,
        "name": content.name or None,
        "seed": head.seed,
        "version": head.version,
        **_flat(head.versions, "versions."),
        "run_time_s": head.run_time_s,
    }
    made = {name: value for name, value in made.items() if value is not None}
    made |= _flat(content.settings, "settings.")
    made |= _flat({name: one for name, one in head.call.items() if name not in content.settings}, "call.")
    # Values are texts, because this table shows all digits on screen too.
    return _names_and_values("Settings, seed and versions", "settings.csv", made)


def dataset(record: DatasetRecord) -> Table:
    """Make the table of a dataset's display, experiment and manifest; of long lists it has the two ends."""
    made = _flat(
        {
            "path": record.path,
            "manifest_sha256": record.manifest_sha256,
            "n_frames": record.n_frames,
            "display": record.display,
            "experiment": record.experiment,
        },
        "",
    )
    for name, value in made.items():
        if isinstance(value, list) and len(value) > LONGEST_LIST:
            made[name] = f"{len(value)} values from {field_text(value[0])} to {field_text(value[-1])}"
    return _names_and_values("Dataset and display", "dataset.csv", made)


def _names_and_values(title: str, file: str, values: Record) -> Table:
    """Make a table of names and values; of an absolute path it has the last part."""
    rows: list[Record] = [
        {"name": name, "value": field_text(_without_folders(value)) or None} for name, value in values.items()
    ]
    return Table.of(title, file, ["name", "value"], rows)


def _without_folders(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [*map(_without_folders, value)]
    return path_name(value) if isinstance(value, str) else value


def _flat(values: Record, prefix: str) -> Record:
    flat: Record = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


# Trials --------------------------------------------------------------------------------------------------------


TRIAL_KINDS = {
    **dict.fromkeys(("algorithm", "trial", "orientation", "answer"), str),
    **dict.fromkeys(("n_frames", "polarity"), int),
}
"""Columns of scored trials that are texts or whole numbers; the others are groups or numbers."""


def trial_kinds(names: Iterable[str], groups: Sequence[Group]) -> dict[str, type]:
    """Return the type of each column of scored trials; that of a group is a text if one of its values is."""
    texts = {name for group in groups for name, value in group.items() if isinstance(value, str)}
    kinds = TRIAL_KINDS | {name: float for group in groups for name in group} | dict.fromkeys(texts, str)
    return {name: kinds.get(name, float) for name in names}


# Scenes of an accuracy study -----------------------------------------------------------------------------------


def scene_tables(scene: SceneResult) -> list[Table]:
    """Make the tables of a scene of `accuracy`: estimators, effects of single changes, all budgets."""
    estimators = Table.of(
        _scene_title(scene),
        f"{scene.name}_estimators.csv",
        [
            Column(key="estimator", is_name=True),
            Column(key="trials", rank=3),
            Column(key="cpu_s", header="CPU (s)", digits=2, rank=2),
            Column(key="wall_s", header="wall (s)", digits=2, rank=4),
            Column(key="p_correct_error", header="error of P", digits=2, rank=4),
            Column(key="threshold_error", header="of the threshold", digits=2, rank=2),
            Column(key="slope", rank=3),
            *(
                Column(key=key, header=key, rank=1 if key.startswith("CPU") else 0)
                for at in ((scene.estimators or (Estimator(name=""),))[0].cpu_s_at)
                for key in _at_names(at)
            ),
        ],
        [_estimator_record(one, scene.estimators[0]) for one in scene.estimators],
    )
    variants = Table.of(
        f"{scene.heading}: one thing changed about the closed form",
        f"{scene.name}_variants.csv",
        [
            Column(key="label", header="closed form, changed", is_name=True, wraps=True),
            Column(key="cpu_ratio", header="CPU", sign="× ", digits=3),
            Column(key="p_correct_change", header="change of P", digits=2),
            Column(key="threshold_change", header="of the threshold", digits=2),
        ],
        scene.variants,
    )
    budgets = [{"estimator": one.title} | point for one in scene.estimators for point in one.points]
    return [
        estimators,
        *([variants] if scene.variants else []),
        *([records_table(f"{scene.heading}: budgets", f"{scene.name}_budgets.csv", budgets)] if budgets else []),
    ]


def _scene_title(scene: SceneResult) -> str:
    if scene.threshold is None:
        return f"{scene.heading}: estimators"
    error = f" ± {plain(scene.threshold_bound, 1)}" if scene.threshold_bound is not None else ""
    return f"{scene.heading}: threshold {level_heading(scene.level)} {plain(scene.threshold, 6)}{error}"


def _at_names(at: Record) -> tuple[str, str]:
    """Return the headings of the columns of CPU time for an error and of its ratio to the first estimator's."""
    percent = f"{100 * at['threshold_error']:g} %"
    return f"CPU (s) at {percent}", f"times less at {percent}"


def _estimator_record(one: Estimator, first: Estimator) -> Record:
    """Return an estimator's row: its largest budget, the slope of its error, CPU times for some errors."""
    last = one.points[-1] if one.points else {}
    slope = None if one.slope is None else f"{one.slope:.2f}"
    if slope is not None and one.slope_standard_error is not None:
        slope += f" ± {one.slope_standard_error:.2f}"
    record: Record = {"estimator": one.title, **last, "slope": slope}
    bases = {at["threshold_error"]: at["cpu_s"] for at in first.cpu_s_at}
    for at in one.cpu_s_at:
        cpu_s, base = at["cpu_s"], bases.get(at["threshold_error"])
        time_name, ratio_name = _at_names(at)
        if cpu_s is not None:
            text = rounded(cpu_s) if cpu_s >= 100.0 else plain(cpu_s, 2)
            record[time_name] = ("≤ " if at.get("at_most") else "") + text + " *" * bool(at.get("extrapolated"))
            record[ratio_name] = None if base is None else rounded(base / cpu_s)
    return record


def rounded(value: float) -> str:
    """Return a ratio as text with two significant digits and thousands separators."""
    return f"{float(f'{value:.2g}'):,.0f}" if value >= 10.0 else f"{value:.2g}"
