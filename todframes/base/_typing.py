"""Array and JSON types that all modules share."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

IntArray = NDArray[np.intp]

Json = dict[str, Any]

ComplexArray = NDArray[np.complex128]
