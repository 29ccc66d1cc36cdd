# SPDX-License-Identifier: MIT
"""The kinds of array that numbers are passed in; their shapes stand in the docstrings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
