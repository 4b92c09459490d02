"""What all frequency response methods share: checked arrays, names, and the ratio of joint spectra with its covariance.

Outputs and inputs are one vector Z = [Y; U]. Every method gives responses of Z to something independent of the noise
(experiments, references, the inputs themselves) with their joint covariance; G and its covariance follow here.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError

FEEDBACK = (
    "without a reference the response is biased towards -1/controller where feedback carries the noise to the input; "
    "give the reference r (--reference), or open_loop=True (--open-loop) if there was no feedback"
)


def checked(
    u: Array,
    y: Array,
    r: Array | None,
    rate_hz: float,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> tuple[Array, Array, Array | None]:
    """Return u, y and r as columns, refused where their lengths differ or a value is not finite."""
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise EstimationError(f"a sampling rate of {rate_hz} Hz; it must be positive. Give the rate of the record")
    u, y = columns(u, "input", inputs), columns(y, "output", outputs)
    r = None if r is None else columns(r, "reference")
    for what, x in (("outputs", y), ("references", r)):
        if x is not None and x.shape[0] != u.shape[0]:
            raise EstimationError(f"{x.shape[0]} samples of the {what}, {u.shape[0]} of the inputs. Cut one")
    if r is not None and r.shape[1] < u.shape[1]:
        raise EstimationError(
            f"{r.shape[1]} references for {u.shape[1]} inputs; each input needs a reference of its own to be told "
            "apart from the others. Excite the loop at as many places"
        )
    return u, y, r


def columns(x: Array, what: str, names: Sequence[str] | None = None) -> Array:
    """Return `x` as shape (n_samples, n_columns), float64; messages call its columns by name where they have one."""
    x = np.asarray(x)
    if np.iscomplexobj(x) or x.ndim not in (1, 2) or x.size == 0:
        raise EstimationError(f"the {what} has shape {x.shape}; it must be real, (n_samples, n). Reshape it")
    x = np.asarray(x[:, None] if x.ndim == 1 else x, dtype=np.float64)
    named = names is not None and len(names) == x.shape[1]
    called = [f"{what} {names[k]!r}" if names and named else f"{what} {k + 1}" for k in range(x.shape[1])]
    if not np.isfinite(x).all():
        row, column = np.argwhere(~np.isfinite(x))[0]
        raise EstimationError(f"{called[column]} is not finite at sample {row}. Mend the record, or cut that part off")
    for k in range(x.shape[1]):
        if np.all(x[:, k] == x[0, k]):
            raise EstimationError(f"{called[k]} is constant; it has no frequency response. Leave it out")
    return x


def labels(names: Sequence[str] | None, letter: str, count: int) -> tuple[str, ...]:
    """Return the names given, or u1, u2, ..."""
    if names is None:
        return tuple(f"{letter}{k + 1}" for k in range(count))
    if len(names) != count:
        raise EstimationError(f"{len(names)} names {tuple(names)} for {count} channels. Give one for each")
    return tuple(names)


def ratio(Z: Complex, covariance: Complex, n_y: int, weight: Complex | None = None) -> tuple[Complex, Complex]:
    """Return G and its covariance from joint responses `Z` and the covariance of vec(Z) row by row."""
    G, T = ratio_map(Z, n_y, weight)
    return G, transformed(covariance, T)


def ratio_map(Z: Complex, n_y: int, weight: Complex | None = None) -> tuple[Complex, Complex]:
    """Return G = Y U⁻¹ and T, the derivative of vec(G) by vec(Z), both row by row.

    dG = [I, -G] dZ U⁻¹ to first order, so T = [I, -G] ⊗ U⁻ᵀ; T C Tᴴ is Pintelon and Schoukens 2012, eq. 2-32 f., for
    any number of inputs. With more columns than inputs, U⁻¹ is the right inverse W Uᴴ (U W Uᴴ)⁻¹.

    `Z` (n_f, n_z, m), `weight` W (n_f, m, m).
    """
    Y, U = Z[:, :n_y], Z[:, n_y:]
    inverse = right_inverse(U, weight)
    G = Y @ inverse
    n, _, n_u = G.shape
    left = np.concatenate([np.broadcast_to(np.eye(n_y), (n, n_y, n_y)), -G], axis=2)
    T = left[:, :, None, :, None] * np.swapaxes(inverse, 1, 2)[:, None, :, None, :]
    return G, np.asarray(T.reshape(n, n_y * n_u, -1))


def weak_inputs(Z: Complex, covariance: Complex, n_y: int) -> tuple[str, ...]:
    """Return a warning where the inputs' responses barely stand above their own noise.

    A ratio is biased by about exp(-|U|²/σ_U²) (Pintelon and Schoukens 2012, sec. 2.4.2) and its first-order covariance
    no longer holds; under a ratio of 10, the bias is over 5e-5 and the tails are heavy.
    """
    U = Z[:, n_y:]
    n, n_u, m = U.shape
    diagonal = np.real(np.diagonal(covariance, axis1=1, axis2=2)).reshape(n, -1, m)[:, n_y:]
    noise = np.sum(diagonal, axis=1).max(axis=1)
    weakest = np.linalg.svd(U, compute_uv=False)[:, n_u - 1] ** 2
    bad = int(np.sum(weakest < 10.0 * noise))
    if not bad:
        return ()
    return (
        f"at {bad} of {n} lines the excitation of the inputs is under 10 dB above their noise: G is biased there and "
        "its deviation underestimated. Average longer, or excite more",
    )


def product_covariance(noise: Complex, parameters: Complex) -> Complex:
    """Return the covariance A ⊗ Bᵀ of vec(V K) row by row, where V has row covariance A and KᴴK = B: (n_f, ab, ab)."""
    n, a, b = noise.shape[0], noise.shape[1], parameters.shape[1]
    both = noise[:, :, None, :, None] * np.swapaxes(parameters, 1, 2)[:, None, :, None, :]
    return both.reshape(n, a * b, a * b)


def transformed(covariance: Complex, T: Complex) -> Complex:
    """Return T C Tᴴ, exactly Hermitian."""
    C = T @ covariance @ _h(T)
    return np.asarray(0.5 * (C + _h(C)))


def scatter(values: Complex) -> Complex:
    """Return the sample covariance over axis 0 of `values` (m, n_f, k): (n_f, k, k)."""
    d = values - values.mean(axis=0)
    C = np.einsum("mfi,mfj->fij", d, d.conj()) / (values.shape[0] - 1)
    return np.asarray(C)


def right_inverse(U: Complex, weight: Complex | None = None) -> Complex:
    """Return W Uᴴ (U W Uᴴ)⁻¹ of `U` (n_f, n_u, m), refused where its rows are dependent."""
    n_u, m = U.shape[1:]
    s = np.linalg.svd(U, compute_uv=False)
    worst = int(np.argmin(s[:, -1] / np.maximum(s[:, 0], np.finfo(float).tiny)))
    if s[worst, -1] <= 1e-10 * s[worst, 0]:
        raise EstimationError(
            f"the {n_u} inputs move together at line {worst + 1} of the estimate; their effects cannot be told apart. "
            "Use experiments or references that are linearly independent at every line"
        )
    if m == n_u:
        return np.asarray(np.linalg.inv(U))
    WU = _h(U) if weight is None else weight @ _h(U)
    return np.asarray(WU @ np.linalg.inv(U @ WU))


def _h(x: Complex) -> Complex:
    return np.conj(np.swapaxes(x, -1, -2))
