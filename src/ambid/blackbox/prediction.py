"""Any black-box fit as a discrete predictor at its sampling interval: its errors on a record, and their derivatives.

Continuous models are discretised under a zero-order hold; with a delay of part of a sample the plant sees the previous
input first (Astrom and Wittenmark, Computer-Controlled Systems, ch. 2). Residual tests project derivatives along all
that was estimated out, which takes the estimate's error out of residuals to first order. Polynomial models have the
five filters of thesis ch. 3 (theory.md, 2.5; Ljung 1999, eq. 10.54); a discretised transfer function is an output-error
one; a state space moves along A, B, D and K (C adds nothing where it has full row rank). For python-control, noise
models and operating points have no place, nor has a continuous transfer function's delay: refused or named, never lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import BlackBoxModel, Offsets, PolynomialModel, Polynomials, StateSpaceModel, TransferModel
from ambid.errors import EstimationError, ModelError
from ambid.estimation.likelihood import run
from ambid.physics.linear_model import zero_order_hold

_FORGOTTEN = 1e-9  # what is left of an initial state when it no longer counts
_RUNAWAY = 30.0  # log of the growth of an unstable predictor over the record from which nothing is left of its digits


def one_step(model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array:
    """Predict outputs (n_samples, n_outputs) in SI from all samples before (thesis eq. 3.12), the initial state by
    least squares; NaN throughout where an unstable predictor (A - K C) runs away over the record.
    """
    F = model.A - model.K @ model.C
    growth = np.max(np.abs(np.linalg.eigvals(F)), initial=0.0) if F.size else 0.0
    if growth > 1 and y.shape[0] * np.log(growth) > _RUNAWAY:  # beyond all digits
        return np.full(y.shape, np.nan)
    G = np.hstack([model.B - model.K @ model.D, model.K])
    return _response(F, G, model, u, y, offsets)


def simulation(model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array | None:
    """Simulate outputs (n_samples, n_outputs) in SI from the inputs alone; the initial state that fits `y` best is the
    only use of `y`. None without inputs, and for an unstable model: its simulation runs away and says nothing.
    """
    if not model.n_inputs or not stable(model):
        return None
    G = np.hstack([model.B, np.zeros_like(model.K)])
    return _response(model.A, G, model, u, y, offsets)


def run_states(F: Array, G: Array, z: Array, x0: Array | None = None) -> Array:
    """Run x+ = F x + G z, from rest if no first state is given, and return the states before each sample."""
    return run(np.ascontiguousarray(np.hstack([F, G])), z, np.zeros(F.shape[0]) if x0 is None else x0)[:-1]


def stable(model: StateSpaceModel) -> bool:
    """Return whether all poles are inside the unit circle (or the left half plane)."""
    if not model.order:
        return True
    values = np.linalg.eigvals(model.A)
    return bool(np.max(np.abs(values)) < 1.0 if model.dt is not None else np.max(values.real) < 0.0)


def _response(F: Array, G: Array, model: StateSpaceModel, u: Array, y: Array, offsets: Offsets) -> Array:
    """Run x+ = F x + G [u; y] from rest and add the free response that fits y best."""
    z = np.hstack([u - offsets.u, y - offsets.y])
    n = model.order
    out = run_states(F, G, z) @ model.C.T + z[:, : model.n_inputs] @ model.D.T
    if n:
        free = _free_responses(F, model.C, z.shape[0])
        m, n_y = free.shape[0], model.n_outputs
        scale = np.maximum(np.std(y, axis=0), 1e-300)
        rows = (free / scale[:, None]).reshape(m * n_y, n)
        error = ((y - offsets.y - out)[:m] / scale).reshape(-1)
        size = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        x0 = np.linalg.lstsq(rows / size, error, rcond=1e-8)[0] / size
        out[:m] += free @ x0
    return np.asarray(out + offsets.y)


def _free_responses(F: Array, C: Array, n_samples: int) -> Array:
    """Return C F^k for as long as it counts, shape (m, n_outputs, n)."""
    radius = float(np.max(np.abs(np.linalg.eigvals(F))))
    m = n_samples if radius >= 1 else min(n_samples, 20 + F.shape[0] + int(np.log(_FORGOTTEN) / np.log(radius + 1e-30)))
    out = np.empty((m, *C.shape))
    row = C
    for k in range(m):
        out[k] = row
        row = row @ F
    return out


class Sensitivities:
    """Sensitivities that move along a record block by block, along `directions` (n_theta, n_directions) of
    ``model.theta``.
    """

    def __init__(self, model: StateSpaceModel, directions: Array) -> None:
        n, n_u, n_y, d = model.order, model.n_inputs, model.n_outputs, directions.shape[1]
        ends = np.cumsum([n * n, n * n_u, n_y * n, n_y * n_u, n * n_y])
        shapes = ((n, n), (n, n_u), (n_y, n), (n_y, n_u), (n, n_y))
        dA, dB, dC, dD, dK = (
            part.reshape(*shape, d) for part, shape in zip(np.split(directions, ends[:-1]), shapes, strict=True)
        )
        push = [dA - np.tensordot(model.K, dC, 1), dB - np.tensordot(model.K, dD, 1), dK]
        self._forcing = np.zeros((n, n + n_u + n_y, d + 1))  # the last column belongs to the kernel
        self._forcing[:, :, :d] = np.concatenate(push, axis=1)
        self._direct = np.zeros((n_y, n + n_u, d))
        self._direct[:] = np.concatenate([dC, dD], axis=1)
        self._F = np.ascontiguousarray(model.A - model.K @ model.C)
        self._C = model.C
        self._state = np.zeros((n, d + 1))

    def block(self, signals: Array) -> Array:
        """Return the derivatives (n_outputs, block, n_directions) of the predictions of the
        next samples by `signals` (block, n + n_inputs + n_outputs): states before, inputs, one-step errors without a
        constant taken off.
        """
        from ambid.estimation.kernels import sensitivity_scan

        n, n_y, width = self._C.shape[1], self._C.shape[0], self._state.shape[1]
        block = signals.shape[0]
        rows = np.ascontiguousarray(signals @ self._forcing)
        none = np.zeros((block, n))
        sensitivity_scan(self._F, none, none, self._state, rows, width - 1)
        self._state[:, -1] = 0.0
        inputs = np.ascontiguousarray(signals[:, : self._direct.shape[1]])
        out = (self._C @ rows.reshape(n, block * width)).reshape(n_y, block, width)[:, :, :-1]
        return np.asarray(out + inputs @ self._direct)


Indices = NDArray[np.intp]

_BLOCK = 4096  # samples at once


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Errors:
    """A record run through a fit, SI."""

    model: StateSpaceModel  # discrete innovations form that was used
    # its part from inputs to outputs: noise that wanders without bound does not keep a stable plant from simulation
    plant: StateSpaceModel
    # (n_samples, n_outputs), output minus its prediction from all samples before; not a number where an unstable
    # predictor runs away
    one_step: Array
    # (n_samples, n_outputs), or None, output minus its simulation from the inputs alone; None for an unstable model,
    # or without inputs
    simulation: Array | None
    claims_noise: bool  # whether the fit describes the noise; an output-error model (K = 0) does not


def errors(fit: BlackBoxFit, data: IOData) -> Errors:
    """Run a record with a fit's inputs, outputs and rate through it."""
    if abs(data.dt / fit.dt - 1) > 1e-6:
        raise EstimationError(
            f"the record is sampled at {1 / data.dt:g} Hz, the fit at {1 / fit.dt:g} Hz; they must agree. "
            "Resample the record, or fit it"
        )
    if (data.n_inputs, data.n_outputs) != (len(fit.inputs), len(fit.outputs)):
        raise EstimationError(
            f"the data have {data.n_inputs} inputs and {data.n_outputs} outputs, the fit {len(fit.inputs)} and "
            f"{len(fit.outputs)}; they must agree. Name the same channels"
        )
    model, plant = innovations_form(fit), plant_form(fit)
    claims_noise = bool(np.any(model.K)) or not model.n_inputs
    if not claims_noise and not stable(model):
        model = _mirrored(model, fit.noise_covariance)
    e = data.y - one_step(model, data.u, data.y, fit.offsets)
    simulated = simulation(plant, data.u, data.y, fit.offsets)
    simulated = None if simulated is None else data.y - simulated
    return Errors(model=model, plant=plant, one_step=e, simulation=simulated, claims_noise=claims_noise)


def errors_ahead(run: Errors, steps: int) -> Array:
    """Return y minus its prediction `steps` samples ahead, (n_samples - steps + 1, n_outputs), SI: row k is at sample k
    + steps - 1, from outputs before sample k.
    """
    e, power = run.one_step[steps - 1 :].copy(), run.model.K
    for j in range(1, steps):
        e += run.one_step[steps - 1 - j : -j] @ (run.model.C @ power).T
        power = run.model.A @ power
    return np.asarray(e)


def errors_elsewhere(fit: BlackBoxFit, data: IOData) -> Errors:
    """Run a record with an operating point of its own through a fit: a constant in every output is fitted, errors have
    no mean.
    """
    first = errors(fit, data)
    m = first.model
    # a constant c in the output is (I - C (I - F)^-1 K) c in the one-step error, and c itself in the simulation
    F = m.A - m.K @ m.C
    through = np.eye(m.n_outputs) - m.C @ np.linalg.lstsq(np.eye(m.order) - F, m.K, rcond=1e-12)[0]
    e, simulated = first.one_step, first.simulation
    late = slice(data.n_samples // 2, None)  # the initial state has taken up the constant at the start
    moved, shifted = np.zeros(m.n_outputs), np.zeros(m.n_outputs)
    for _ in range(2):
        if np.all(np.isfinite(e)):
            moved += np.linalg.lstsq(through, e[late].mean(axis=0), rcond=1e-6)[0]
            e = data.y - moved - one_step(m, data.u, data.y - moved, fit.offsets)
        if simulated is not None:
            shifted += simulated[late].mean(axis=0)
            y = data.y - shifted
            again = simulation(first.plant, data.u, y, fit.offsets)
            simulated = None if again is None else y - again
    return Errors(
        model=m,
        plant=first.plant,
        one_step=e - e.mean(axis=0),
        simulation=None if simulated is None else simulated - simulated.mean(axis=0),
        claims_noise=first.claims_noise,
    )


def _mirrored(model: StateSpaceModel, noise: Array) -> StateSpaceModel:
    """Return an unstable output-error model with the gain of its best predictor under white output noise, which mirrors
    the unstable poles at the unit circle: the stabilising Riccati solution without process noise (Anderson and Moore
    1979, sec. 4.4), or the model as it was where there is none.
    """
    from scipy.linalg import LinAlgError, solve_discrete_are

    try:
        R = noise if np.all(np.linalg.eigvalsh(noise) > 0) else np.eye(model.n_outputs)
        P = solve_discrete_are(model.A.T, model.C.T, np.zeros_like(model.A), R / np.trace(R))
    except (LinAlgError, ValueError):
        return model
    S = model.C @ P @ model.C.T + R / np.trace(R)
    K = np.linalg.solve(S, model.C @ P @ model.A.T).T
    return StateSpaceModel(A=model.A, B=model.B, C=model.C, D=model.D, K=K, dt=model.dt)


def innovations_form(fit: BlackBoxFit) -> StateSpaceModel:
    """Return the model of a fit as a discrete innovations form at its sampling interval."""
    model = fit.model
    if model.dt is not None:
        return model.state_space()
    if isinstance(model, TransferModel):
        return held_transfer(model, fit.dt)
    return held(model.state_space(), fit.dt)


def plant_form(fit: BlackBoxFit) -> StateSpaceModel:
    """Return the way from inputs to outputs as a discrete state space with K = 0, without the states of the noise."""
    return innovations_form(fit).plant() if fit.model.dt is None else fit.model.plant()


def held(model: StateSpaceModel, dt: float) -> StateSpaceModel:
    """Discretise a continuous state space, inputs and innovations held over a sample."""
    A, B = zero_order_hold(model.A, np.hstack([model.B, model.K]), dt)
    n_u = model.n_inputs
    return StateSpaceModel(A=A, B=B[:, :n_u], C=model.C, D=model.D, K=B[:, n_u:], dt=dt)


def held_transfer(model: TransferModel, dt: float) -> StateSpaceModel:
    """Discretise a continuous transfer model under a zero-order hold, delays as a chain of states before each input."""
    plain = TransferModel(num=model.num, den=model.den, dt=None).state_space()
    n, n_u = plain.order, model.n_inputs
    lags = np.asarray(model.delay) / dt
    whole = np.floor(lags + 1e-9).astype(int)
    part = np.maximum(lags - whole, 0.0)
    part[part < 1e-9] = 0.0
    length = whole + (part > 0)
    first = n + np.concatenate([[0], np.cumsum(length)]).astype(int)
    size = int(first[-1])
    A, B, C, D = np.zeros((size, size)), np.zeros((size, n_u)), np.zeros((model.n_outputs, size)), plain.D.copy()
    A[:n, :n] = zero_order_hold(plain.A, plain.B, dt)[0]
    C[:, :n] = plain.C
    for i in range(n_u):
        column = plain.B[:, i : i + 1]
        now = zero_order_hold(plain.A, column, (1 - part[i]) * dt)
        late = now[0] @ zero_order_hold(plain.A, column, part[i] * dt)[1]
        # chain: place 0 holds u[k-1], place j holds u[k-1-j]
        chain = slice(int(first[i]), int(first[i + 1]))
        if length[i]:
            B[chain.start, i] = 1.0
            A[chain, chain] = np.eye(int(length[i]), k=-1)
        for gain, lag in ((now[1], int(whole[i])), (late, int(whole[i]) + 1)):
            if lag == 0:
                B[:n, i : i + 1] += gain
            elif np.any(gain):
                A[:n, chain.start + lag - 1 : chain.start + lag] += gain
        if length[i]:
            C[:, chain.stop - 1] += D[:, i]
            D[:, i] = 0.0
    return StateSpaceModel(A=A, B=B, C=C, D=D, K=np.zeros((size, model.n_outputs)), dt=dt)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradient:
    """Derivatives of the predictions, one array for each output."""

    rows: tuple[Array, ...]
    # place of each direction in ``model.theta``; None where directions are not coefficients
    theta: tuple[Indices, ...] | None


def gradient(fit: BlackBoxFit, data: IOData, run: Errors) -> Gradient:
    """Differentiate the one-step predictions of `run`, started from rest: the first samples are not exact."""
    u, y = data.u - fit.offsets.u, data.y - fit.offsets.y
    model = fit.model
    if isinstance(model, PolynomialModel):
        free = _free(fit, model)
        rows, places, first = list[Array](), list[Indices](), 0
        for o, p in enumerate(model.outputs):
            every = polynomial_gradient(p, u, y[:, o], run.one_step[:, o])
            own = np.nonzero(free[first : first + every.shape[1]])[0]
            rows.append(every[:, own])
            places.append(own + first)
            first += every.shape[1]
        return Gradient(rows=tuple(rows), theta=tuple(places))
    if isinstance(model, TransferModel) and stable(run.plant):
        return Gradient(
            rows=tuple(_transfer_gradient(model, fit.dt, o, u, y, run) for o in range(model.n_outputs)), theta=None
        )
    return Gradient(rows=_state_space_tangent(fit, run, u, y), theta=None)


def polynomial_gradient(p: Polynomials, u: Array, y: Array, e: Array) -> Array:
    """Differentiate one output's predictions from rest, (n_samples, n_coefficients) in the order of
    ``Polynomials.parts``, leading ones as if they could move; `u` and `y` without offsets, `e` the one-step errors.
    """
    from scipy.signal import lfilter

    whitened = [lfilter(p.D, p.C, lfilter([1.0], f, u[:, i])) for i, f in enumerate(p.F)]  # D/(C F) u
    v = lfilter(p.A, [1.0], y) - sum(
        (lfilter(b, f, u[:, i]) for i, (b, f) in enumerate(zip(p.B, p.F, strict=True))), np.zeros_like(y)
    )
    blocks = list[Array]()
    for letter, i, c in p.parts():
        if letter == "A":
            base = -lfilter(p.D, p.C, y)
        elif letter == "B" and i is not None:
            base = whitened[i]
        elif letter == "C":
            base = lfilter([1.0], p.C, e)
        elif letter == "D":
            base = -lfilter([1.0], p.C, v)
        else:
            base = -lfilter(p.B[i or 0], p.F[i or 0], whitened[i or 0])
        out = np.zeros((base.size, c.size))
        for k in range(min(c.size, base.size)):
            out[k:, k] = base[: base.size - k]
        blocks.append(out)
    return np.hstack(blocks)


def _free(fit: BlackBoxFit, model: PolynomialModel) -> NDArray[np.bool_]:
    """Coefficients that were estimated: those with a variance, or, where there is none, all that are not 0 or 1."""
    if fit.covariance is not None:
        return np.asarray(np.diag(fit.covariance) > 0)
    free = model.theta != 0
    for _, letter, _, place in model.blocks():
        if letter != "B":
            free[place.start] = False
    return np.asarray(free)


def _transfer_gradient(model: TransferModel, dt: float, o: int, u: Array, y: Array, run: Errors) -> Array:
    from scipy.signal import ss2tf

    B, F = list[Array](), list[Array]()
    for i in range(model.n_inputs):
        one = TransferModel(num=((model.num[o][i],),), den=((model.den[o][i],),), dt=model.dt, delay=(model.delay[i],))
        ss = one.state_space() if one.dt is not None else held_transfer(one, dt)
        num, den = ss2tf(ss.A, ss.B, ss.C, ss.D) if ss.order else (ss.D, np.ones(1))
        size = int(np.nonzero(np.abs(den) > 1e-12)[0][-1]) + 1
        B.append(np.where(np.abs(num[0]) > 1e-12 * np.max(np.abs(num[0])), num[0], 0.0))
        F.append(np.asarray(den[:size]))
    p = Polynomials(A=np.ones(1), B=tuple(B), C=np.ones(1), D=np.ones(1), F=tuple(F))
    every = polynomial_gradient(p, u, y[:, o], run.one_step[:, o])
    free, first = list[int](), 0
    for letter, _, c in p.parts():
        free += [first + k for k in range(c.size) if (k > 0 if letter == "F" else letter == "B" and c[k] != 0)]
        first += c.size
    return every[:, free]


def _state_space_tangent(fit: BlackBoxFit, run: Errors, u: Array, y: Array) -> tuple[Array, ...]:
    """Move along every entry of A and B, of K where there is noise, and of D where there is any, but not along those
    not estimated: that would take what they miss out of the residuals.
    """
    m = run.model
    x = run_states(m.A - m.K @ m.C, np.hstack([m.B - m.K @ m.D, m.K]), np.hstack([u, y]))
    moves = {"A": True, "B": True, "C": False, "D": bool(np.any(m.D)), "K": bool(np.any(m.K))}
    free = np.concatenate([np.full(getattr(m, name).size, moves[name]) for name in "ABCDK"])
    if fit.covariance is not None and fit.covariance.shape[0] == free.size:
        free &= np.diag(fit.covariance) > 0
    along = Sensitivities(m, np.eye(free.size)[:, free])
    signals = np.hstack([x, u, run.one_step])
    blocks = [along.block(signals[k : k + _BLOCK]) for k in range(0, u.shape[0], _BLOCK)]
    return tuple(np.concatenate(blocks, axis=1))


def to_control(model: BlackBoxModel) -> Any:
    """Return the input-output part of a model as an object of python-control.

    Parameters
    ----------
    model : BlackBoxModel

    Returns
    -------
    control.StateSpace or control.TransferFunction
        A transfer function for transfer and polynomial models, a state space for state-space models.

    Raises
    ------
    ModelError
        If python-control is not installed, the model has no inputs, or a delay in continuous time.
    """
    control = _control()
    if not model.n_inputs:
        raise ModelError("a time series has no transfer function from inputs. Use its state_space() with the gain K")
    dt = 0 if model.dt is None else model.dt
    if isinstance(model, StateSpaceModel):
        return control.ss(model.A, model.B, model.C, model.D, dt)
    if isinstance(model, PolynomialModel):
        pairs = [[_entry(p, i) for i in range(model.n_inputs)] for p in model.outputs]
    else:
        assert isinstance(model, TransferModel)
        pairs = [[_with_delay(model, o, i) for i in range(model.n_inputs)] for o in range(model.n_outputs)]
    return control.tf([[n for n, _ in row] for row in pairs], [[d for _, d in row] for row in pairs], dt)


def state_space_to_control(A: Array, B: Array, C: Array) -> Any:
    """Return a continuous plant without direct path as a control.StateSpace."""
    return _control().ss(A, B, C, [[0.0] * B.shape[1]] * C.shape[0])


def discrete_to_control(A: Array, B: Array, C: Array, D: Array, dt: float) -> Any:
    """Return a discrete-time system as a control.StateSpace."""
    return _control().ss(A, B, C, D, dt)


def _control() -> Any:
    try:
        import control
    except ImportError:
        raise ModelError("python-control is not installed. Install ambid[control]") from None
    return control


def _entry(p: Polynomials, i: int) -> tuple[Array, Array]:
    """B/(A F) of one input with powers of z, highest first."""
    den = np.convolve(p.A, p.F[i])
    size = max(den.size, p.B[i].size)
    num = np.pad(p.B[i], (0, size - p.B[i].size))
    nonzero = np.nonzero(num)[0]
    return np.asarray(num[nonzero[0] :] if nonzero.size else num[-1:]), np.pad(den, (0, size - den.size))


def _with_delay(model: TransferModel, o: int, i: int) -> tuple[Array, Array]:
    later = 0
    if model.delay[i]:
        if model.dt is None:
            raise ModelError(
                f"the continuous model has a delay of {model.delay[i]:g} s, which a rational transfer function "
                "cannot hold. Remove the delay, or use a discrete structure"
            )
        later = round(model.delay[i] / model.dt)
    return model.num[o][i], np.concatenate([model.den[o][i], np.zeros(later)])
