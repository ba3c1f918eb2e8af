"""The call `validate`: every file and row of a dataset, and what its frames show, without scoring."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from todframes.base.reading import checked
from todframes.frames.contrast import frame_problems, unjudged_problems
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.dataset_files import check_writable, write_sha256
from todframes.frames.files import frame_sha256
from todframes.parameters import Progress, counted
from todframes.results.thresholds import Thresholds
from todframes.scoring.opening import inspected, loaded


@checked
def validate(
    dataset: Path | str | Dataset,
    *,
    add_sha256: bool = False,
    problem: Callable[[str, str], None] | None = None,
    progress: Progress | None = None,
) -> Thresholds:
    """Check every file and row of a dataset, and what its frames show, without scoring.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames.

        The return value of `load_dataset` is taken as well.
    add_sha256 : bool
        If all is good, write the checksum of each frame that has none into manifest.csv.
    problem : function of two texts, optional
        Called with each problem when it is found, and with the kind of problem, which is the same for many.
    progress : function of two ints, optional
        Called with the number of trials that are done, and of all.

    Returns
    -------
    Result
        Result whose `skipped` has the frames and rows that cannot be used, with the reasons; `warnings` are about
        the other frames, and `dataset` has the measurements of these.

    Raises
    ------
    DataError
        If the dataset cannot be read at all.
    OutputError
        If the manifest cannot be written.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.validate("sample_frames/naked_eye")
    >>> len(result.skipped), result.dataset.n_frames
    (0, 336)
    """
    started = time.perf_counter()
    data = loaded(dataset)
    if add_sha256:
        check_writable(data)
    sha256_of: dict[str, str] = {}
    problems: list[dict[str, str]] = []
    good: list[int] = []

    def add(frame: str, error: str, kind: str) -> None:
        problems.append({"frame": frame, "error": error})
        if problem is not None:
            problem(error, kind)

    for row in data.bad_rows:
        add(row.frame, row.error, row.error.replace(row.frame or "\0", "#"))
    for index, trial in enumerate(counted(data.trials, len(data.trials), progress)):
        wrong = list(frame_problems(data, trial))
        for error in wrong:
            add(str(error.path), str(error), error.problem)
        if not wrong:
            good.append(index)
        if add_sha256 and not problems:
            missing = [frame for frame in trial.frames if frame.sha256 is None]
            sha256_of |= {frame.path: frame_sha256(data.frame_path(frame)) for frame in missing}
    for frame in data.trials.unjudged_frames:
        for error in unjudged_problems(data, frame):
            add(str(error.path), str(error), error.problem)
        if add_sha256 and not problems and frame.sha256 is None:
            sha256_of[frame.path] = frame_sha256(data.frame_path(frame))
    if add_sha256 and not problems:
        write_sha256(data, sha256_of)
        data = load_dataset(data.path, max_frame_mb=data.max_frame_mb)
    record, warnings = inspected(data, data.trials.select(good))
    return Thresholds.made("validate", started, warnings=warnings, dataset=record, skipped=tuple(problems))
