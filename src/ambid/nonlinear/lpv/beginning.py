"""What was before a record, estimated from its first samples, so that predictions need not wait for old errors to fade.

States of the output form and first innovations, w, are those that make the innovations of the first samples small:
min |e(theta, w)|^2 + w' Lambda w, with Lambda from their own size beside the innovations'. e is linear in w. Without
it, a zero of C near the unit circle keeps an error of these alive for its time constant.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.arrays import Array
from ambid.nonlinear.lpv.shape import LpvShape, Part, errors

_EACH = 4  # samples for each number
_STATES = 0.01  # variance of an innovation over that of what a state differs by


def settling(shape: LpvShape) -> int:
    """Return the samples, beyond those that a prediction looks back over, from which a beginning is estimated."""
    return _EACH * shape.n_start


def looks_back(shape: LpvShape) -> int:
    """Return the samples of the past that a prediction needs, those of the beginning included."""
    return shape.lag + settling(shape)


def beginning(shape: LpvShape, part: Part, theta: Array, *, slopes: bool = False) -> tuple[Array, Array] | None:
    """Estimate what was before a record.

    `theta`: (n_theta,), scaled; `slopes`: whether to derive it by theta as well. Returns `w`: (n_start,), scaled;
    `slope`: (n_start, n_theta), zeros unless asked for; instead of both, where the predictor diverges.
    """
    k, P = shape.n_start, shape.n_theta
    last = looks_back(shape)
    if not k or part.y.size < last:
        return np.zeros(k), np.zeros((k, P))
    head = replace(part, y=part.y[:last], W=part.W[:last], phi=part.phi[:last], psi=part.psi[:last])
    found = errors(shape, head, theta, slopes=1)
    if not found.finite:
        return None
    e, J = found.e[shape.lag :], found.J[shape.lag :, P:]
    weight = np.ones(k)
    weight[: k - shape.ma] = _STATES
    H = J.T @ J + np.diag(weight)
    w = np.asarray(np.linalg.solve(H, J.T @ e), dtype=np.float64)
    if not slopes:
        return w, np.zeros((k, P))

    def by_theta(start: Array) -> Array:
        return errors(shape, head, theta, start, slopes=2).J[shape.lag :, :P]

    at, right = by_theta(w), np.empty((k, P))
    rest = e - J @ w
    for i in range(k):  # J is linear in w too, so that a difference over any step is its derivative
        right[i] = rest @ (by_theta(w + np.eye(k)[i]) - at)
    return w, np.asarray(np.linalg.solve(H, right - J.T @ at), dtype=np.float64)
