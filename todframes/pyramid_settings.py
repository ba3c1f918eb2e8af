"""Settings of the model observer.

Hogervorst et al. 2001, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

from todframes.errors import SettingsError
from todframes.settings import check_ranges
from todframes.stimulus import Centre

MOST_LEVELS = 11
"""A retina image then takes half a GB."""
SETTING_RANGES = (
    ("retina_pitch_mrad", 1e-6, 1e6),
    ("position_jitter_samples", 0.0, 1e3),
    ("kernel_a", 0.0, 1.0),
    ("band_gain", 1e-3, 1e3),
    ("template_blur_samples", 0.0, 1e3),
    ("internal_noise", 0.0, 1e12),
    ("internal_noise_sd", 0.0, 1e12),
)
"""What is not in here (NaN among it) is a slip of the pen, and might overflow or fill the memory."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PyramidSettings:
    """Settings of the paper's observer; every ambiguity of the paper is one of them.

    Attributes
    ----------
    centre : {"centroid", "bounding_box"}
        What the four templates have in common, and what lies on the grid's middle.
    retina_pitch_mrad : float
        Visual angle of a retina sample.
    position_jitter_samples : float
        The grid is displaced by up to this many samples along x and y in each trial; 0: never.
    kernel_a : float
        Centre weight of the pyramid's kernel; 0.375 is [1 4 6 4 1]/16.
    levels : int or None
        Pyramid bands. None: enough for the triangle, at least 4, so that further bands and a wider field
        move thresholds by less than 1e-5 of their value with the other settings at their defaults, and by less
        than 1e-3 with bounding-box centring or strong template blur. The grid's side is 4 · 2^levels + 1.
    include_residual : bool
        Whether the low-pass residual takes part in the correlation.
    band_gain : float
        Gain of each band over the next finer one.
    template_blur_samples : float
        Standard deviation of the Gaussian that blurs the templates, in retina samples.
    internal_noise : float
        Full width of the uniform noise on each neuron.
    internal_noise_sd : float or None
        Its standard deviation, instead of internal_noise / √12.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    centre: Centre = "centroid"
    retina_pitch_mrad: float = 0.153
    position_jitter_samples: float = 0.5
    kernel_a: float = 0.375
    levels: int | None = None
    include_residual: bool = False
    band_gain: float = 1.0
    template_blur_samples: float = 1.2
    internal_noise: float = 0.5
    internal_noise_sd: float | None = None

    def __post_init__(self) -> None:
        if self.centre not in get_args(Centre):
            raise SettingsError(f"centre: found {self.centre!r}, expected one of {', '.join(get_args(Centre))}")
        check_ranges(self, SETTING_RANGES)
        if self.levels is not None and not 1 <= self.levels <= MOST_LEVELS:
            raise SettingsError(f"levels: found {self.levels!r}, expected a whole number from 1 to {MOST_LEVELS}")

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the noise on each neuron."""
        if self.internal_noise_sd is not None:
            return self.internal_noise_sd
        return self.internal_noise / math.sqrt(12.0)
