"""The work of a scoring: an engine shows trials to the observer, and finished results may be kept."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from todframes.base.errors import FrameError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Skipped
from todframes.frames.position import check_place
from todframes.frames.trials import Trial, Trials
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.interface import Readout
from todframes.scoring.seen_trials import Scoring
from todframes.stimulus import Stimulus

T = TypeVar("T")

Show = Callable[[Scoring, Trial, Readout | None], T]
"""Function that shows a trial to the observer, such as `score_trial`, from any thread; it can be pickled.

The readout is None if the observer is not linear. Raises FrameError if a frame cannot be used.
"""


@dataclass(frozen=True)
class TrialWork(StoredWork[Trial, T | FrameError], Generic[T]):
    """The showing of trials to an observer. Its results, of type `kind`, are NamedTuples of numbers, arrays of
    float64 and such tuples. `depends_on` is what results depend on besides the scoring and the frames.
    """

    scoring: Scoring
    show: Show[T]
    kind: type[T]
    depends_on: object = None

    def function(self) -> Callable[[Trial], T | FrameError]:
        """Return the function that shows a trial; a frame that cannot be used is its result."""
        scoring = self.scoring
        readout_of = lru_cache(maxsize=4)(scoring.readout)
        fitting: set[Stimulus] = set()

        def show(trial: Trial) -> T | FrameError:
            try:
                if trial.stimulus not in fitting:  # check first: a readout may be huge
                    check_place(scoring.dataset, trial, scoring.observer.centre)
                    fitting.add(trial.stimulus)
                try:
                    readout = readout_of(trial.stimulus)
                except SettingsError as error:  # an error about this row's size
                    raise FrameError(scoring.dataset.frame_path(trial.frames[0]), str(error)) from None
                return self.show(scoring, trial, readout)
            except FrameError as error:
                return error

        return show

    def name(self, item: Trial) -> str:
        """Return the path of a trial's first frame."""
        return str(self.scoring.dataset.frame_path(item.frames[0]))

    def identity(self) -> bytes:
        """Return a hash of the settings, and of the code of the parts."""
        from todframes.jobs.fingerprint import fingerprint

        scoring = self.scoring
        data, settings = scoring.dataset, (scoring.decisions, scoring.seed, scoring.displacements, scoring.plan)
        return fingerprint(data.display, data.gaze, scoring.observer, settings, self.kind, self.depends_on)

    def item_identity(self, item: Trial) -> str:
        """Return a hash of a trial's row and of its files' sizes and times."""
        folder = self.scoring.dataset.path
        frames = (*item.warm_up, *item.frames)
        paths = [path for frame in frames for path in (frame.path, frame.reference) if path is not None]
        files = [_status(os.path.join(folder, path)) for path in paths]  # noqa: PTH118 - pathlib is slow
        return hashlib.sha256(repr((item, files)).encode(errors="surrogatepass")).hexdigest()[:32]

    def encode(self, result: T | FrameError) -> bytes | None:
        """Return a result as bytes; None for a frame that cannot be used: it may be mended."""
        return None if isinstance(result, FrameError) else _ENCODER.encode(result)

    def decode(self, encoded: bytes) -> T:
        """Return the result that was encoded. Raises msgspec.MsgspecError if it is none."""
        return msgspec.msgpack.decode(encoded, type=self.kind, dec_hook=_array)


def score_trials(
    scoring: Scoring,
    trials: Trials,
    show: Show[T],
    *,
    kind: type[T],
    collect: Callable[[int, T], None],
    skip_bad_frames: bool,
    run: Run,
    depends_on: object = None,
) -> list[Skipped]:
    """Show trials to the observer; return the frames that were skipped. `show` and what follows `run` are as in
    `TrialWork`. `collect` is called with the index of each trial that was seen, in any order, and its result.
    Raises FrameError if a frame cannot be used, unless bad frames are skipped: then the trials are left out and
    their frames listed.
    """
    bare = replace(scoring, dataset=replace(scoring.dataset, trials=Trials.of(())))
    work = TrialWork(bare, show, kind, depends_on)
    # In the order of their stimuli, so that few readouts are held at a time.
    keys = np.array([(stimulus.polarity, stimulus.size_mrad) for stimulus in trials.stimuli])
    order = np.lexsort(keys[trials.stimulus_codes].T)
    if scoring.dataset.is_in_memory:
        run = replace(run, store=None)
    unusable: dict[int, FrameError] = {}
    in_order = trials.select(order)
    for number, result in run_stored(work, in_order, run):
        if isinstance(result, FrameError):
            if not skip_bad_frames:
                raise result
            unusable[number] = result
        else:
            collect(int(order[number]), result)
    return [
        skipped
        for number in sorted(unusable)
        for skipped in skipped_frames(scoring.dataset, in_order[number], unusable[number])
    ]


def _status(path: str) -> tuple[str, int, int]:
    """Return the path, size and time of a file."""
    try:
        status = os.stat(path)  # noqa: PTH116 - pathlib is slow
    except OSError:
        return path, 0, 0
    return path, status.st_size, status.st_mtime_ns


def _array(_: type, packed: tuple[Sequence[int], bytes]) -> Any:
    return np.frombuffer(packed[1], np.float64).reshape(packed[0])


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, np.ascontiguousarray(value, np.float64).tobytes()
    return value.item()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_packed)
