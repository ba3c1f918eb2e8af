"""What an observer is: a stimulus in, weights on the retina and noise on the four scores out.

A linear observer needs no more than a `Readout`: its four scores are inner products with the retina image, and
the noise on all its neurons reaches the decision as one four-vector. One that is not linear answers itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from todframes.errors import SettingsError
from todframes.retina import RetinaGrid
from todframes.settings import check_keys
from todframes.stimulus import Centre, Orientation

FloatArray = NDArray[np.float64]

ENTRY_POINT_GROUP = "todframes.observers"


def inner_product(a: FloatArray, b: FloatArray) -> float:
    """Sum of products of two images of one shape.

    Not by BLAS, whose threads wait for each other a hundred times longer than the sum takes when other
    threads keep the processors busy.
    """
    return float(np.einsum("ij,ij->", a, b))


@dataclass(frozen=True, slots=True)
class Stimulus:
    """What the observer knows of a trial beforehand: all but the orientation.

    `size_mrad` is √(area) as displayed, `polarity` 1 for brighter and -1 for darker than the background.
    """

    size_mrad: float
    polarity: int = 1


@dataclass(frozen=True, slots=True, eq=False)
class Readout:
    """A linear observer of one stimulus: the weight of each retina sample in each of the four scores.

    The four templates are nearly alike, so they are kept as their mean and the deviations from it, and the
    noise covariance is formed from deviations: no digit is lost to what all four have in common.

    Attributes
    ----------
    grid : RetinaGrid
    common : ndarray, shape (side, side)
        Weights that all four scores share.
    deviations : ndarray, shape (4, side, side)
        Weights of each score less `common`, in the order of `ORIENTATIONS`.
    noise_covariance : ndarray, shape (4, 4)
        Of the internal noise on the four scores less the noise they share.
    excess_kurtosis : float
        Of the summed noise on the difference of two scores: the one farthest from the Gaussian's 0.
    """

    grid: RetinaGrid
    common: FloatArray
    deviations: FloatArray
    noise_covariance: FloatArray
    excess_kurtosis: float

    def scores(self, contrast: FloatArray) -> FloatArray:
        """Noise-free inner products of a retina image, shape (side, side), with the four templates: (4,)."""
        return self.score_deviations(contrast) + self.common_score(contrast)

    def score_deviations(self, contrast: FloatArray) -> FloatArray:
        """The scores less their mean, all that the decision needs, with all digits: (4,)."""
        return np.asarray(self.deviations.reshape(4, -1) @ contrast.reshape(-1))

    def common_score(self, contrast: FloatArray) -> float:
        """The mean of the four scores."""
        return inner_product(self.common, contrast)

    def cropped(self, half_width: int) -> Readout:
        """The same for the middle of the grid only: so many samples on each side of the middle one."""
        margin = self.grid.side // 2 - half_width
        inner = slice(margin, self.grid.side - margin)
        return replace(
            self,
            grid=RetinaGrid(2 * half_width + 1, self.grid.pitch_mrad),
            common=np.ascontiguousarray(self.common[inner, inner]),
            deviations=np.ascontiguousarray(self.deviations[:, inner, inner]),
        )

    @property
    def non_gaussian_bound(self) -> float:
        """Bound on the error in P(correct) from taking the summed internal noise as Gaussian, to first order."""
        return non_gaussian_bound(self.excess_kurtosis)


class LeftOut(NamedTuple):
    """What a readout leaves out to save time.

    Attributes
    ----------
    grid : RetinaGrid
        May be coarser than the readout's; its middle lies at the same place.
    deviations : ndarray, shape (4, side, side)
        What is missing from the readout's weights.
    noise_covariance : ndarray, shape (4, 4)
        What is missing from that of the readout.
    """

    grid: RetinaGrid
    deviations: FloatArray
    noise_covariance: FloatArray


def non_gaussian_bound(excess_kurtosis: float) -> float:
    """Bound on the error in P(correct) from taking noise on score differences as Gaussian, to first order.

    The first Edgeworth term of one score difference is κ/24 · He₃(x) φ(x), at most 0.5506 |κ| / 24; three
    differences decide.
    """
    return 3.0 * 0.5506 / 24.0 * abs(excess_kurtosis)


class Observer(Protocol):
    """What an observer must offer; register the class under the entry-point group `todframes.observers`.

    The class is called with one argument, an instance of its `settings_type`, a frozen dataclass whose fields
    are the names that users set. `centre` says which point of the triangle the grid's middle lies on and
    `position_jitter_samples` how far, at most, it is displaced along x and y in each trial.
    """

    settings_type: ClassVar[type[Any]]

    def __init__(self, settings: Any) -> None: ...

    @property
    def centre(self) -> Centre:
        """Point of the triangle on which the retina grid is centred."""

    @property
    def position_jitter_samples(self) -> float:
        """Half the width of the uniform displacement of the grid, in retina samples."""

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """The retina samples it looks at."""

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Its weights and noise, or None if it is not linear and can only `respond`."""

    def respond(self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        """One answer to a retina image of shape (side, side), its internal noise drawn from `rng`."""


@runtime_checkable
class Thrifty(Protocol):
    """What an observer may offer besides, if its readout leaves out what next to nothing depends on."""

    def full(self) -> Observer:
        """The same observer, leaving nothing of weight out."""

    def left_out(self, stimulus: Stimulus) -> LeftOut | None:
        """What its readout leaves out; None: nothing."""


def find_observer(name: str) -> type[Observer]:
    """The observer class registered under a name in the entry-point group `todframes.observers`.

    Raises
    ------
    SettingsError
        If there is none of this name, or it cannot be imported.
    """
    from importlib.metadata import entry_points

    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    check_keys([name], found, "observer")
    try:
        return cast("type[Observer]", found[name].load())
    except (ImportError, AttributeError) as error:
        raise SettingsError(f"observer: {name!r} cannot be loaded ({error})") from None
