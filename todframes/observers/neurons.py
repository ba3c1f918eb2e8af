"""An observer with noise on every neuron, whose four scores are correlations with the expected activity."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer, Readout, keeps_last
from todframes.observers.internal_noise import Bands, inner_product, summed_noise
from todframes.observers.laplacian_pyramid import framed
from todframes.observers.retina import RetinaGrid, mean_of_turns, triangle_on
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus


class NeuronObserver(Observer):
    """Base class of observers that correlate noisy neurons with four templates. A subclass computes the `activity`
    of its neurons, draws their `noise` and folds templates. The literal path, with noise on every neuron, is the
    definition with which tests compare the folded readout.
    """

    noise_excess_kurtosis: ClassVar[float] = 0.0
    """Excess kurtosis of the noise of a neuron; that of Gaussian noise."""

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the noise-free activity of all neurons, finest band first, for a retina image (side, side)."""
        raise NotImplementedError

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the noise of a band of neurons."""
        raise NotImplementedError

    def _expected(self, image: FloatArray) -> Bands:
        """Compute the weights of all neurons for an image that the observer expects: by default its activity."""
        return self.activity(image)

    def pattern_template(self, pattern: FloatArray, side: int) -> Bands:
        """Compute the weights of all neurons for a pattern on the middle of a retina of this side."""
        return self._expected(framed(pattern, side // 2))

    def _common_template(self, stimulus: Stimulus) -> Bands:
        """Compute the part that all four templates have in common."""
        return self._expected(mean_of_turns(self._upright(stimulus)))

    def _template_deviation(self, stimulus: Stimulus) -> Bands:
        """Compute the deviation of the upright triangle's template from the common one. The difference is taken
        before blur and bands; after them, the rounding of the common part would be larger than the difference
        needs.
        """
        image = self._upright(stimulus)
        image -= mean_of_turns(image)
        return self._expected(image)

    def turned(self, bands: Bands, quarter_turns: int) -> Bands:
        """Compute the activity that an image turned clockwise causes, from that of the image. The grid's middle is
        every band's middle, so that is the turned activity.
        """
        return tuple(np.ascontiguousarray(np.rot90(band, -quarter_turns)) for band in bands)

    @keeps_last(2)
    def templates(self, stimulus: Stimulus) -> tuple[Bands, ...]:
        """Compute the weights of all neurons in each score, in the order of `ORIENTATIONS`: expected activity."""
        common, upright = self._common_template(stimulus), self._template_deviation(stimulus)
        return tuple(
            tuple(mean + band for mean, band in zip(common, self.turned(upright, turns), strict=True))
            for turns in range(4)
        )

    def _upright(self, stimulus: Stimulus, half: int | None = None) -> FloatArray:
        """Draw the upright triangle, times its polarity, on the retina's middle: by default on all of it."""
        grid = self.grid(stimulus)
        if half is not None:
            grid = RetinaGrid(2 * half + 1, grid.pitch_mrad)
        return stimulus.polarity * triangle_on(grid, stimulus.size_mrad, centre=self.centre)

    def _folded(
        self,
        stimulus: Stimulus,
        upright: Bands,
        fold: Callable[[Bands], FloatArray],
        *,
        n: int = 4,
        is_gaussian: bool = False,
    ) -> Readout:
        """Make the readout of the upright triangle's template deviation, with the noise of all neurons, which may
        be taken as Gaussian. It has the first `n` deviations.
        """
        noise_sd, kurtosis = self.settings.noise_sd, 0.0 if is_gaussian else self.noise_excess_kurtosis
        # In single precision the sums would be no covariance.
        double = tuple(band.astype(np.float64, copy=False) for band in upright)
        noise = summed_noise(double, self.turned, noise_sd, kurtosis)
        folded = fold(upright)
        return Readout(
            grid=RetinaGrid(len(folded), self.grid(stimulus).pitch_mrad),
            find_common=lambda: fold(self._common_template(stimulus)),
            deviations=np.stack([np.rot90(folded, -k) for k in range(n)]),
            **noise._asdict(),
        )

    def noisy_activity(self, contrast: FloatArray, rng: np.random.Generator | None) -> Bands:
        """Compute the activity with noise on every neuron, or without it if `rng` is None."""
        activity = self.activity(contrast)
        return activity if rng is None else tuple(band + self.noise(band.shape, rng) for band in activity)

    def literal_scores(
        self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator | None = None
    ) -> FloatArray:
        """Compute the four scores as the paper does, with noise on every neuron if `rng` is given: (4,)."""
        activity = self.noisy_activity(contrast, rng)
        return np.array([sum(map(inner_product, template, activity)) for template in self.templates(stimulus)])

    def respond(self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        """Answer with the largest score, ties at random."""
        scores = self.literal_scores(contrast, stimulus, rng)
        return ORIENTATIONS[int(rng.choice(np.flatnonzero(scores == scores.max())))]


SOLVER_TOLERANCE = 1e-10
"""Residual of ideal weights, relative to the matched ones."""


def ideal_weights(covariance: Callable[[Bands], Bands], expected: Bands, most_steps: int) -> Bands | None:
    """Solve K w = d for an expected activity d by conjugate gradients; None if that takes more steps. `covariance`
    multiplies weights by K, the covariance of all noise: so the weights are those of the ideal linear observer.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    ends = np.cumsum([band.size for band in expected])[:-1]

    def bands(flat: FloatArray) -> Bands:
        parts = np.split(flat, ends)
        return tuple(part.reshape(band.shape) for part, band in zip(parts, expected, strict=True))

    def flat(weights: Bands) -> FloatArray:
        return np.concatenate([band.ravel() for band in weights])

    d = flat(expected)
    operator = LinearOperator((d.size, d.size), matvec=lambda w: flat(covariance(bands(w))), dtype=np.float64)
    weights, not_converged = cg(operator, d, rtol=SOLVER_TOLERANCE, maxiter=most_steps)
    return None if not_converged else bands(weights)
