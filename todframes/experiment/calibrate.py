"""The call `calibrate`: the internal noise, or the efficiency, that explains the answers of people."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.experiment.calibration import CalibratedPeople, FurtherObserver
from todframes.frames.dataset import Dataset
from todframes.jobs.run import opened_run
from todframes.observers.interface import Observer
from todframes.parameters import Count, Free, ObserverNames, OnError, Progress, Seed, Subjects
from todframes.psychometrics.fit import FitSettings
from todframes.results.data import DatasetRecord, observer_names
from todframes.results.thresholds import Thresholds
from todframes.scoring.opening import described_each, loaded, of_observer

if TYPE_CHECKING:
    from todframes.experiment.answers import Session


@checked
def calibrate(
    dataset: Path | str | Dataset,
    answers: Path | str,
    *,
    observer: str | ObserverNames | Observer | Sequence[str | Observer] = "pyramid",
    free: Sequence[Free] = (),
    subjects: Subjects = (),
    include_flagged: bool = False,
    fit: FitSettings | None = None,
    rng: Seed | Rng = 1,
    on_error: OnError = "stop",
    workers: Count = 1,
    progress: Progress | None = None,
) -> Thresholds:
    """Fit the observer's internal noise, or its efficiency, to the answers of people to the frames of a dataset.

    With several observers, the first lines say which explains each person better, by AIC.

    Parameters
    ----------
    dataset : path, str or Dataset
        The folder of the dataset that was shown.

        The return value of `load_dataset` is taken as well.
    answers : path
        Folder that `todframes experiment` wrote.
    observer : str, Observer, or sequence of them
        Observers by name: pyramid, csf or others that are linear and registered; or MODULE:CLASS, a class of your
        own, whose code is run. The value of the noise or efficiency that is fitted is not used.

        Objects are taken as well. The first is that of `persons`, the others of `observers`.
    free : sequence of {"lapse", "blur"}
        Fit the rate of lapses, or the blur of the templates, too.

        The rate δ of lapses is up to `lapse_rate_max` of `fit`; the blur is the observer's
        `template_blur_samples`, from a quarter to twice its value.
    subjects : sequence of str
        A person, by the id. Default: all.
    include_flagged : bool
        Count answers within 150 ms, or while the page was hidden or had lost the focus, as well.
    fit : FitSettings, optional
        Fixed and free parameters of the persons' own curves. A fixed `lapse_rate` is that of the model too.
    rng : int, SeedSequence or Generator
        Seed of the displacements of the retina and of repeated experiments.
    on_error : {"stop", "skip"}
        At a frame that cannot be used or has changed since: end with an error, or leave its trials out and list
        them.
    workers : int
        Processes that share the work.
    progress : function of two ints, optional
        Called with the number of trials of a session that are done, and of all.

    Returns
    -------
    Result
        Result whose `persons` have the internal noise, or the efficiency, of each person and the thresholds of the
        model with it; `pooled` is for all persons together. `thresholds` are the persons' own, from their counts
        alone.

    Raises
    ------
    DataError, FrameError
        If the answers are damaged or belong to another dataset, or a frame cannot be used or has changed since.
    SettingsError
        If a setting is invalid, or the observer's noise cannot be fitted.
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from todframes.experiment.answers import DESCRIPTION_FILE, read_answers
    from todframes.experiment.person import calibrate_persons

    if isinstance(dataset, str | Path) and (Path(dataset) / DESCRIPTION_FILE).exists():
        raise SettingsError(f"dataset: {dataset} holds answers, expected calibrate(dataset, answers)")
    fit = fit or FitSettings()
    sessions = read_answers(Path(answers), include_flagged=include_flagged)
    known = {session.subject for session in sessions}
    for subject in subjects:
        if subject not in known:
            raise DataError(f"{answers}: found no subject {subject!r}, expected one of {', '.join(sorted(known))}")
    sessions = [session for session in sessions if not subjects or session.subject in subjects]
    judges, each_settings = described_each(observer, lambda: _background_of(sessions))
    data = loaded(dataset)
    skips = on_error == "skip"
    with opened_run(workers, None, None, progress) as run:
        how = partial(calibrate_persons, free=free, fit_settings=fit, seed=seed, skip_bad_frames=skips, run=run)
        each = [how(data, sessions, judge) for judge in judges]
    fitted = ("efficiency", "internal_noise", "internal_noise_sd", *(["template_blur_samples"] * ("blur" in free)))
    results = []
    for own, calibrated in zip(each_settings, each, strict=True):
        kept = {name: value for name, value in own.items() if name not in fitted}
        results.append(FurtherObserver(settings=kept, persons=calibrated.persons, pooled=calibrated.pooled))
    first, *further = results
    names = observer_names([result.settings for result in results]) if further else [""]
    return CalibratedPeople.made(
        "calibrate",
        started,
        settings=first.settings | asdict(fit) | {"free": list(free), "include_flagged": include_flagged},
        seed=seed,
        fits=each[0].own,
        persons=first.persons,
        pooled=first.pooled,
        equal_noise_p_value=each[0].equal_noise_p_value,
        dataset=DatasetRecord.of(data),
        skipped=tuple(row._asdict() for row in each[0].skipped),
        observers=tuple(further),
        warnings=tuple(
            warning
            for name, calibrated in zip(names, each, strict=True)
            for warning in of_observer(name, calibrated.warnings)
        ),
    )


def _background_of(sessions: Sequence[Session]) -> float:
    """Return the luminance of the monitors' background in cd/m²: the mean over sessions."""
    backgrounds = [session.monitor.background_luminance_cd_m2 for session in sessions]
    if None in backgrounds:
        raise SettingsError(
            "luminance_cd_m2: found background, which is not known: no photometer was read in the experiment; "
            "expected a number"
        )
    return math.fsum(luminance for luminance in backgrounds if luminance is not None) / len(backgrounds)
