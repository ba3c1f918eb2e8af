"""The four-bar pattern of MRTD and MRC: its exact pixel coverage and closed-form spectrum.

Four bars, each seven times as long as it is wide, with spaces as wide as a bar, fill a square of seven widths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.reading import Positive, check_values
from todframes.parameters import Against

WIDTHS = 7
"""Width and height of the pattern, in widths of a bar."""

MIDDLES = (-3.0, -1.0, 1.0, 3.0)
"""Middles of the bars from the pattern's middle, in widths of a bar."""

SHARE = len(MIDDLES) / WIDTHS
"""Share of the square that the bars cover: contrast of a uniform square with the same mean."""


@dataclass(frozen=True, slots=True)
class FourBars:
    """Four upright bars of contrast 1 about the origin, less what an observer distinguishes them from: the uniform
    background, or a uniform square of the pattern's size and mean. The width of a bar is half a period.
    """

    bar_width: Positive
    against: Against = "square"

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def side(self) -> float:
        """Width and height of the pattern, in the unit of `bar_width`."""
        return WIDTHS * self.bar_width

    @property
    def square_contrast(self) -> float:
        """Contrast of the square that is subtracted."""
        return SHARE if self.against == "square" else 0.0

    def profiles(self, middle: ArrayLike, width: float) -> tuple[FloatArray, FloatArray]:
        """Compute the means over intervals of the contrast along x, and of the bars' length along y. Intervals of
        a width have their middles at places from the pattern's middle, of any shape. The mean over a rectangle is
        the product of the two.
        """
        place = np.asarray(middle, dtype=np.float64)

        def covered(at: float, length: float) -> FloatArray:
            low, high = place - width / 2.0 - at, place + width / 2.0 - at
            return np.asarray(np.diff(np.clip([low, high], -length / 2.0, length / 2.0), axis=0)[0] / width)

        square = covered(0.0, self.side)
        bars = sum(covered(one * self.bar_width, self.bar_width) for one in MIDDLES)
        return np.asarray(bars - self.square_contrast * square), square

    def image(self, half: int, pitch: float) -> FloatArray:
        """Draw the pattern on (2 · half + 1)² pixels of this pitch, its middle on that of the middle pixel."""
        along_x, along_y = self.profiles(np.arange(-half, half + 1) * pitch, pitch)
        return np.outer(along_y, along_x)

    def spectrum(self, frequency_x: ArrayLike, frequency_y: ArrayLike) -> ComplexArray:
        """Compute the Fourier transform ∬ exp(−2πi (f_x x + f_y y)) of the contrast, real and even, at frequencies
        in cycles per unit of `bar_width` that broadcast.
        """
        fx, fy = (np.asarray(one, dtype=np.float64) for one in (frequency_x, frequency_y))
        width, side = self.bar_width, self.side
        waves = sum(np.cos(2.0 * np.pi * one * width * fx) for one in MIDDLES)
        along_x = width * np.sinc(width * fx) * waves - self.square_contrast * side * np.sinc(side * fx)
        return np.asarray(side * np.sinc(side * fy) * along_x, dtype=np.complex128)
