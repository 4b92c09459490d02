"""What a caller feeds, as the compiled recursion takes it: contiguous, writeable, of one shape."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.polynomial.start import Identity


def columns(who: Identity, inputs: ArrayLike, outputs: ArrayLike) -> tuple[Array, Array, tuple[int, ...]]:
    """Return inputs, outputs, and the shape in which outputs came.

    `inputs`: (n_inputs,), or (n_samples, n_inputs) for a block, a number, or (n_samples,), where there is one input.
    """
    y = np.asarray(outputs, dtype=np.float64)
    m, n = y.size, who.layout.n_inputs
    u = np.zeros((m, 0)) if not n and inputs is None else np.asarray(inputs, dtype=np.float64)
    alone = m == 1 and u.shape in ((n,), () if n == 1 else (n,))
    if y.shape not in ((), (m,), (m, 1)) or not (alone or u.shape == (m, n) or (n == 1 and u.shape == (m,))):
        raise EstimationError(
            f"{who.structure}: inputs of shape {u.shape} and outputs of shape {y.shape}; a block is (n_samples, {n}) "
            "and (n_samples,). Put time along axis 0"
        )
    # read-only or strided arrays would be compiled for anew
    u, v = (np.require(x, requirements=["C", "W"]) for x in (u.reshape(m, n), y.reshape(m)))
    return u, v, y.shape
