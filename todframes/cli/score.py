"""The commands that give thresholds: `score`, `naked-eye` and `fit`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from todframes.base.errors import SettingsError
from todframes.base.locations import Location
from todframes.cli.console import finish, long_run, progress, staged
from todframes.cli.options import (
    NUMBERS,
    PASSES,
    ScoringCommand,
    dataset_argument,
    json_option,
    make_fit,
    make_observer,
    observer_options,
    p_correct_option,
    places_option,
    quiet_option,
    result_options,
    run_options,
    scoring_options,
    seed_option,
    set_option,
    strict_option,
    tolerance_option,
    verbose_option,
)


@click.command(cls=ScoringCommand)
@dataset_argument
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html, scores.csv and plots.")
@observer_options
@tolerance_option(
    None,
    "Relative error of the thresholds that displacing the retina may cause: each frame is seen with as many "
    "displacements as that takes.  [default: one each]",
)
@scoring_options
@run_options
@result_options
@strict_option
def score(*, dataset: Location, out: str | None, quiet: bool, **asked: Any) -> None:
    """Score the display frames of DATASET and fit its thresholds.

    DATASET is a folder with dataset.toml, manifest.csv and frames, or its URL. Without -o nothing is written.
    """
    shown = {name: asked.pop(name) for name in ("as_json", "verbose", "explain", "strict")}
    observer, fit = make_observer(asked)
    import todframes as tod
    from todframes.frames.dataset import load_dataset

    data = load_dataset(dataset, max_frame_mb=asked.pop("max_frame_mb"))
    with long_run(out, asked, quiet=quiet) as place:
        with progress("scoring", len(data.trials) * PASSES[asked["locate"]], quiet=quiet) as advance:
            result = tod.score(
                data, observer=observer, fit=fit, examples=out is not None, progress=advance, **asked
            )
        place.write(result.files)
    finish(result, f"{dataset}: {sum(one.n_trials for one in result.fits)} trials", out=out, quiet=quiet, **shown)


@click.command("naked-eye")
@click.option("--contrast", type=float, help="Weber contrast; the threshold is then a size: the acuity.")
@click.option("--size-mrad", type=NUMBERS, help="Sizes; the threshold is then a contrast for each.")
@places_option
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html and tod_curve.png.")
@observer_options
@verbose_option
@json_option
@quiet_option
def naked_eye(
    *,
    contrast: float | None,
    size_mrad: list[float] | None,
    places: int,
    out: str | None,
    quiet: bool,
    **asked: Any,
) -> None:
    """Compute thresholds of the observer without any display in between."""
    if (contrast is None) == (size_mrad is None):
        raise SettingsError("naked-eye: expected one of --contrast and --size-mrad")
    shown = {name: asked.pop(name) for name in ("as_json", "verbose")}
    observer, fit = make_observer(asked, fitted=False)
    import todframes as tod

    with staged(out) as place:
        with progress("computing", 1 if size_mrad is None else len(size_mrad), quiet=quiet) as advance:
            result = tod.naked_eye(
                contrast=contrast,
                size_mrad=size_mrad,
                observer=observer,
                p_correct=fit.p_correct,
                places=places,
                progress=advance,
            )
        place.write(result.files)
    finish(result, "Naked eye", out=out, quiet=quiet, **shown)


@click.command()
@click.argument("counts", type=click.Path(path_type=Path))
@p_correct_option
@set_option
@seed_option
@verbose_option
@json_option
def fit(*, counts: Path, rng: int, as_json: bool, verbose: bool, **asked: Any) -> None:
    """Fit psychometric functions to COUNTS, a CSV file.

    Its columns are level, n_correct and n_trials; any other column names groups, with one curve each. Settings
    (--set) are guess_rate, lapse_rate, lapse_rate_max, p_correct and resamples.
    """
    settings = make_fit(asked)
    import numpy as np

    import todframes as tod
    from todframes.psychometrics.counts import read_counts

    curves = read_counts(counts)
    columns = np.concatenate([rows for _, rows in curves]).T
    groups = {name: [group[name] for group, rows in curves for _ in rows] for name in curves[0][0]}
    result = tod.fit_counts(*columns, groups=groups, fit=settings, rng=rng)
    finish(result, str(counts), as_json=as_json, verbose=verbose)
