"""An observer with noise on every neuron, whose four scores are correlations with the expected activity."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import Detection, Observer, Readout, keeps_last
from todframes.observers.internal_noise import Bands, inner_product, summed_noise, summed_variance
from todframes.observers.laplacian_pyramid import framed
from todframes.observers.retina import mean_of_turns, triangle_on
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

    @keeps_last(4)
    def templates(self, stimulus: Stimulus) -> tuple[Bands, ...]:
        """Compute the weights of all neurons in each score, in the order of `ORIENTATIONS`: expected activity."""
        common, upright = self._common_template(stimulus), self._template_deviation(stimulus)
        return tuple(
            tuple(mean + band for mean, band in zip(common, self.turned(upright, turns), strict=True))
            for turns in range(4)
        )

    def _upright(self, stimulus: Stimulus) -> FloatArray:
        """Draw the upright triangle, times its polarity, on the retina's middle."""
        return stimulus.polarity * triangle_on(self.grid(stimulus), stimulus.size_mrad, centre=self.centre)

    def _fold(self, bands: Bands) -> FloatArray:
        """Compute the weights on the retina of weights of neurons: the adjoint of `activity`."""
        raise NotImplementedError

    def make_readout(self, stimulus: Stimulus) -> Readout | None:
        """Fold neurons and templates onto the retina."""
        return self._folded(stimulus)

    def _folded(self, stimulus: Stimulus, *, n: int = 4, is_gaussian: bool = False) -> Readout:
        """Make the readout with the noise of all neurons, which may be taken as Gaussian. It has the first `n`
        deviations.
        """
        upright, noise_sd = self._template_deviation(stimulus), self.settings.noise_sd
        kurtosis = 0.0 if is_gaussian else self.noise_excess_kurtosis
        noise = summed_noise(upright, self.turned, noise_sd, kurtosis)
        folded = self._fold(upright)
        return Readout(
            grid=self.grid(stimulus),
            find_common=lambda: self._fold(self._common_template(stimulus)),
            deviations=np.stack([np.rot90(folded, -k) for k in range(n)]),
            find_common_variance=lambda: summed_variance(self._common_template(stimulus), noise_sd),
            **noise._asdict(),
        )

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> Detection | None:
        """Fold the observer of a pattern onto the middle of its retina; see `Observer.detection`."""
        weights = self.pattern_template(pattern, self.grid(Stimulus(width_mrad)).side)
        return Detection(framed(self._fold(weights), half_width), summed_variance(weights, self.settings.noise_sd))

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
