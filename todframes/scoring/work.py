"""The work of a scoring: an engine shows trials to the observer, and finished results may be kept."""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Generic, TypeVar, cast

import msgspec
import numpy as np

from todframes.base.errors import FrameError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Skipped
from todframes.frames.files import frame_sha256
from todframes.frames.position import check_place
from todframes.frames.trials import FrameReference, Trial, Trials
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.interface import Readout
from todframes.scoring.seen_trials import Scoring
from todframes.stimulus import Stimulus

SETTLED_NS = 2_000_000_000
"""Time after which a file that is written again has another time; the coarsest file system counts 2 s."""

Stamp = tuple[str, int, int, int, int]
"""Path, size, times of the last changes of content and status in ns, and number of a file."""

T = TypeVar("T")

Show = Callable[[Scoring, Trial, Readout | None], T]
"""Function that shows a trial to the observer, such as `score_trial`, from any thread; it can be pickled.

The readout is None if the observer is not linear. Raises FrameError if a frame cannot be used.
"""


@dataclass(frozen=True)
class TrialWork(StoredWork[Trial, bytes | FrameError], Generic[T]):
    """The showing of trials to an observer. Its results, of type `kind`, are NamedTuples of numbers, arrays of
    float64 and such tuples. They are encoded where the work is done: as bytes they take a tenth of the time to
    another process. `depends_on` is what results depend on besides the scoring and the frames; with `with_rows` a
    result also depends on the frames without noise, the level and the group of its trial.
    """

    scoring: Scoring
    show: Show[T]
    kind: type[T]
    depends_on: object = None
    with_rows: bool = False

    def function(self) -> Callable[[Trial], bytes | FrameError]:
        """Return the function that shows a trial and encodes the result; a frame that cannot be used is one."""
        scoring = self.scoring
        readout_of = lru_cache(maxsize=4)(scoring.plan.readout)
        fitting: set[Stimulus] = set()

        def show(trial: Trial) -> bytes | FrameError:
            try:
                if trial.stimulus not in fitting:  # check first: a readout may be huge
                    check_place(scoring.dataset, trial, scoring.plan.observer.centre)
                    fitting.add(trial.stimulus)
                try:
                    readout = readout_of(trial.stimulus)
                except SettingsError as error:  # an error about this row's size
                    raise FrameError(scoring.dataset.frame_path(trial.frames[0]), str(error)) from None
                return _ENCODER.encode(self.show(scoring, trial, readout))
            except FrameError as error:
                return error

        return show

    def name(self, item: Trial) -> str:
        """Return the path of a trial's first frame."""
        return str(self.scoring.dataset.frame_path(item.frames[0]))

    @cached_property
    def identity(self) -> bytes | None:
        """Fingerprint of all that is the same for all trials; None if the code of a part cannot be identified."""
        from todframes.jobs.fingerprint import fingerprint

        scoring = self.scoring
        try:
            return fingerprint(
                scoring.dataset.display,
                scoring.dataset.gaze,
                scoring.plan.observer,
                scoring.plan.whole_frames,
                scoring.decisions,
                scoring.seed,
                scoring.displacements,
                self.depends_on,
            )
        except TypeError:
            return None

    def key(self, item: Trial, *, is_done: bool) -> bytes | None:
        """Return the key of a trial's result: it stands for the bytes of its frames and for all settings."""
        if self.identity is None:
            return None
        try:
            frames = (*item.warm_up, *item.frames)
            return self._key(item, [self._contents(frame, is_done) for frame in frames])
        except FrameError:
            return None

    def stamped_key(self, item: Trial, stamp: object) -> bytes | None:
        """Return the key by the stamps of the trial's files; None if one may have been written a moment ago.
        Within `SETTLED_NS` a file can be written twice with one time.
        """
        stamps = cast("list[Stamp]", stamp)
        newest = max((max(times[2:4]) for times in stamps or ()), default=sys.maxsize)
        if self.identity is None or newest > time.time_ns() - SETTLED_NS:
            return None
        values = [frame.background_luminance_cd_m2 for frame in item.frames]
        return self._key(item, ["stamps", stamps, values])

    def _key(self, item: Trial, contents: object) -> bytes:
        assert self.identity is not None
        plan = self.scoring.plan.stimuli[item.stimulus]
        parts = (
            plan.half_width,
            plan.full_observer,
            item.number,
            item.orientation.value,
            item.stimulus.size_mrad,
            item.stimulus.polarity,
            (item.x_px, item.y_px),
            (item.level, item.group) if self.with_rows else None,
            len(item.warm_up),
            [(frame.time_s, frame.motion_px) for frame in (*item.warm_up, *item.frames)],
            contents,
        )
        # All are numbers and texts, which their representations distinguish; a fingerprint takes far longer.
        return hashlib.sha256(self.identity + repr(parts).encode(errors="surrogatepass")).digest()

    def stamp(self, item: Trial) -> list[Stamp] | None:
        """Return properties of the trial's files that change when a frame is written, without reading them."""
        folder = self.scoring.dataset.path
        frames = (*item.warm_up, *item.frames)
        names = [name for frame in frames for name in (frame.path, frame.reference) if name is not None]
        return [_stamp(os.path.join(folder, name)) for name in names]  # noqa: PTH118 - pathlib is slow

    def encode(self, result: bytes | FrameError) -> bytes | None:
        """Return an encoded result; None for a frame that cannot be used: it may be mended."""
        return None if isinstance(result, FrameError) else result

    def decode(self, encoded: bytes) -> bytes:
        """Return an encoded result. Raises msgspec.MsgspecError if it is none."""
        self.decoder.decode(encoded)
        return encoded

    @cached_property
    def decoder(self) -> msgspec.msgpack.Decoder[T]:
        """Decoder of results."""

        def array(_: type, packed: tuple[Sequence[int], bytes]) -> Any:
            return np.frombuffer(packed[1], np.float64).reshape(packed[0])

        return msgspec.msgpack.Decoder(self.kind, dec_hook=array)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without decoders, and without the trials, which other processes do not
        need."""
        self.identity  # noqa: B018 - to be the same in all processes
        return {name: value for name, value in vars(self).items() if name != "decoder"}

    def _contents(self, frame: FrameReference, is_done: bool) -> tuple[object, ...]:
        """Return the checksums of the files of a frame and the luminance that the manifest gives with it."""
        dataset = self.scoring.dataset
        references = []
        if self.with_rows and frame.reference is not None:
            references = [_sha256_of(*_stamp(str(dataset.path / frame.reference)))]
        return dataset.content_id(frame, is_read=is_done), frame.background_luminance_cd_m2, *references


def see_trials(
    scoring: Scoring,
    trials: Trials,
    show: Show[T],
    *,
    kind: type[T],
    collect: Callable[[int, T], None],
    skip_bad_frames: bool,
    run: Run,
    depends_on: object = None,
    with_rows: bool = False,
) -> list[Skipped]:
    """Show trials to the observer; return the frames that were skipped. `show` and what follows `run` are as in
    `TrialWork`. `collect` is called with the index of each trial that was seen, in any order, and its result.
    Raises FrameError if a frame cannot be used, unless bad frames are skipped: then the trials are left out and
    their frames listed.
    """
    bare = replace(scoring, dataset=replace(scoring.dataset, trials=Trials.of(())))
    work = TrialWork(bare, show, kind, depends_on, with_rows)
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
            collect(int(order[number]), work.decoder.decode(result))
    return [
        skipped
        for number in sorted(unusable)
        for skipped in skipped_frames(scoring.dataset, in_order[number], unusable[number])
    ]


def _stamp(path: str) -> Stamp:
    """Return the path of a file with the properties that the file system changes when it is written."""
    try:
        status = os.stat(path)  # noqa: PTH116 - pathlib is slow
    except OSError:
        return path, 0, 0, 0, 0
    return path, status.st_size, status.st_mtime_ns, status.st_ctime_ns, status.st_ino


@lru_cache(maxsize=1024)
def _sha256_of(path: str, *_: int) -> str:
    """Return the SHA-256 of a file with this stamp; many trials share a frame without noise."""
    return frame_sha256(path)


def _packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.shape, np.ascontiguousarray(value, np.float64).tobytes()
    return value.item()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_packed)
