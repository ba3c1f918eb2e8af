"""Stability cases of the observer: triangles of 0.01 to 2,000 retina samples, contrasts, noise.

A retina sample is 1 mrad wide here, and the triangle lies in the middle of one.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.observers.decision import answer_probabilities
from todframes.observers.interface import Readout
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.scoring.naked_eye import contrast_threshold, proportion_correct
from todframes.stimulus import Orientation, Stimulus, coverage
from todframes.studies.stability.case import MPMATH, Case, refusal

CONTRASTS = 10.0 ** np.arange(-9.0, 10.0, 3.0)

WITHIN_A_SAMPLE = (0.01, 0.1, 0.5)
"""√(area) in samples. At 0.5699 the apex reaches the sample's edge."""

COVARIANCES = {
    0.58: (3.444974047874514e-13, -3.32870289459945e-14, -2.779233468954624e-13),
    1.0: (1.0335936381047351e-06, -1.933601626949474e-08, -9.949216055657457e-07),
    5.0: (0.002645179309433822, -5.263682805585743e-05, -0.002539905653322107),
    20.0: (0.1238684007605063, -0.03370612141432233, -0.05645615793186163),
    50.0: (0.4028133923154534, -0.1266542638678868, -0.14950486457967974),
}
"""Covariances by size: of the upright triangle's score with itself, one beside and the opposite one."""

ERRORS = {
    0.58: ((7.3e4, 1.6319559457210677e-12), (1.18e5, 3.453645005888211e-30)),
    1.0: ((48.0, 1.840199612746278e-12), (78.0, 2.3544282021943653e-30)),
    5.0: ((1.2, 1.300207283174528e-12), (1.94, 1.8861901197495417e-30)),
    50.0: ((0.21, 2.7630937286988332e-12), (0.344, 1.3441585054562313e-30)),
}
"""Contrasts and P(error), by size."""

P_AT_A_TENTH = 0.9436321009239244
"""P(correct) of 20 samples at contrast 0.1."""


def observer(**settings: Any) -> PyramidObserver:
    """Make the default observer but for these settings, on a retina of samples of 1 mrad that keeps its place."""
    return PyramidObserver(
        PyramidSettings(**{"retina_pitch_mrad": 1.0, "position_jitter_samples": 0.0} | settings)
    )


def seen(observer: PyramidObserver, size: float) -> tuple[Readout, FloatArray]:
    """Return the readout for triangles of a size in samples, and the upright one's image."""
    readout = observer.linear_readout(Stimulus(size * observer.settings.retina_pitch_mrad))
    side = readout.grid.side
    return readout, coverage(
        (side, side),
        size_px=size,
        x_px=side // 2,
        y_px=side // 2,
        orientation=Orientation.UP,
        centre=observer.centre,
    )


def probabilities(contrast: ArrayLike, size: float, **settings: Any) -> FloatArray:
    """Compute the probabilities of the four answers to the upright triangle, (contrast, 4)."""
    readout, image = seen(observer(**settings), size)
    scores = np.multiply.outer(np.asarray(contrast), readout.score_deviations(image))
    return answer_probabilities(scores, readout.noise_covariance)


def errors(contrast: ArrayLike, size: float) -> FloatArray:
    """Compute the probability of the other three answers, with its own digits."""
    return np.asarray(probabilities(contrast, size)[:, 1:].sum(axis=1))


def covariance_row(size: float) -> FloatArray:
    """Return the covariances of the score of the upright triangle with itself, one beside and the opposite one."""
    return np.asarray(observer().linear_readout(Stimulus(size)).noise_covariance[0, :3])


def template_scores(size: float, **settings: Any) -> FloatArray:
    """Compute the scores that the upright triangle's own template causes, over those of the noise covariance."""
    readout, image = seen(observer(template_blur_samples=0.0, internal_noise_sd=1.0, **settings), size)
    return np.asarray(readout.score_deviations(image) / readout.noise_covariance[0])


def cases() -> list[Case]:
    """List the cases of observer and naked eye."""
    case = partial(Case, "observer")
    identical = "four identical templates"
    adjoint = "law: ⟨Lᵀt_j, c_k⟩ = ⟨t_j, t_k⟩"
    literal = MPMATH + "pixel by pixel"
    noiseless = "no noise: the largest wins"

    def naked_eye(size: float) -> list[float]:
        wavering = observer(position_jitter_samples=0.5)
        return [proportion_correct(wavering, size_mrad=size, contrast=float(c), nodes=4) for c in CONTRASTS]

    return [
        *(
            case(f"{size:g} retina samples, contrast 1e-9 to 1e9: P(correct)", [0.25] * len(CONTRASTS),
                 identical, partial(naked_eye, size), 15)
            for size in WITHIN_A_SAMPLE
        ),
        case("0.5 retina samples: threshold", "never_reached", identical,
             lambda: contrast_threshold(observer(), size_mrad=0.5).status),
        *(
            case(f"{size:g} retina samples: noise covariance", expected, literal, partial(covariance_row, size), 9)
            for size, expected in COVARIANCES.items()
        ),
        *(
            case(f"{size:g} retina samples, contrast {low:g} and {high:g}: P(error) to 1e-30", expected, literal,
                 partial(errors, (low, high), size))
            for size, pairs in ERRORS.items()
            for (low, high), expected in [zip(*pairs, strict=True)]
        ),
        case("20 retina samples, contrast 1e-9 to 1e9: P(correct)",
             [0.2500000073141853, 0.2500073142409198, 0.25736945238061243, 1.0, 1.0, 1.0, 1.0], literal,
             lambda: probabilities(CONTRASTS, 20.0)[:, 0], 9),
        *(
            case(f"{size:g} retina samples: scores of its own template", [1.0] * 4, adjoint,
                 partial(template_scores, size), 9)
            for size in (0.58, 1.0, 10.0, 100.0, 500.0)
        ),
        case("2,000 retina samples, levels = 10: scores of its own template", [1.0] * 4, adjoint,
             partial(template_scores, 2000.0, levels=10), 9),
        case("2,300 retina samples", "refused", "at most 2,276: memory",
             lambda: refusal(lambda: observer().grid(Stimulus(2300.0)), "expected at most 2276")),
        case("internal noise 0, 20 retina samples, contrast 1e-9 to 1e9: P(correct)", [1.0] * len(CONTRASTS),
             noiseless, lambda: probabilities(CONTRASTS, 20.0, internal_noise=0.0)[:, 0], 15),
        case("internal noise 0, 20 retina samples: threshold", "always_exceeded", noiseless,
             lambda: contrast_threshold(observer(internal_noise=0.0), size_mrad=20.0).status),
        case("internal noise 0, 0.5 retina samples, contrast 1e-9 to 1e9: P(correct)", [0.25] * len(CONTRASTS),
             identical, lambda: probabilities(CONTRASTS, 0.5, internal_noise=0.0)[:, 0], 15),
        case("internal noise 1e-12 and 1e12, contrast in proportion: P(correct)", [P_AT_A_TENTH] * 2, literal,
             lambda: [float(probabilities(0.1 * n, 20.0, internal_noise=0.5 * n)[0]) for n in (1e-12, 1e12)], 9),
        case("retina samples of 1e-6 and 1e6 mrad: P(correct)", [P_AT_A_TENTH] * 2, literal,
             lambda: [float(probabilities(0.1, 20.0, retina_pitch_mrad=p)[0]) for p in (1e-6, 1e6)], 9),
    ]  # fmt: skip
