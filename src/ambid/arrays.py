"""Aliases for numeric arrays: C-ordered, time along axis 0 unless a name says otherwise."""

from __future__ import annotations

import copyreg
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Frozen values hold mappings that cannot be written to: with this they can be copied and pickled all the same.
copyreg.pickle(MappingProxyType, lambda mapping: (read_only, (dict(mapping),)))


def read_only(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    """Return a mapping that cannot be written to."""
    return MappingProxyType(mapping)
