"""Trials on scenes: which of them share a background, and what is left of their windows without it.

All trials of one background show it with triangles of different orientations or levels, so backgrounds and
triangles are known from a joint fit (`Images.of`). What is left of a window without its background is what it
would be on an even field, and is judged in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.diagnosis.triangle import Given, Images, TriangleFit, subtract
from todframes.diagnosis.windows import TrialSample
from todframes.frames.trials import Trials
from todframes.stimulus import circle_about

VIEWED_TIMES, MOST_OF_VIEW = 3, 8
"""Number of trials with scenes that are measured, in those on even backgrounds, and of those of one background if
there are many: with eight, its error adds an eighth to the variance of the noise."""


def whole_views(trials: Trials, strength: FloatArray, most: int) -> NDArray[np.intp]:
    """Choose trials so that their backgrounds are known: of views spread over the manifest, up to a few of each.
    `trials` are those of a group, `strength` what their displayed contrast is proportional to, and `most` the
    number that would be chosen on an even background. A view is left out if all of its trials have one orientation
    and one strength.
    """
    usable = []
    for _, members in trials.by_view():
        turns, levels = trials.quarter_turns[members], strength[members]
        if np.unique([turns, levels], axis=1).shape[1] > 1:
            usable.append(members[np.lexsort([turns, levels])])
    if not usable:
        return np.zeros(0, np.intp)
    of_each = max(MOST_OF_VIEW, most * VIEWED_TIMES // len(usable))
    chosen = [ordered[_evenly(len(ordered), of_each)] for ordered in usable]
    n_views = int(most * VIEWED_TIMES / np.mean([len(trial) for trial in chosen]))
    return np.concatenate([chosen[k] for k in _evenly(len(chosen), max(n_views, 1))])


def _evenly(n: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, n - 1, min(n, most)).round().astype(np.intp)


def view_middles(trials: Trials) -> list[tuple[float, float] | None]:
    """Return for each trial the mean stated place of its view: windows cut there show the same pixels."""
    places = trials.positions_px.copy()
    for _, members in trials.by_view():
        places[members] = places[members].mean(axis=0)
    return [None if math.isnan(x) else (x, y) for x, y in places.tolist()]


def numbered_views(samples: Sequence[TrialSample]) -> NDArray[np.intp]:
    """Return the number, from 0, of the background of each window."""
    keys = [sample.trial.view for sample in samples]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([numbers[key] for key in keys], np.intp)


def that_share(samples: Sequence[TrialSample]) -> list[TrialSample]:
    """Return the windows whose background is that of others too; none if they are too few for a joint fit."""
    view = numbered_views(samples)
    counts = np.bincount(view)
    kept = [sample for sample, number in zip(samples, view.tolist(), strict=True) if counts[number] > 1]
    return kept if len(kept) > int((counts > 1).sum()) + 4 else []


def _parted(left: FloatArray, of_view: FloatArray, view: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """Return the mean of each view, (view, n, n), and the noise, corrected for its part in that mean."""
    backgrounds = np.tensordot(of_view, left, 1)
    counts = np.bincount(view)[view].astype(np.float64)
    noise = (left - backgrounds[view]) * np.sqrt(counts / np.maximum(counts - 1.0, 0.5))[:, None, None]
    return backgrounds, noise


def without_scenes(
    windows: FloatArray, given: Given, known: NDArray[np.bool_], view: NDArray[np.intp]
) -> FloatArray:
    """Return windows on scenes without their backgrounds, as a fit with the given noise finds them."""
    first = Images.of(windows, given, known=known, hole=0.0, view=view)
    assert first.of_view is not None
    return _parted(windows - given.level[:, None, None] * first.triangles[given.turns], first.of_view, view)[1]


class SceneParts(NamedTuple):
    """Windows on scenes as background, triangle and noise. `backgrounds`, (view, n, n), are contrasts in the sign
    of the triangles' polarity; `even`, (trial, n, n), are triangle and noise, as on an even field; `view` is the
    number of each trial's background.
    """

    view: NDArray[np.intp]
    backgrounds: FloatArray
    even: FloatArray
    noise: FloatArray

    @classmethod
    def of(
        cls, windows: FloatArray, triangle: TriangleFit, images: Images, given: Given, view: NDArray[np.intp]
    ) -> SceneParts:
        """Separate windows by the mean triangles, or by the fitted one if only their differences are known."""
        assert images.of_view is not None
        triangles = images.triangles
        if not images.has_triangle:
            triangles = np.zeros_like(images.triangles)
            subtract(triangles, -triangle.picture.images[list(triangle.shown)], triangle.square)
        shown = given.level[:, None, None] * triangles[given.turns]
        backgrounds, noise = _parted(windows - shown, images.of_view, view)
        return cls(view, backgrounds, shown + noise, noise)

    def on_even_field(
        self, samples: Sequence[TrialSample], polarity: int, size: float, *, keeps_ring: bool
    ) -> list[TrialSample]:
        """Return windows with noise and luminance as they would be on an even field. The luminance around the
        triangle is that in the circle through its corners, without the triangle. With `keeps_ring` it is as good
        as measured: the dataset takes its background from the same pixels.
        """
        n = self.backgrounds.shape[-1]
        local, offsets = np.zeros(len(self.backgrounds)), np.array([sample.offset for sample in samples])
        for number in range(0 if keeps_ring else len(local)):
            x, y = (offsets[self.view == number].mean(axis=0) + (n - 1) / 2.0).tolist()
            circle = circle_about((n, n), size_px=size, x_px=x, y_px=y)
            local[number] = polarity * float((circle * self.backgrounds[number]).sum())
        return [
            sample._replace(
                ring_cd_m2=sample.background_cd_m2 * max(1.0 + float(local[number]), 1e-9),
                noise=float(noise[sample.known].std()) * sample.block_px,
                even=polarity * even,
            )
            for sample, number, noise, even in zip(samples, self.view, self.noise, self.even, strict=True)
        ]

    def of_scenes(self, names: Sequence[str]) -> FloatArray | None:
        """Return the mean background of each scene, (scene, n, n), the scene of each trial given; None if few."""
        of_view = {int(number): name for number, name in zip(self.view, names, strict=True)}
        scenes = sorted(set(names))
        if len(scenes) < 4:  # their mean does not tell what all share, such as dirt, from what a scene shows
            return None
        which = np.array([scenes.index(of_view[number]) for number in range(len(self.backgrounds))])
        return np.array([self.backgrounds[which == number].mean(axis=0) for number in range(len(scenes))])
