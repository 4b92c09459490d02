"""Rows of a system of equations in weak form, whitened, and their regressors freed from noise (see `equations`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.weakform.bumps import Bump, moments_at, spread_out
from ambid.blackbox.weakform.system import System
from ambid.errors import EstimationError


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Whitened rows and regressors at one theta."""

    r: Array
    Z: Array
    cost: float


class Rows:
    """Moments of a system's signals, and its rows at any parameters."""

    def __init__(self, system: System, bump: Bump) -> None:
        self.system, self.bump = system, bump
        self.n = next(iter(system.signals.values())).values.size
        self.n_equations = 1 + max(t.equation for t in system.terms)
        lead = max((int(s.delay) + 1 for s in system.signals.values() if s.held), default=0)
        self.centres = bump.centres(self.n, lead)
        self.index = {k: j for j, k in enumerate(system.names)}
        if self.centres.size * self.n_equations < 2 * len(system.names) + 10:
            raise EstimationError(f"{self.centres.size} rows for {len(system.names)} numbers with this support")
        self.kernels = {o: bump.kernel(o) for o in {t.order for t in system.terms}}
        used = sorted({(t.signal, t.order) for t in system.terms})
        self.moments = {(name, o): self._moment(name, o, system.signals[name].values) for name, o in used}
        self.kinks = [
            {(name, o): self._moment(name, o, k.pattern) for name, o in used if name == k.signal} for k in system.kinks
        ]

    def _moment(self, name: str, order: int, values: Array) -> Array:
        s = self.system.signals[name]
        if not s.held:
            return moments_at(values, self.kernels[order], self.bump.half, self.centres)
        whole = int(np.floor(s.delay))
        kernel = self.bump.held_kernel(order, s.delay - whole)
        return moments_at(values, kernel, self.bump.half, self.centres - whole)

    def _columns(self, moments: Mapping[tuple[str, int], Array]) -> tuple[Array, Array]:
        """Fixed part (rows,) and regressors (rows, p), equations interleaved."""
        e = self.n_equations
        fixed, X = np.zeros((self.centres.size, e)), np.zeros((self.centres.size, e, len(self.index)))
        for t in self.system.terms:
            m = moments.get((t.signal, t.order))
            if m is None:
                continue
            if t.parameter is None:
                fixed[:, t.equation] += t.factor * m
            else:
                X[:, t.equation, self.index[t.parameter]] += t.factor * m
        return fixed.reshape(-1), X.reshape(-1, len(self.index))

    def ordinary(self) -> Array:
        """Ordinary least squares, equations weighted alike."""
        fixed, X = self._columns(self.moments)
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        found = np.linalg.lstsq(X / size, -fixed, rcond=None)[0]
        return np.asarray(found / size)

    def at(self, theta: Array) -> State:
        from scipy.linalg import LinAlgError, cholesky_banded
        from scipy.linalg.lapack import dtbtrs

        kernels = self._noise_kernels(theta)
        band = self._band(kernels)
        scale = np.sqrt(band[0])
        if not np.all(scale > 0) or not np.all(np.isfinite(scale)):
            raise EstimationError("an equation holds no noisy signal")
        for j in range(band.shape[0]):
            band[j, : band.shape[1] - j] /= scale[j:] * scale[: scale.size - j]
        band[0] *= 1 + 1e-12
        try:
            factor = cholesky_banded(band, lower=True)
        except LinAlgError:
            raise EstimationError("the rows repeat one another") from None

        def down(x: Array, trans: str) -> Array:
            return np.asarray(dtbtrs(factor, x, uplo="L", trans=trans)[0])

        moments = self._corrected(theta)
        fixed, X = self._columns(moments)
        r = fixed + X @ theta
        z = down((r / scale)[:, None], "N")
        q = (down(z, "T")[:, 0] / scale).reshape(-1, self.n_equations)
        noise = {}
        for name, s in self.system.signals.items():
            if s.sd > 0:
                parts = [spread_out(q[:, e], v, self.centres, self.n) for (e, k), v in kernels.items() if k == name]
                noise[name] = s.sd**2 * np.sum(parts, axis=0)
        estimated = {
            (name, order): m - moments_at(noise[name], self.kernels[order], self.bump.half, self.centres)
            if name in noise
            else m
            for (name, order), m in moments.items()
        }
        slope = self._columns(estimated)[1]
        for k, m in zip(self.system.kinks, self.kinks, strict=True):
            if k.parameter is not None:
                j = self.index[k.parameter]
                through, by = self._columns(m)
                slope[:, j] += k.power * theta[j] ** (k.power - 1) * (through + by @ theta)
        Z = down(np.asfortranarray(slope / scale[:, None]), "N")
        has = np.isfinite(self.system.prior_sd)
        rows = np.eye(theta.size)[has] / self.system.prior_sd[has, None]
        prior = (theta - self.system.prior_mean)[has] / self.system.prior_sd[has]
        r_all = np.concatenate([z[:, 0], prior])
        return State(r_all, np.vstack([Z, rows]), float(r_all @ r_all))

    def step(self, state: State) -> Array:
        size = np.maximum(np.linalg.norm(state.Z, axis=0), 1e-300)
        return np.asarray(np.linalg.lstsq(state.Z / size, -state.r, rcond=1e-13)[0] / size)

    def _corrected(self, theta: Array) -> dict[tuple[str, int], Array]:
        """Moments with what sampling left out of them."""
        out = dict(self.moments)
        for k, moments in zip(self.system.kinks, self.kinks, strict=True):
            size = 1.0 if k.parameter is None else theta[self.index[k.parameter]] ** k.power
            for key, m in moments.items():
                out[key] = out[key] + size * m
        return out

    def _noise_kernels(self, theta: Array) -> dict[tuple[int, str], Array]:
        """What carries the noise of each signal into each equation, offsets -half to half."""
        out: dict[tuple[int, str], Array] = {}
        for t in self.system.terms:
            if self.system.signals[t.signal].sd > 0:
                weight = t.factor * (1.0 if t.parameter is None else theta[self.index[t.parameter]])
                key = (t.equation, t.signal)
                out[key] = out.get(key, 0.0) + weight * self.kernels[t.order]
        return out

    def _band(self, kernels: Mapping[tuple[int, str], Array]) -> Array:
        """Lower band of V Sigma V^T: every row has the same kernel, so each lag is one number per pair of equations."""
        e, hop, length = self.n_equations, self.bump.hop, 2 * self.bump.half + 1
        lags = (length - 1) // hop + 1
        band = np.zeros((lags * e + e, self.centres.size * e))
        for (a, name), v in kernels.items():
            for b in range(e):
                w = kernels.get((b, name))
                if w is None:
                    continue
                variance = self.system.signals[name].sd ** 2
                for lag in range(lags):
                    place = lag * e + a - b
                    if place >= 0:
                        band[place, b::e] += variance * float(v[: length - lag * hop] @ w[lag * hop :])
        return band
