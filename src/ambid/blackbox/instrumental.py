"""Instrumental variables in discrete time: iv4 without feedback; cliv with the reference of a loop.

A y = B u + noise of any colour: least squares is biased where the equation's noise is not white. Instruments that the
noise did not make (what the inputs, or in a loop the reference, explain) take the bias off, and filtering with a model
of the noise makes the estimate as sharp as a method without a noise model of G can be (Ljung 1999, sec. 15.3; Gilson
and Van den Hof 2005). Noise model and estimate are repeated in turn until they settle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag
from scipy.signal import lfilter

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders, check_length, check_order_names, order_per_input, single_order
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.instruments import (
    Autoregression,
    Solution,
    autoregression,
    noise_covariance,
    project_out,
    reference_part,
    require_reference,
    solve,
    weak_instruments,
)
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials, reflect
from ambid.blackbox.polynomial_predictor import Layout, arx_layout
from ambid.errors import EstimationError

_NO_NOISE_MODEL = Autoregression(D=np.ones(1), variance=0.0)
_NO_AVERAGE = np.ones(1)
_SETTLED = 1e-4  # change of the filtered output by a round, relative to the innovations
_INSIDE = 0.9999  # radius to which poles on the unit circle are drawn


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """One output and the inputs, offsets roughly off."""

    y: Array  # (n_samples,)
    u: Array  # (n_samples, n_inputs)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArxEstimate:
    """Outcome of one output: A y = B u + constant + C w/D."""

    layout: Layout  # of A and B
    # C is 1, or A with the poles outside the unit circle mirrored (noise that enters at the output); D of `noise`
    polynomials: Polynomials
    noise: Autoregression  # of the equation error
    solution: Solution  # last step; its unknowns are a_1 ..., b of every input, and the constant

    @property
    def innovations(self) -> Array:
        """What the last step leaves, (n_rows,), ending with the last sample."""
        return self.solution.residual


def regressors(signals: Signals, layout: Layout) -> Array:
    """Return -y(t-1) ... -y(t-na), u_i(t-nk) ..., 1 from `first_row` on, shape (n_rows, n_coefficients + 1)."""
    n, first = signals.y.size, layout.first_row
    columns = [-signals.y[first - k : n - k] for k in range(1, layout.na + 1)]
    for i, (nb, nk) in enumerate(zip(layout.nb, layout.nk, strict=True)):
        columns += [signals.u[first - k : n - k, i] for k in range(nk, nk + nb)]
    return np.stack([*columns, np.ones(n - first)], axis=1)


def instrumental_step(
    who: str,
    data: Signals,
    instruments: Signals,
    layout: Layout,
    noise: Autoregression = _NO_NOISE_MODEL,
    C: Array = _NO_AVERAGE,
) -> Solution:
    """Make one instrumental variable step; all columns are filtered by D/C.

    `who`: method, for errors; `C`: (n + 1,).
    """
    p = noise.order
    rows, Z, target = regressors(data, layout), regressors(instruments, layout), data.y[layout.first_row :]
    if p or C.size > 1:
        rows, Z, target = (lfilter(noise.D, C, x, axis=0)[p:] for x in (rows, Z, target))
    if C.size > 1:  # what the filter does not know of the time before the record fades with the plant's own poles
        free = _free(C, rows.shape[0])
        rows, Z, target = project_out(free, rows), project_out(free, Z), project_out(free, target[:, None])[:, 0]
    return solve(Z, rows, target, who=who)


def least_squares(who: str, data: Signals, layout: Layout) -> Array:
    """Return the least-squares coefficients: instruments equal to regressors; biased by coloured noise.

    Returns (n_coefficients + 1,).
    """
    return instrumental_step(who, data, data, layout).theta


def optimal_step(
    who: str, data: Signals, instruments: Signals, layout: Layout, theta: Array, highest: int
) -> ArxEstimate:
    """Model the noise of the equation at `theta` and make the filtered, optimal step (Ljung 1999, eq. 15.25-15.29).

    The noise is modelled twice, as 1/D and as C/D with C the stable counterpart of A, and the sharper model is taken.
    The second is that of noise on the output: sampled fast, it has zeros next to the unit circle, which no
    autoregression of moderate order holds. For an unstable plant C mirrors its poles: noise spectra do not tell them.

    `theta`: (n_coefficients + 1,), consistent estimate from a step before; `highest`: highest order of the noise model.
    """
    error = data.y[layout.first_row :] - regressors(data, layout) @ theta
    noise, C = autoregression(error, highest), _NO_AVERAGE
    mirrored = reflect(_polynomials(layout, theta).A, _INSIDE)
    outer = np.asarray(lfilter([1.0], mirrored, error))
    at_output = autoregression(project_out(_free(mirrored, outer.size), outer[:, None])[:, 0], highest)
    if _cost(at_output, error.size) < _cost(noise, error.size):
        noise, C = at_output, mirrored
    solution = instrumental_step(who, data, instruments, layout, noise, C)
    found = replace(_polynomials(layout, solution.theta), C=C, D=noise.D)
    return ArxEstimate(layout=layout, polynomials=found, noise=noise, solution=solution)


def iterate_optimal(
    who: str,
    data: Signals,
    instruments: Callable[[Array], Signals],
    layout: Layout,
    theta: Array,
    rounds: int,
) -> ArxEstimate:
    """Repeat `optimal_step` until noise model and estimate agree.

    `instruments`: of an estimate; `theta`: (n_coefficients + 1,); `rounds`: at most.
    """
    for _ in range(rounds):
        found = optimal_step(who, data, instruments(theta), layout, theta, layout.free.size + NOISE_ORDER)
        before, theta = theta, found.solution.theta
        moved = np.linalg.pinv(found.solution.inverse) @ (theta - before)
        if np.linalg.norm(moved) <= _SETTLED * np.linalg.norm(found.innovations):
            break
    return found


def _polynomials(layout: Layout, theta: Array) -> Polynomials:
    """A and B of a solution, whose last number is the constant."""
    full = layout.start()
    full[layout.free] = theta[:-1]
    return layout.polynomials(full)


def _free(C: Array, n: int) -> Array:
    """Free responses of 1/C, shape (n, order of C)."""
    return np.asarray(lfilter([1.0], C, np.eye(n, C.size - 1), axis=0))


def _cost(noise: Autoregression, n: int) -> float:
    return float(n * np.log(noise.variance + 1e-300) + 2 * noise.order)


def covariance(found: ArxEstimate) -> Array:
    """Return the covariance of all coefficients, leading ones and zeros included.

    C follows from A and has zeros. The noise of the filtered equation is modelled once more, so that a noise model of
    too low an order costs efficiency but does not make the standard deviations too small.
    """
    rows, layout, p = found.innovations.size, found.layout, found.polynomials
    left = autoregression(found.innovations, 10)
    spare = rows / max(rows - layout.free.size - 1, 1)
    first = layout.places["C", None].start + p.C.size
    d = slice(first, first + p.D.size)
    out = np.zeros((d.stop + len(p.F),) * 2)
    out[np.ix_(layout.free, layout.free)] = found.solution.covariance(left)[:-1, :-1] * spare
    out[d, d] = noise_covariance(found.noise, rows)
    return out


def operating_point(found: list[ArxEstimate], u_mean: Array, y_mean: Array, u_sd: Array, y_sd: Array) -> Offsets:
    """Share the constants of the equations out over input and output offsets, each moved as little as possible.

    A(1) y0 - B(1) u0 = constant; where A(1) is near zero (an integrating plant) the input takes it.

    `found`: one for each output, for signals with the means taken off; `u_mean`, `u_sd`: (n_inputs,), SI; `y_mean`,
    `y_sd`: (n_outputs,), SI.
    """
    n_y = y_mean.size
    rows = np.zeros((n_y, n_y + u_mean.size))
    for o, f in enumerate(found):
        rows[o, o] = f.polynomials.A.sum() * y_sd[o]
        rows[o, n_y:] = -np.array([b.sum() for b in f.polynomials.B]) * u_sd
    move = np.linalg.lstsq(rows, np.array([f.solution.theta[-1] for f in found]), rcond=None)[0]
    return Offsets(u=u_mean + move[n_y:] * u_sd, y=y_mean + move[:n_y] * y_sd)


NOISE_ORDER = 20  # added to na + nb; Akaike's criterion chooses below it
_CORNERS = (np.inf, 0.5, 0.1, 0.02)  # of the filters of the first step, in radians a sample
_ROUGH = 3
_ROUNDING = 1e-11
_NOISE_ROUNDS = 30  # noise model and estimate in turn, at most


def estimate_output(who: str, signals: Signals, clean: Signals, layout: Layout) -> ArxEstimate:
    """Estimate one output with given instruments.

    `who`: method, for the error; `signals`, `clean`: as measured, and without what the noise does.
    """
    best, failed = list[ArxEstimate](), list[EstimationError]()
    for corner in _CORNERS if layout.na else _CORNERS[:1]:
        C = np.asarray(np.poly(np.full(layout.na, np.exp(-corner)))) if np.isfinite(corner) else _NO_AVERAGE
        try:
            theta = instrumental_step(who, signals, clean, layout, C=C).theta
            best.append(iterate_optimal(who, signals, lambda _: clean, layout, theta, _ROUGH))
        except EstimationError as error:
            failed.append(error)
    if not best:
        raise failed[-1]
    found = min(best, key=lambda f: f.noise.variance)
    if is_exact(found, signals):
        return found
    return iterate_optimal(who, signals, lambda _: clean, layout, found.solution.theta, _NOISE_ROUNDS)


def is_exact(found: ArxEstimate, signals: Signals) -> bool:
    """Return whether nothing but rounding is left, of which no noise model can be made."""
    return bool(np.linalg.norm(found.innovations) <= _ROUNDING * np.linalg.norm(signals.y))


_ROUNDS = 10  # of instruments from the model itself, at most
_INSTRUMENT_RADIUS = 0.999  # radius to which the poles of an unstable instrument are drawn


def iv4(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/A by the four-step instrumental variable method; every output by itself.

    Parameters
    ----------
    data : IOData
        Without feedback: past inputs are instruments, so the noise must not reach the input.
    orders : Mapping[str, int or tuple of int]
        ``na``; ``nb`` and ``nk`` (default 1), one or one for each input.

    Returns
    -------
    BlackBoxFit
        PolynomialModel with A, B and the noise model C/D; C is 1, or the stable counterpart of A.

    Raises
    ------
    EstimationError
        If an order breaks a rule, or the record is too short or does not excite the plant.
    """
    used = arx_orders("iv4", data, orders)
    deviations, means, sds = centre(data)
    explained = _explained(deviations)
    found = [
        _one_output(Signals(y=y, u=deviations.u), used, None if explained is None else explained[:, o])
        for o, y in enumerate(deviations.y.T)
    ]
    return arx_fit("iv4", data, found, means, sds)


def arx_orders(who: str, data: IOData, orders: Orders) -> Layout:
    """Check na, nb and nk, and that the record is long enough for them."""
    check_order_names(who, orders, ("na", "nb", "nk"), ("na", "nb"))
    n_u = data.n_inputs
    used = arx_layout(
        single_order(who, orders, "na", 0),
        order_per_input(who, orders, "nb", 1, n_u),
        order_per_input(who, {"nk": 1, **orders}, "nk", 0, n_u),
    )
    check_length(who, data, data.n_samples - used.first_row, used.free.size + 1)
    return used


def centre(data: IOData) -> tuple[IOData, tuple[Array, Array], tuple[Array, Array]]:
    """Return the data with means off (for the numbers' sake; constants are estimated), the means and the spreads.

    Returns means; standard deviations.
    """
    means = (data.u.mean(axis=0), data.y.mean(axis=0))
    sds = (data.u.std(axis=0), data.y.std(axis=0))
    reference = data.reference - data.reference.mean(axis=0)
    return replace(data, u=data.u - means[0], y=data.y - means[1], reference=reference), means, sds


def arx_fit(
    who: str,
    data: IOData,
    found: list[ArxEstimate],
    means: tuple[Array, Array],
    sds: tuple[Array, Array],
) -> BlackBoxFit:
    """Put the estimates of all outputs together.

    `found`: for each output, of the data with the means off.
    """
    layout = found[0].layout
    rows = min(f.innovations.size for f in found)
    e = np.stack([f.innovations[-rows:] for f in found], axis=1)
    return build_fit(
        who,
        data,
        orders={"na": layout.na, "nb": layout.nb, "nk": layout.nk},
        model=PolynomialModel(outputs=tuple(f.polynomials for f in found), dt=data.dt),
        covariance=block_diag(*[covariance(f) for f in found]),
        n_estimated=sum(layout.free.size + f.noise.order for f in found),
        offsets=operating_point(found, *means, *sds),
        noise_covariance=e.T @ e / max(rows - layout.free.size - 1, 1),
        warnings=weak_instruments([f.solution for f in found], data.outputs),
        details={
            "noise_order": [f.noise.order for f in found],
            "condition": [f.solution.condition for f in found],
            "instrument_strength": [f.solution.strength() for f in found],
        },
    )


def _one_output(signals: Signals, layout: Layout, explained: Array | None) -> ArxEstimate:
    """Instruments from what the inputs explain of the output, then from the model itself, until it stands still."""

    def simulate(theta: Array) -> Signals:
        """Output of the model from the inputs alone; poles outside the unit circle are drawn inside."""
        p = _polynomials(layout, theta)
        A = reflect(p.A, _INSTRUMENT_RADIUS)
        return replace(signals, y=sum(lfilter(b, A, u) for b, u in zip(p.B, signals.u.T, strict=True)))

    clean = simulate(least_squares("iv4", signals, layout)) if explained is None else replace(signals, y=explained)
    found = estimate_output("iv4", signals, clean, layout)
    if is_exact(found, signals):
        return found
    return iterate_optimal("iv4", signals, simulate, layout, found.solution.theta, _ROUNDS)


def _explained(deviations: IOData) -> Array | None:
    """What the inputs alone make of the outputs, by an autoregression of many lags; None where none is stable."""
    u, names = deviations.u, deviations.inputs
    alone = replace(deviations, u=np.empty((u.shape[0], 0)), inputs=(), reference=u, references=names)
    try:
        return reference_part("iv4", alone)[1]
    except EstimationError:
        return None


def cliv(data: IOData, orders: Orders) -> BlackBoxFit:
    """Estimate G = B/A of a plant in a loop, with instruments from the reference; every output by itself.

    Parameters
    ----------
    data : IOData
        With a reference that the noise does not reach.
    orders : Mapping[str, int or tuple of int]
        ``na``; ``nb`` and ``nk`` (default 1), one or one for each input.

    Returns
    -------
    BlackBoxFit
        PolynomialModel with A, B and the noise model C/D; C is 1, or the stable counterpart of A.

    Raises
    ------
    EstimationError
        If there is no reference, an order breaks a rule, or the record is too short or does not excite the plant.
    """
    require_reference("cliv", data)
    used = arx_orders("cliv", data, orders)
    deviations, means, sds = centre(data)
    clean_u, clean_y = reference_part("cliv", deviations)
    found = [
        estimate_output("cliv", Signals(y=y, u=deviations.u), Signals(y=clean, u=clean_u), used)
        for y, clean in zip(deviations.y.T, clean_y.T, strict=True)
    ]
    return arx_fit("cliv", data, found, means, sds)
