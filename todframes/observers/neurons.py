"""An observer with noise on every neuron, whose four scores are correlations with the expected activity."""

from __future__ import annotations

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer, keeps_last
from todframes.observers.internal_noise import Bands, inner_product
from todframes.observers.laplacian_pyramid import framed
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage


class NeuronObserver(Observer):
    """Base class of observers that correlate noisy neurons with four templates.

    A subclass computes the `activity` of its neurons, draws their `noise` and makes two templates. The literal
    path, with noise on every neuron, is the definition with which tests compare the folded readout.
    """

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the noise-free activity of all neurons, finest band first, for a retina image (side, side)."""
        raise NotImplementedError

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the noise of a band of neurons."""
        raise NotImplementedError

    def template_of(self, expected: Bands) -> Bands:
        """Return the weights of neurons for an expected activity: itself."""
        return expected

    def pattern_template(self, pattern: FloatArray, side: int) -> Bands:
        """Compute the weights of all neurons for a pattern on the middle of a retina of this side."""
        return self.template_of(self.activity(framed(pattern, side // 2)))

    def _common_template(self, stimulus: Stimulus) -> Bands:
        """Compute the part that all four templates have in common."""
        raise NotImplementedError

    def _template_deviation(self, stimulus: Stimulus) -> Bands:
        """Compute the deviation of the upright triangle's template from the common one."""
        raise NotImplementedError

    def turned(self, bands: Bands, quarter_turns: int) -> Bands:
        """Compute the activity that an image turned clockwise causes, from that of the image.

        The grid's middle is every band's middle, so that is the turned activity.
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

    def _upright(self, stimulus: Stimulus, half: int | None = None) -> FloatArray:
        """Draw the upright triangle, times its polarity, on the retina's middle: by default on all of it."""
        grid = self.grid(stimulus)
        half = grid.side // 2 if half is None else half
        return stimulus.polarity * coverage(
            (2 * half + 1, 2 * half + 1),
            size_px=stimulus.size_mrad / grid.pitch_mrad,
            x_px=half,
            y_px=half,
            orientation=Orientation.UP,
            centre=self.centre,
        )

    def noisy_activity(self, contrast: FloatArray, rng: np.random.Generator | None) -> Bands:
        """Compute the activity with noise on every neuron, or without it if `rng` is None."""
        activity = self.activity(contrast)
        return activity if rng is None else tuple(band + self.noise(band.shape, rng) for band in activity)

    def literal_score(
        self, contrast: FloatArray, pattern: FloatArray, rng: np.random.Generator | None = None
    ) -> float:
        """Compute the inner product with a pattern's template, with noise on every neuron if `rng` is given."""
        activity = self.noisy_activity(contrast, rng)
        return sum(map(inner_product, self.pattern_template(pattern, len(contrast)), activity))

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
