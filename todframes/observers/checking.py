"""The contract of observers: a user's own is checked by the same function as those of this package."""

from __future__ import annotations

import math
import pickle
from collections.abc import Callable, Iterator
from dataclasses import is_dataclass
from typing import Any

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.reading import checked
from todframes.observers.decision import answer_probabilities
from todframes.observers.interface import Observer, Readout, observer_named
from todframes.observers.retina import RetinaGrid, triangle_on
from todframes.stimulus import CIRCLE_PER_SIZE, ORIENTATIONS, Orientation, Stimulus

SIZES_MRAD = (0.05, 1.0, 20.0)
"""Sizes of triangles that a grid must hold."""

PLAIN_CONTRAST = 1e4
"""Contrast that nobody overlooks."""

ROUNDING = 1e-12
"""Largest difference, relative to the largest value, of figures that are equal but for rounding."""

D_PRIMES = np.geomspace(0.01, 6.0, 12)
"""Contrasts in units of the noise: from a guess to an answer that is all but sure."""

N_ANSWERS, LARGEST_CHI2 = 150, 16.27
"""Number of answers drawn, and the χ² of their four counts that one correct observer in a thousand exceeds."""

STIMULUS = Stimulus(1.0)


@checked
def check_observer(mine: object) -> list[str]:
    """Report what an observer does that commands and calls cannot use.

    Answers are drawn and images are shown: a minute may pass with a slow observer. The observers of this package
    are tested by this function.

    Parameters
    ----------
    mine : str, subclass of Observer, or Observer
        A registered name or "module:Class", a class, of which an object is made with the default settings, or an
        object.

    Returns
    -------
    list of str
        A sentence for each fault; empty if there is none.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.check_observer("pyramid")
    []
    """
    named: Any = observer_named(mine) if isinstance(mine, str) else mine
    kind = named if isinstance(named, type) else type(named)
    if not issubclass(kind, Observer):
        return [f"{kind.__name__} is no subclass of todframes.Observer."]
    if not is_dataclass(kind.settings_type):
        return [f"settings_type is {kind.settings_type!r}, expected a dataclass."]
    try:
        observer = kind(kind.settings_type()) if kind is named else named
    except Exception as error:  # the code is the user's
        return [f"An object with the default settings cannot be made: {_named(error)}."]
    sentences = [*_attempt(_settings, observer), *_attempt(_grid, observer)]
    if sentences:
        return sentences  # all other checks need them
    return [sentence for check in (_answers, _copy, _readout) for sentence in _attempt(check, observer)]


def _attempt(check: Callable[[Observer], Iterator[str]], observer: Observer) -> Iterator[str]:
    """Yield the sentences of a check, and another if the observer raises an exception."""
    try:
        yield from check(observer)
    except Exception as error:  # the code is the user's
        yield f"The check of {check.__name__[1:]} ended with {_named(error)}."


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}".rstrip(".: ")


def _settings(observer: Any) -> Iterator[str]:
    if not observer.settings_type.__dataclass_params__.frozen:
        yield f"settings_type {observer.settings_type.__name__} can be changed, expected @dataclass(frozen=True)."
    if observer.centre not in ("centroid", "bounding_box"):
        yield f"centre is {observer.centre!r}, expected 'centroid' or 'bounding_box'."
    if not 0.0 <= observer.position_jitter_samples < np.inf:
        yield f"position_jitter_samples is {observer.position_jitter_samples!r}, expected a number >= 0."


def _grid(observer: Any) -> Iterator[str]:
    for size in SIZES_MRAD:
        grid = observer.grid(Stimulus(size))
        if not isinstance(grid, RetinaGrid):
            yield f"grid returns {type(grid).__name__}, expected a RetinaGrid."
        elif grid.width_mrad <= 2.0 * CIRCLE_PER_SIZE * size:
            yield (
                f"grid is {grid.width_mrad:.4g} mrad wide for a triangle of {size:g} mrad, whose apex needs more "
                f"than {2.0 * CIRCLE_PER_SIZE * size:.4g}."
            )


def _triangle(observer: Observer, stimulus: Stimulus, orientation: Orientation, dx: float = 0.0) -> FloatArray:
    """Draw a triangle of contrast 1 on the middle of the grid, or to the right of it."""
    grid = observer.grid(stimulus)
    image = triangle_on(grid, stimulus.size_mrad, orientation, x=dx, centre=observer.centre)
    return stimulus.polarity * image


def _drawn(observer: Observer, image: FloatArray, n: int, seed: int = 5) -> list[Orientation]:
    rng = np.random.default_rng(seed)
    return [observer.respond(image.copy(), STIMULUS, rng) for _ in range(n)]


def _answers(observer: Any) -> Iterator[str]:
    for polarity in (1, -1):
        stimulus = Stimulus(2.0, polarity)
        for orientation in ORIENTATIONS:
            image = PLAIN_CONTRAST * _triangle(observer, stimulus, orientation)
            answer = observer.respond(image, stimulus, np.random.default_rng(1))
            if not isinstance(answer, Orientation):
                yield f"respond returns {answer!r}, expected one of ORIENTATIONS."
                return
            if answer is not orientation:
                kind = "brighter" if polarity > 0 else "darker"
                yield (
                    f"respond answers {answer.value} to a plain triangle, {kind} than the background, that points "
                    f"{orientation.value}."
                )
    weak = 0.1 * _triangle(observer, STIMULUS, Orientation.UP)
    if _drawn(observer, weak, 20) != _drawn(observer, weak, 20):
        yield "respond draws other answers with the same generator: take all random numbers from rng."


def _copy(observer: Observer) -> Iterator[str]:
    """Check the copy that a process gets, after readouts were kept."""
    observer.readout(STIMULUS)
    copy = pickle.loads(pickle.dumps(observer))
    if (copy.readout(STIMULUS) is None) != (observer.readout(STIMULUS) is None):
        yield "A pickled copy has a readout where the observer has none, or none where it has one."
    weak = 0.1 * _triangle(observer, STIMULUS, Orientation.UP)
    if _drawn(copy, weak, 5) != _drawn(observer, weak, 5):
        yield "A pickled copy draws other answers: keep everything that these depend on in attributes."


def _readout(observer: Any) -> Iterator[str]:
    readout = observer.readout(STIMULUS)
    if readout is None:
        return
    if not isinstance(readout, Readout):
        yield f"readout returns {type(readout).__name__}, expected a Readout or None."
        return
    side = readout.grid.side
    if readout.deviations.shape != (4, side, side) or readout.noise_covariance.shape != (4, 4):
        yield (
            f"The readout has deviations of shape {readout.deviations.shape} and a noise_covariance of shape "
            f"{readout.noise_covariance.shape}, expected {(4, side, side)} and (4, 4)."
        )
        return
    covariance, largest = readout.noise_covariance, np.abs(readout.noise_covariance).max()
    if np.abs(readout.deviations.sum(axis=0)).max() > ROUNDING * np.abs(readout.deviations).max():
        yield "The four images of deviations do not sum to 0: subtract their mean."
    if np.abs(covariance - covariance.T).max() > ROUNDING * largest:
        yield "noise_covariance is not symmetric."
    elif np.linalg.eigvalsh(covariance).min() < -ROUNDING * largest:
        yield "noise_covariance has a negative eigenvalue: it is no covariance."
    if np.abs(covariance.sum(axis=0)).max() > ROUNDING * largest:
        yield "The rows of noise_covariance do not sum to 0: compute it from deviations alone."
    yield from _symmetry(observer, readout)
    if covariance.any():
        yield from _frequencies(observer, readout)


def _symmetry(observer: Observer, readout: Readout) -> Iterator[str]:
    image = np.random.default_rng(0).normal(size=(readout.grid.side,) * 2)
    scores = readout.score_deviations(image)
    for turns in range(1, 4):
        turned = readout.score_deviations(np.rot90(image, -turns).copy())
        if np.abs(turned - np.roll(scores, turns)).max() > ROUNDING * np.abs(scores).max():
            yield f"An image turned clockwise by {90 * turns}° has other scores than the image, turned."
    uniform = readout.score_deviations(np.full((readout.grid.side,) * 2, 0.37))
    if np.abs(answer_probabilities(uniform, readout.noise_covariance) - 0.25).max() > 1e-9:
        yield "A uniform field is no guess: its four answers have different probabilities."
    dark = observer.readout(Stimulus(STIMULUS.size_mrad, -1))
    if dark is None or np.abs(dark.score_deviations(-image) - scores).max() > ROUNDING * np.abs(scores).max():
        yield "A darker triangle on the negative image has other scores: multiply templates by stimulus.polarity."


def _frequencies(observer: Observer, readout: Readout) -> Iterator[str]:
    """Compare the probabilities of answers with contrast, and with the answers drawn where all are frequent."""
    covariance = readout.noise_covariance
    for orientation in ORIENTATIONS:
        right = orientation.quarter_turns
        image = _triangle(observer, STIMULUS, orientation, dx=0.2)
        deviations = readout.score_deviations(image)
        beside = (right + 1) % 4
        signal = deviations[right] - deviations[beside]
        noise = math.sqrt(covariance[right, right] + covariance[beside, beside] - 2.0 * covariance[right, beside])
        if signal > 0.0:
            unit = noise / signal  # contrast at which the two differ by the noise
            p_correct = readout.answer_probabilities(unit * D_PRIMES[:, None] * deviations)[:, right]
            if (np.diff(p_correct) > 0.0).all() and p_correct[-1] > 0.99:
                continue
        yield f"More contrast of a triangle that points {orientation.value} does not make its answer surer."
        return
    # Of the last orientation, whose template is turned most often.
    contrast = 1.4 * unit
    expected = N_ANSWERS * readout.answer_probabilities(contrast * deviations)
    answers = [answer.quarter_turns for answer in _drawn(observer, contrast * image, N_ANSWERS, seed=3)]
    counts = np.bincount(answers, minlength=4)
    if (np.square(counts - expected) / expected).sum() > LARGEST_CHI2:
        drawn, computed = (
            ", ".join(f"{n:.0f} {orientation.value}" for n, orientation in zip(numbers, ORIENTATIONS, strict=True))
            for numbers in (counts, expected)
        )
        yield f"respond draws other answers than the readout expects: {drawn}, expected about {computed}."
