"""Impulse responses by regularised least squares: many taps, without the variance that many taps cost.

A prior of fading, smooth responses takes the place of an order; its sizes come from the data (Pillonetto and De Nicolao
2010; Chen, Ohlsson and Ljung 2012). In open loop the taps are estimated directly (`rfir`); where a controller may be at
work, past outputs of all channels stand beside past inputs (a long regularised autoregression, consistent under
feedback; Pillonetto, Chiuso and De Nicolao 2011), and the impulse response follows from both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.instrumental.noise import autoregression
from ambid.blackbox.made import made
from ambid.blackbox.nonparametric.autoregression import predictor_taps, responses
from ambid.blackbox.nonparametric.bayes import Posterior, posterior, triangle
from ambid.blackbox.nonparametric.kernels import Kernel
from ambid.blackbox.orders import Orders, known_orders, long_enough, per_input, shown
from ambid.blackbox.polynomial_model import PolynomialModel, Polynomials
from ambid.blackbox.response import Offsets
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

_ALL: tuple[Kernel, ...] = ("tc", "dc", "ss")
_NOISE_ORDER = 20  # highest of the noise's autoregression
_OLDER = 10  # lags beyond the taps that are looked at
_SEEN = 1e-3  # chance that a tap of a dead time is taken for the response
_WITHIN = (
    "inputs and outputs depend on each other within the same sample (p = {p:.2g}). If the controller acts without "
    "delay, that is as it should be; if the plant does, its first tap is not zero, as is taken for granted here, and "
    "the later ones are off. Where there was no feedback say open_loop (--open-loop): then the first tap is estimated"
)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImpulseResponse:
    """Sampled impulse responses: y = sum of values[k] u[t - k], plus noise."""

    time_s: Array  # (n_taps,), s, beginning at zero delay
    values: Array  # (n_taps, n_outputs, n_inputs), output unit per input unit
    covariance: Array  # (n_outputs, n_inputs, n_taps, n_taps), within each response
    noise_sd: Array  # (n_outputs,), of the innovations
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str]
    kernels: tuple[str, ...]  # chosen for each output
    method: Literal["rfir", "rarx"]
    warnings: tuple[str, ...] = ()

    @property
    def sd(self) -> Array:
        """Standard deviations, shape (n_taps, n_outputs, n_inputs)."""
        return np.moveaxis(np.sqrt(np.maximum(np.diagonal(self.covariance, axis1=2, axis2=3), 0.0)), 2, 0)

    def delay_samples(self, output: int = 0, channel: int = 0) -> int | None:
        """Return the first tap that stands out from its own spread, all taps before it together not doing so.

        `output`, `channel`: which output, and which input. Returns whole samples, at most the true delay with a chance
        of 999 in 1000; None where nothing stands out.
        """
        from scipy.stats import norm

        limit = norm.isf(_SEEN / 2 / self.time_s.size)
        out = np.abs(self.values[:, output, channel]) > limit * np.maximum(self.sd[:, output, channel], 1e-300)
        return int(np.argmax(out)) if np.any(out) else None


def rfir(data: IOData, orders: Orders, *, kernels: Sequence[Kernel] = _ALL, zero_delay: bool = True) -> BlackBoxFit:
    """Estimate a long FIR model with a fading prior; every output by itself.

    `data`: without feedback; `kernels`: priors to choose from by marginal likelihood; `zero_delay`: whether a first tap
    at delay 0 is allowed where nk is left out. Returns polynomialModel; the covariance is the posterior's.
    `n_estimated` is the effective number of coefficients.
    """
    known_orders("rfir", orders, ("nb", "nk"), ("nb",))
    nb = per_input("rfir", orders, "nb", 1, data.n_inputs)
    nk = per_input("rfir", {"nk": 0 if zero_delay else 1, **orders}, "nk", 0, data.n_inputs)
    _known_kernels(kernels)
    first = max((b + k - 1 for b, k in zip(nb, nk, strict=True)), default=0)
    long_enough("rfir", data, 4 * (data.n_samples - first), sum(nb) + 1)
    with one_thread():
        found, (means, u_sd), (y_mean, y_sd) = _regressed(data, nb, nk, first, kernels)
    polynomials = [_polynomials(f, nb, nk, u_sd, sd) for f, sd in zip(found, y_sd, strict=True)]
    model = PolynomialModel(outputs=tuple(polynomials), dt=data.dt)
    covariance = np.zeros((model.theta.size, model.theta.size))
    for o, f in enumerate(found):
        places = []
        for out, letter, i, place in model.blocks():
            if out == o and letter == "B" and i is not None:
                places.append(np.arange(place.start + nk[i], place.stop))
        where = np.concatenate(places)
        scale = np.concatenate([np.full(b, y_sd[o] / u_sd[i]) for i, b in enumerate(nb)])
        covariance[np.ix_(where, where)] = f.covariance * np.outer(scale, scale)
    return made(
        "rfir",
        data,
        orders={"nb": shown(nb), "nk": shown(nk)},
        model=model,
        covariance=covariance,
        n_estimated=int(np.ceil(sum(f.freedom for f in found))),
        offsets=Offsets(u=means, y=y_mean + y_sd * np.array([f.constant for f in found])),
        noise_covariance=np.diag([f.noise_variance * sd**2 for f, sd in zip(found, y_sd, strict=True)]),
        details={
            "kernel": [f.kernel for f in found],
            "hyperparameters": [f.hyper.tolist() for f in found],
            "effective_coefficients": [f.freedom for f in found],
            "evidence": [f.evidence for f in found],
        },
    )


def impulse_response(
    data: IOData,
    n_taps: int,
    *,
    method: Literal["auto", "rfir", "rarx"] = "auto",
    kernels: Sequence[Kernel] = ("tc", "dc"),
) -> ImpulseResponse:
    """Estimate impulse responses with their spread.

    Parameters
    ----------
    data : IOData
    n_taps : int
        Taps from zero delay on.
    method : {"auto", "rfir", "rarx"}
        ``rfir`` in open loop, ``rarx`` where feedback may act (its first tap is zero: without a delay in the loop input
        and output cannot be told apart); "auto" goes by ``data.open_loop``.
    kernels : sequence of {"tc", "dc", "ss"}

    Returns
    -------
    ImpulseResponse

    Raises
    ------
    EstimationError
        If the record is too short, or a name is not known.
    """
    if method not in ("auto", "rfir", "rarx"):
        raise EstimationError(f"impulse response: method {method!r}; it is 'auto', 'rfir' or 'rarx'. Give one of them")
    if n_taps < 2:
        raise EstimationError(f"impulse response: {n_taps} tap(s); at least 2 make a response. Ask for more")
    _known_kernels(kernels)
    chosen = ("rfir" if data.open_loop else "rarx") if method == "auto" else method
    if chosen == "rarx":
        return _through_autoregression(data, n_taps, kernels)
    fit = rfir(data, {"nb": n_taps, "nk": 0}, kernels=kernels)
    model = fit.model
    assert isinstance(model, PolynomialModel)
    assert fit.covariance is not None
    values = np.zeros((n_taps, data.n_outputs, data.n_inputs))
    covariance = np.zeros((data.n_outputs, data.n_inputs, n_taps, n_taps))
    for o, letter, i, place in model.blocks():
        if letter == "B" and i is not None:
            values[:, o, i] = model.theta[place]
            covariance[o, i] = fit.covariance[place, place]
    return ImpulseResponse(
        time_s=np.arange(n_taps, dtype=np.float64) * data.dt,
        values=values,
        covariance=covariance,
        noise_sd=np.sqrt(np.diag(fit.noise_covariance)),
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        kernels=tuple(str(k) for k in fit.details["kernel"]),  # type: ignore[attr-defined]
        method="rfir",
        warnings=fit.warnings,
    )


def _through_autoregression(data: IOData, n_taps: int, kernels: Sequence[Kernel]) -> ImpulseResponse:
    lags = n_taps - 1
    n_y, n_u = data.n_outputs, data.n_inputs
    long_enough("impulse response", data, 2 * (data.n_samples - lags), lags * (n_y + n_u) + 1)
    with one_thread():
        taps = predictor_taps(data, lags, kernels)
        values, covariance = responses(taps, n_y, n_u, lags)
    scale = taps.y_sd[:, None] / taps.u_sd
    full = np.zeros((n_taps, n_y, n_u))
    full[1:] = values * scale
    wide = np.zeros((n_y, n_u, n_taps, n_taps))
    wide[:, :, 1:, 1:] = covariance * scale[:, :, None, None] ** 2
    return ImpulseResponse(
        time_s=np.arange(n_taps, dtype=np.float64) * data.dt,
        values=full,
        covariance=wide,
        noise_sd=np.sqrt(np.diag(taps.noise)) * taps.y_sd,
        inputs=data.inputs,
        outputs=data.outputs,
        units=data.units,
        kernels=taps.kernels,
        method="rarx",
        warnings=() if taps.within_sample > _SEEN else (_WITHIN.format(p=taps.within_sample),),
    )


def _known_kernels(kernels: Sequence[Kernel]) -> None:
    wrong = [k for k in kernels if k not in _ALL]
    if wrong or not kernels:
        raise EstimationError(f"kernel {wrong[0] if wrong else 'none'!r} is not known; known: tc, dc, ss. Give some")


def _regressed(
    data: IOData, nb: tuple[int, ...], nk: tuple[int, ...], first: int, kernels: Sequence[Kernel]
) -> tuple[list[Posterior], tuple[Array, Array], tuple[Array, Array]]:
    """Scale, reduce to a triangle, and fit each output."""
    means, u_sd = data.u.mean(axis=0), data.u.std(axis=0)
    y_mean, y_sd = data.y.mean(axis=0), data.y.std(axis=0)
    u, y = (data.u - means) / u_sd, (data.y - y_mean) / y_sd
    lags = [(i, k) for i, (b, d) in enumerate(zip(nb, nk, strict=True)) for k in range(d, d + b)]
    t = triangle([(u[:, i], k) for i, k in lags], y, first)
    rough = [posterior(t, o, nb, kernels) for o in range(data.n_outputs)]
    found = [_whitened(f, u, y[:, o], nb, lags, first) for o, f in enumerate(rough)]
    return found, (means, u_sd), (y_mean, y_sd)


def _whitened(
    rough: Posterior, u: Array, y: Array, nb: tuple[int, ...], lags: Sequence[tuple[int, int]], first: int
) -> Posterior:
    """Fit once more with all signals filtered so that the noise is white; as it is where it was white already.

    Noise of another colour would be averaged too well and too badly: the band of the step response would be too narrow
    by a factor of the noise's memory.
    """
    from scipy.signal import lfilter

    left = _left(rough.mean, rough.constant, u, y, lags, first)
    noise = autoregression(left, _NOISE_ORDER)
    p = noise.order
    if not p or left.size - p <= 4 * rough.freedom:
        return rough
    v, z = (np.asarray(lfilter(noise.D, 1.0, x, axis=0)[p:]) for x in (u, y))
    if _truncated(np.asarray(lfilter(noise.D, 1.0, left)[p:]), v, lags):
        return rough  # what is left comes from inputs older than the taps: no noise, and not to be whitened
    found = posterior(triangle([(v[:, i], k) for i, k in lags], z[:, None], first), 0, nb, (rough.kernel,))
    constant = found.constant / float(noise.D.sum())
    left = _left(found.mean, constant, u, y, lags, first)
    total = float(left @ left) / max(left.size - 1 - found.freedom, 1.0)
    return replace(found, constant=constant, noise_variance=total)


def _truncated(error: Array, v: Array, lags: Sequence[tuple[int, int]]) -> bool:
    """Return whether inputs older than the taps still move a white error (chi-square of their regression)."""
    from scipy.stats import chi2

    last = {i: max(k for j, k in lags if j == i) for i in range(v.shape[1])}
    n = v.shape[0] - max(last.values()) - _OLDER
    if n < 4 * _OLDER * v.shape[1]:
        return False
    older = [v[v.shape[0] - n - last[i] - k : v.shape[0] - last[i] - k, i] for i in last for k in range(1, _OLDER + 1)]
    Q, e = np.linalg.qr(np.stack(older, axis=1))[0], error[-n:]
    share = float(np.sum((Q.T @ e) ** 2) / max(float(e @ e), 1e-300))
    return bool(n * share > float(chi2.isf(_SEEN, Q.shape[1])))


def _left(taps: Array, constant: float, u: Array, y: Array, lags: Sequence[tuple[int, int]], first: int) -> Array:
    """What the taps leave of an output, shape (n_samples - first,)."""
    from scipy.signal import oaconvolve

    out = y - constant
    for i in range(u.shape[1]):
        full = np.zeros(1 + max([k for j, k in lags if j == i], default=0))
        for g, (j, k) in zip(taps, lags, strict=True):
            if j == i:
                full[k] = g
        out = out - oaconvolve(u[:, i], full)[: y.size]
    return np.asarray(out[first:])


def _polynomials(f: Posterior, nb: tuple[int, ...], nk: tuple[int, ...], u_sd: Array, y_sd: float) -> Polynomials:
    edges = np.cumsum([0, *nb])
    one = np.ones(1)
    return Polynomials(
        A=one,
        B=tuple(
            np.concatenate([np.zeros(k), f.mean[edges[i] : edges[i + 1]] * y_sd / u_sd[i]]) for i, k in enumerate(nk)
        ),
        C=one,
        D=one,
        F=(one,) * len(nb),
    )
