"""Vector fitting: poles and residues of a rational matrix on given points, by relocating poles.

G sigma = p with sigma = d + sum c_k/(s - a_k) and p alike is linear in c, d and the residues of p; the zeros of sigma
are the next poles. Relaxed: sigma's real part sums to the number of lines instead of d = 1 (Gustavsen and Semlyen 1999;
Gustavsen 2006; one QR for each entry: Deschrijver et al. 2008). Poles are never forced to be stable.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.transfer_model import TransferModel
from ambid.errors import EstimationError

Complex = NDArray[np.complex128]

_STILL = 1e-10  # relative movement of the poles at which they stand


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoleResidueModel:
    """G = D + sum_k residues[k] / (s - poles[k]), in s (rad/s) or z."""

    poles: Complex  # (n,), complex, complex ones in neighbouring conjugate pairs
    residues: Complex  # (n, n_outputs, n_inputs), complex
    D: Array  # (n_outputs, n_inputs)
    dt: float | None  # sampling interval in s; None for continuous time
    iterations: int  # relocations that were made
    converged: bool  # whether the poles stood still at the end
    error: float  # root mean square of the weighted error

    def frequency_response(self, omega: Array) -> Complex:
        """Return G.

        `omega`: (n_frequencies,), rad/s. Returns (n_frequencies, n_outputs, n_inputs), complex.
        """
        s = 1j * omega if self.dt is None else np.exp(1j * omega * self.dt)
        return np.asarray(self.D + np.einsum("fk,kyu->fyu", 1.0 / (s[:, None] - self.poles), self.residues))

    def transfer_model(self) -> TransferModel:
        """Return transfer functions with the common denominator."""
        den, (_, n_y, n_u) = np.real(np.poly(self.poles)), self.residues.shape
        rest = [np.poly(np.delete(self.poles, k)) for k in range(self.poles.size)]
        num = [[self.D[o, i] * den for i in range(n_u)] for o in range(n_y)]
        for o, i in np.ndindex(n_y, n_u):
            for k, others in enumerate(rest):
                num[o][i] = num[o][i] + np.concatenate([[0.0], np.real(self.residues[k, o, i] * others)])
        return TransferModel(
            num=tuple(tuple(row) for row in num), den=tuple(tuple(den for _ in row) for row in num), dt=self.dt
        )

    def state_space(self) -> StateSpaceModel:
        """Return a real block-diagonal form: each pole as often as the rank of its residue matrix wants.

        Returns with K = 0.
        """
        from scipy.linalg import block_diag

        _, n_y, n_u = self.residues.shape
        blocks: list[tuple[Array, Array, Array]] = []
        for k, a in enumerate(self.poles):
            if a.imag < 0:
                continue
            left, size, right = np.linalg.svd(self.residues[k])
            for j in np.nonzero(size > 1e-9 * max(float(size[0]), 1e-300))[0]:
                c, b = left[:, j] * np.sqrt(size[j]), right[j] * np.sqrt(size[j])
                if a.imag == 0:
                    # a real residue has real singular vectors, up to a phase that both share
                    turn = np.exp(-1j * np.angle(b[np.argmax(np.abs(b))]))
                    blocks.append((np.array([[a.real]]), np.real(b * turn)[None], np.real(c / turn)[:, None]))
                else:
                    block = np.array([[a.real, a.imag], [-a.imag, a.real]])
                    blocks.append((block, 2 * np.stack([b.real, -b.imag]), np.stack([c.real, c.imag], axis=1)))
        A = block_diag(*[b[0] for b in blocks]) if blocks else np.zeros((0, 0))
        B = np.vstack([np.zeros((0, n_u)), *[b[1] for b in blocks]])
        C = np.hstack([np.zeros((n_y, 0)), *[b[2] for b in blocks]])
        return StateSpaceModel(A=A, B=B, C=C, D=self.D, K=np.zeros((A.shape[0], n_y)), dt=self.dt)


def vector_fit(
    omega: Array,
    G: Complex,
    n_poles: int,
    *,
    dt: float | None = None,
    weight: Array | None = None,
    feedthrough: bool = True,
    start: Complex | None = None,
    iterations: int = 40,
) -> PoleResidueModel:
    """Fit poles that all entries share, and their residues.

    `omega`: (n_frequencies,), rad/s; `G`: (n_frequencies, n_outputs, n_inputs), complex; `dt`: sampling interval in s
    for a model in z; None for one in s; `weight`: (n_frequencies, n_outputs, n_inputs), one over the standard deviation
    of each entry; default 1; `feedthrough`: whether D is estimated; else 0; `start`: (n_poles,), complex, first poles,
    conjugates side by side; default spread over the band, lightly damped; `iterations`: relocations at most. Returns
    the best of all relocations.
    """
    n, m = omega.size, int(np.prod(G.shape[1:]))
    if n_poles < 1 or 2 * n * m < n_poles * (m + 1) + m or n < 2:
        raise EstimationError(f"{n_poles} poles from {n} lines: give at least 1 pole, and fewer than the lines show")
    if not (np.all(np.isfinite(omega)) and np.all(np.isfinite(G))):
        raise EstimationError("vector fitting got numbers that are not finite; leave those lines out")
    size = float(np.median(omega)) if dt is None else 1.0  # poles of order one
    points = np.asarray(1j * omega / size if dt is None else np.exp(1j * omega * dt), dtype=np.complex128)
    flat = G.reshape(n, m)
    w = np.ones((n, m)) if weight is None else np.asarray(weight, dtype=np.float64).reshape(n, m)
    w = w / np.sqrt(np.mean(w**2 * np.abs(flat) ** 2) + 1e-300)
    poles = _spread(omega, n_poles, size, dt) if start is None else np.asarray(start, dtype=np.complex128) / size
    best: tuple[float, Complex, Complex, Array] | None = None
    done, still = 0, False
    for done in range(1, iterations + 1):  # noqa: B007  (its last value is reported)
        moved = _relocated(points, flat, w, poles, feedthrough)
        change = np.max(
            np.abs(np.sort_complex(moved) - np.sort_complex(poles)) / np.maximum(np.abs(moved).max(), 1e-300)
        )
        poles, still = moved, bool(change < _STILL)
        error, residues, D = _residues(points, flat, w, poles, feedthrough)
        if best is None or error < best[0]:
            best = (error, poles, residues, D)
        if still:
            break
    if best is None or not np.isfinite(best[0]):
        raise EstimationError("vector fitting found no finite poles; lower the number of poles, or check the lines")
    return PoleResidueModel(
        poles=best[1] * size,
        residues=(best[2] * size).reshape(n_poles, *G.shape[1:]),
        D=best[3].reshape(G.shape[1:]),
        dt=dt,
        iterations=done,
        converged=still,
        error=best[0],
    )


def _spread(omega: Array, n_poles: int, size: float, dt: float | None) -> Complex:
    """Lightly damped pairs over the band, and one real pole where their number is odd."""
    used = omega[omega > 0]
    centres = np.geomspace(used[0], used[-1], n_poles // 2 + 2)[1:-1] if n_poles > 3 else [np.sqrt(used[0] * used[-1])]
    centres = np.asarray(centres)[: n_poles // 2]
    pairs = np.stack([centres * (-0.01 + 1j), centres * (-0.01 - 1j)], axis=1).ravel()
    s = np.concatenate([pairs, [-np.sqrt(used[0] * used[-1])] * (n_poles % 2)]).astype(np.complex128)
    return np.asarray(s / size if dt is None else np.exp(s * dt))


def _basis(points: Complex, poles: Complex) -> tuple[Complex, NDArray[np.int_]]:
    """Partial fractions with real coefficients, (n_frequencies, n_poles), and their kinds: 0 real, 1 and 2 a pair."""
    phi = np.empty((points.size, poles.size), dtype=np.complex128)
    kind = np.zeros(poles.size, dtype=np.int_)
    k = 0
    while k < poles.size:
        a = poles[k]
        if a.imag == 0:
            phi[:, k] = 1.0 / (points - a)
            k += 1
        else:
            up, down = 1.0 / (points - a), 1.0 / (points - np.conj(a))
            phi[:, k], phi[:, k + 1] = up + down, 1j * (up - down)
            kind[k : k + 2] = 1, 2
            k += 2
    return phi, kind


def _relocated(points: Complex, flat: Complex, w: Array, poles: Complex, feedthrough: bool) -> Complex:
    """One relocation: the zeros of sigma."""
    phi, kind = _basis(points, poles)
    n, m, order = points.size, flat.shape[1], poles.size
    own = np.column_stack([phi, np.ones(n)]) if feedthrough else phi
    sigma = np.column_stack([phi, np.ones(n)])
    rows = []
    for e in range(m):
        block = np.column_stack([own * w[:, [e]], -sigma * (w[:, e] * flat[:, e])[:, None]])
        r = np.asarray(np.linalg.qr(np.concatenate([block.real, block.imag]), mode="r"))
        rows.append(r[own.shape[1] :, own.shape[1] :])
    relax = np.real(np.sum(sigma, axis=0)) * (np.sqrt(np.mean([np.sum(np.abs(r) ** 2) for r in rows])) / n)
    system = np.vstack([*rows, relax])
    right = np.zeros(system.shape[0])
    right[-1] = relax[-1]
    norm = np.maximum(np.linalg.norm(system, axis=0), 1e-300)
    x = np.linalg.lstsq(system / norm, right, rcond=None)[0] / norm
    c, d = x[:order], x[order]
    if abs(d) < 1e-8:
        d = 1e-8 if d >= 0 else -1e-8
    A, b = np.zeros((order, order)), np.ones(order)
    for k in range(order):
        if kind[k] == 0:
            A[k, k] = poles[k].real
        elif kind[k] == 1:
            A[k : k + 2, k : k + 2] = [[poles[k].real, poles[k].imag], [-poles[k].imag, poles[k].real]]
            b[k], b[k + 1] = 2.0, 0.0
    found = np.linalg.eigvals(A - np.outer(b, c) / d).astype(np.complex128)
    real = np.sort(found[np.abs(found.imag) <= 1e-12 * np.abs(found)].real)
    upper = found[found.imag > 1e-12 * np.abs(found)]
    upper = upper[np.argsort(upper.imag)]
    return np.concatenate([np.stack([upper, upper.conj()], axis=1).ravel(), real.astype(np.complex128)])


def _residues(
    points: Complex, flat: Complex, w: Array, poles: Complex, feedthrough: bool
) -> tuple[float, Complex, Array]:
    """Weighted error, residues (n_poles, m) and D (m,) for given poles."""
    phi, kind = _basis(points, poles)
    own = np.column_stack([phi, np.ones(points.size)]) if feedthrough else phi
    m, squares = flat.shape[1], 0.0
    x = np.empty((own.shape[1], m))
    for e in range(m):
        block = own * w[:, [e]]
        a = np.concatenate([block.real, block.imag])
        right = np.concatenate([(w[:, e] * flat[:, e]).real, (w[:, e] * flat[:, e]).imag])
        norm = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
        x[:, e] = np.linalg.lstsq(a / norm, right, rcond=None)[0] / norm
        squares += float(np.sum((a @ x[:, e] - right) ** 2))
    residues = np.zeros((poles.size, m), dtype=np.complex128)
    for k in range(poles.size):
        if kind[k] == 0:
            residues[k] = x[k]
        elif kind[k] == 1:
            residues[k] = x[k] + 1j * x[k + 1]
            residues[k + 1] = np.conj(residues[k])
    D = x[-1] if feedthrough else np.zeros(m)
    return float(np.sqrt(squares / flat.size)), residues, np.asarray(D)
