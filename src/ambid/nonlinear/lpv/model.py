"""An LPV model with schedule, scaling and cloud (implements `NonlinearModel`), and what it is where p stands still."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.roots import root_derivative, roots_of
from ambid.errors import EstimationError
from ambid.nonlinear.cloud import Cloud
from ambid.nonlinear.lpv.shape import (
    BASES,
    LpvShape,
    Part,
    Schedule,
    basis_values,
    beginning,
    errors,
    looks_back,
    part_of,
    settling,
)
from ambid.nonlinear.signals import finite, scaled, with_head

Complex = NDArray[np.complex128]

# --- at one set point -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frozen:
    """The linear model y = (B/A) u + offset/A(1) + H e that stands still at one p; H = C/D or C/(D A).

    With p made of the output it describes movements about the set point that are fast beside its low-pass.
    """

    p: float
    dt: float
    nk: int  # smallest lag of the inputs
    a: Array  # (order + 1,), of q^0, q^-1, ...; the first is 1
    b: Array  # (n_exciting, nb), SI, of q^-nk,
    c: Array  # of the error model; the first is 1
    d: Array
    # (order,), complex, rad/s, log(z)/dt of the roots z of A, largest real part first; -inf for a root at 0
    poles: Complex
    dc_gain: Array  # (n_exciting,), SI, B(1)/A(1); negative behind an unstable pole
    a_sd: Array | None = None  # standard deviations; None without a covariance
    b_sd: Array | None = None
    c_sd: Array | None = None
    d_sd: Array | None = None
    poles_sd: Complex | None = None  # (order,), complex, rad/s, or None, of real and imaginary part
    dc_gain_sd: Array | None = None  # (n_exciting,), SI, or None

    @property
    def stable(self) -> bool:
        """Whether all poles are in the left half plane."""
        return bool(np.all(self.poles.real < 0))

    def response(self, frequency: Array) -> Complex:
        """Return the frequency response from each exciting input at frequencies in Hz, (n, n_exciting), SI."""
        w = np.exp(-2j * np.pi * np.asarray(frequency, dtype=np.float64) * self.dt)
        below = np.polynomial.polynomial.polyval(w, self.a)
        above = np.stack([w**self.nk * np.polynomial.polynomial.polyval(w, row) for row in self.b], axis=-1)
        out: Complex = above / below[:, None]
        return out


def frozen(p: float, dt: float, nk: int, a: Array, b: Array, c: Array, d: Array, P: Array | None) -> Frozen:
    """Return poles, gains and standard deviations of a model that stands still.

    `P` is the covariance of a (order,), b (n_exciting, nb) row by row, d, c.
    """
    na, nb, m = a.size, b.shape[1], b.shape[0]
    whole = np.concatenate([[1.0], a])
    z = roots_of(whole)
    with np.errstate(divide="ignore", invalid="ignore"):
        poles = np.where(z == 0, -np.inf, np.log(np.where(z == 0, 1.0, z)) / dt)
        gain = b.sum(axis=1) / whole.sum()
    turn = np.lexsort((-poles.imag, -poles.real))
    values = Frozen(
        p=p,
        dt=dt,
        nk=nk,
        a=whole,
        b=b,
        c=np.concatenate([[1.0], c]),
        d=np.concatenate([[1.0], d]),
        poles=poles[turn],
        dc_gain=gain,
    )
    if P is None:
        return values
    sd = np.sqrt(np.maximum(np.diag(P), 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = root_derivative(whole, z)[:, 1:] / (z * dt)[:, None]
    by_gain = np.zeros((m, P.shape[0]))
    for i in range(m):
        by_gain[i, :na] = -gain[i] / whole.sum()
        by_gain[i, na + i * nb : na + (i + 1) * nb] = 1.0 / whole.sum()
    own = P[:na, :na]
    real, imaginary = (np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", x, own, x), 0.0)) for x in (slope.real, slope.imag))
    n = na + m * nb
    return Frozen(
        **{k: getattr(values, k) for k in ("p", "dt", "nk", "a", "b", "c", "d", "poles", "dc_gain")},
        a_sd=np.concatenate([[0.0], sd[:na]]),
        b_sd=sd[na:n].reshape(m, nb),
        d_sd=np.concatenate([[0.0], sd[n : n + d.size]]),
        c_sd=np.concatenate([[0.0], sd[n + d.size :]]),
        poles_sd=(real + 1j * imaginary)[turn],
        dc_gain_sd=np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", by_gain, P, by_gain), 0.0)),
    )


# --- model ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class LpvModel:
    """A linear model of one output whose coefficients follow a scheduling signal; equations in `lpv.shape`.

    What was before a record the predictor estimates from the first `lag` samples, see `lpv.beginning`. Implements
    `ambid.nonlinear.model.NonlinearModel`.
    """

    dt: float  # s
    n_inputs: int  # channels, with one that only schedules
    shape: LpvShape
    schedule: Schedule
    # (n_theta,), SI, for signals in deviations from `*_level`; each coefficient's weights of the functions of p
    theta: Array
    u_level: Array  # (n_inputs,), SI
    u_scale: Array
    y_level: Array  # (1,), SI
    y_scale: Array
    cloud: Cloud  # of the training regressors and the scheduling signal

    @property
    def kind(self) -> str:
        """Under which files know it."""
        return "lpv"

    @property
    def n_outputs(self) -> int:
        """One."""
        return 1

    @property
    def lag(self) -> int:
        """Samples of the past that a prediction needs."""
        return looks_back(self.shape)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient and number of the function of p."""
        return self.shape.names

    @cached_property
    def unit(self) -> Array:
        """What a scaled parameter of 1 is in SI, shape (n_theta,)."""
        of = self.shape
        out, y = np.ones(of.n_theta), float(self.y_scale[0])
        for i, column in enumerate(of.columns):
            for k in range(of.nb):
                out[of.place(of.order + i * of.nb + k)] = y / self.u_scale[column]
        out[of.place(of.n_process - 1)] = y
        return out

    def with_theta(self, theta: Array) -> Self:
        """Return the same model with other parameters."""
        return replace(self, theta=theta)

    def at(self, p: float, covariance: Array | None = None) -> Frozen:
        """Return the linear model at one value of p, with standard deviations by the fit's `covariance`.

        Outside ``schedule.low`` to ``schedule.high`` the functions of p are continued, which nothing backs.
        """
        of, s = self.shape, self.schedule.scaled(float(p)).reshape(1)
        n = len(of.coefficients)
        G = np.zeros((n, of.n_theta))
        for k in range(n):
            where = of.place(k)
            G[k, where] = basis_values(s, where.stop - where.start, of.basis)[0]
        values, keep = G @ self.theta, np.arange(n) != of.n_process - 1
        P = None if covariance is None else (G @ covariance @ G.T)[np.ix_(keep, keep)]
        b = values[of.order : of.n_process - 1].reshape(len(of.columns), of.nb)
        d, c = values[of.n_process : of.n_process + of.ar], values[of.n_process + of.ar :]
        return frozen(float(p), self.dt, of.nk, values[: of.order], b, c, d, P)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; NaN everywhere if the predictor diverges."""
        part = self._part(u, y)
        theta = self.theta / self.unit
        start = beginning(self.shape, part, theta)
        found = None if start is None else errors(self.shape, part, theta, start[0])
        out = np.full((part.y.size, 1), np.nan)
        if found is not None and found.finite:
            out[self.lag :, 0] = found.g[self.lag :]
        predicted: Array = self.y_level + self.y_scale * out
        return predicted

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`."""
        part, theta, P = self._part(u, y), self.theta / self.unit, self.theta.size
        start = beginning(self.shape, part, theta, slopes=True)
        found = None if start is None else errors(self.shape, part, theta, start[0], slopes=2)
        J = np.full((part.y.size, P), np.nan)
        if start is not None and found is not None and found.finite:
            J = found.J[:, :P] + found.J[:, P:] @ start[1]
        out = (J * (self.y_scale / self.unit))[:, None, :]
        out[: self.lag] = 0.0
        return np.asarray(out)

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`."""
        from ambid.nonlinear.lpv._kernels import free_run

        whole, head = with_head(self, u, y)
        ys, us = scaled(self, u, whole)
        of, found = self.shape, np.ascontiguousarray(ys[:, 0])
        share, column = self.schedule.share(self.dt), self.schedule.column
        s = np.zeros(found.size) if column < 0 else self.schedule.scaled(np.asarray(u, dtype=np.float64)[:, column])
        level, size = float(self.y_level[0]), float(self.y_scale[0])
        free_run(
            found,
            of.lagged_inputs(us),
            np.ascontiguousarray(s),
            of.degree + 1,
            of.n_offset,
            BASES.index(of.basis),
            self.theta / self.unit,
            of.order,
            head,
            share,
            (self.schedule.middle - level) / size,
            self.schedule.half / size,
        )
        out: Array = self.y_level + self.y_scale * found[:, None]
        out[:head] = whole[:head]
        return out

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`: the largest of p's, over half its range, and of ellipsoid and hull of the cloud.

        Holes of the cloud do not count: between set points an LPV model interpolates.
        """
        ys, us = scaled(self, u, y)
        s = self.scheduling(u, y)
        out = np.full(ys.shape[0], np.nan)
        x = regressors(self.shape, ys[:, 0], us, s)
        away = x[settling(self.shape) :] - self.cloud.mean
        ellipsoid = np.linalg.norm(away @ self.cloud.whitening.T, axis=1)
        hull = np.max(away @ self.cloud.faces.T, axis=1, initial=0.0)
        out[self.lag :] = np.maximum(np.abs(s[self.lag :]), np.maximum(ellipsoid, hull))
        return out

    def scheduling(self, u: Array, y: Array) -> Array:
        """Return the scheduling signal of a record in SI, scaled: -1 to 1 in training."""
        p = self.schedule.signal(np.asarray(u, dtype=np.float64), np.asarray(y, dtype=np.float64), self.dt)
        return self.schedule.scaled(p)

    def _part(self, u: Array, y: Array) -> Part:
        ys, us = scaled(self, u, y)
        return part_of(self.shape, ys[:, 0], us, self.scheduling(u, y))

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        arrays = {k: getattr(self, k).tolist() for k in ("theta", "u_level", "u_scale", "y_level", "y_scale")}
        return {
            "dt_s": self.dt,
            "n_inputs": self.n_inputs,
            "shape": {**asdict(self.shape), "columns": list(self.shape.columns)},
            "schedule": asdict(self.schedule),
            **arrays,
            "cloud": self.cloud.as_json(),
        }

    @classmethod
    def from_json(cls, found: dict[str, Any]) -> Self:
        """Read it back from what `as_json` made."""
        try:
            return cls(**_read(found))
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise EstimationError(f"no LPV model ({type(error).__name__}: {error}). Write the file again") from error


def _read(found: Mapping[str, Any]) -> dict[str, Any]:
    """What the model is made with, checked."""
    m, words = int(found["n_inputs"]), ("form", "basis", "offset")
    sizes: dict[str, Any] = {k: int(v) for k, v in found["shape"].items() if k not in ("columns", *words)}
    columns = tuple(int(k) for k in found["shape"]["columns"])
    texts: dict[str, Any] = {k: str(found["shape"][k]) for k in words}
    shape = LpvShape(columns=columns, **sizes, **texts)
    schedule = Schedule(**found["schedule"])
    known = {"basis": BASES, "form": ("equation", "output"), "offset": ("scheduled", "constant")}
    if any(getattr(shape, k) not in v for k, v in known.items()) or not schedule.high > schedule.low:
        raise ValueError("form, basis, offset or range of the schedule make no sense")
    if not all(0 <= k < m for k in columns) or not -1 <= schedule.column < m or min(sizes.values()) < 0:
        raise ValueError("columns or orders make no sense")
    n = {"theta": shape.n_theta, "u_level": m, "u_scale": m, "y_level": 1, "y_scale": 1}
    arrays: dict[str, Any] = {k: finite(found[k], size, k) for k, size in n.items()}
    cloud = Cloud.from_json(found["cloud"], shape.n_process)
    return {"dt": float(found["dt_s"]), "n_inputs": m, "shape": shape, "schedule": schedule, "cloud": cloud, **arrays}


def regressors(shape: LpvShape, y: Array, u: Array, s: Array) -> Array:
    """Return what predictions depend on, from sample `lag` on: past outputs, inputs, scheduling signal; all scaled."""
    n, lag = y.size, shape.lag
    if n <= lag:
        return np.empty((0, shape.n_process))
    past = [y[lag - k : n - k] for k in range(1, shape.order + 1)]
    return np.column_stack([*past, shape.lagged_inputs(u)[lag:, :-1], s[lag:]])
