"""Check that algorithms give the same pictures of the same frames: without memory of others, without chance."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.enhancement.enhanced_frame import TrialReader
from todframes.frames.dataset import Dataset
from todframes.frames.trials import Trial, Trials
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run

SAME_PICTURE = 1e-3
"""Largest difference of two pictures, in units of their mean luminance, that counts as none: rounding of 16-bit
numbers, and less contrast than a triangle needs to be seen."""


class RepeatedFrames:
    """The first two trials of a dataset, shown after each algorithm several times during a comparison.

    The second time they are shown in reverse, so that an algorithm that remembers frames gives other pictures.
    `fingerprint` is a hash of the first pictures, another for other weights that a function reads from a file.
    `differences` are the largest so far from the first pictures of each algorithm, in units of their mean
    luminance; 0 up to `SAME_PICTURE`.
    """

    def __init__(self, reader: TrialReader, dataset: Dataset, trials: Trials) -> None:
        self._reader, self._dataset = reader, dataset
        self._trials = [trials[number] for number in range(min(len(trials), 2))]
        self._first = self._pictures(self._trials)
        self.fingerprint = fingerprint(self._first)
        self.differences = {one.spec: 0.0 for one in reader.algorithms}
        self._compare(reversed(self._trials))

    def run(self, run: Run) -> Run:
        """Return the run, without its store if results could not be taken from there."""
        return replace(run, store=None) if any(self.differences.values()) else run

    def finish(self, run: Run) -> None:
        """Show the trials again after all others, and remove kept results if the pictures are others."""
        self._compare(self._trials)
        if any(self.differences.values()) and run.store is not None:
            run.store.forget()

    def _pictures(self, trials: Iterable[Trial]) -> dict[tuple[str, int], list[FloatArray]]:
        found = {}
        for trial in trials:
            with suppress(DataError):  # the comparison itself reports what cannot be used
                for spec, pictures in self._reader.pictures(self._dataset, trial):
                    n_px = math.prod(pictures[0].values.shape[:2])
                    spread = slice(None, None, math.ceil(math.sqrt(n_px / 2**18)))
                    found[spec, trial.number] = [picture.luminance(spread, spread) for picture in pictures]
        return found

    def _compare(self, trials: Iterable[Trial]) -> None:
        for key, pictures in self._pictures(trials).items():
            for picture, first in zip(pictures, self._first.get(key, ()), strict=False):
                difference = float(np.abs(picture - first).max()) / max(float(first.mean()), 1e-12)
                if difference > max(SAME_PICTURE, self.differences[key[0]]):
                    self.differences[key[0]] = difference
