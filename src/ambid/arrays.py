"""Aliases for numeric arrays: C-ordered, time along axis 0 unless a name says otherwise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
