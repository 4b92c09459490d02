"""Transfer functions in continuous time in weak form (thesis eq. 3.8): y^(n) + ... + a_0 y = b_m u^(m) + ... + b_0 u.

Test functions carry the derivatives, so no signal is differentiated; white noise on the output is treated as what it
is, noise in every regressor (maximum likelihood, see `ambid.blackbox.weakform.equations`). No initial state and no
simulation: unstable plants are no harder than stable ones. Noise of another colour, or a disturbance inside a loop,
leaves a bias.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.made import made
from ambid.blackbox.orders import Orders, known_orders, long_enough, per_input, shown, single
from ambid.blackbox.response import Offsets
from ambid.blackbox.transfer_model import TransferModel
from ambid.blackbox.weakform.bumps import degree_for
from ambid.blackbox.weakform.equations import Solution, best_support
from ambid.blackbox.weakform.system import Kink, Signal, System, Term
from ambid.errors import EstimationError
from ambid.estimation.threads import one_thread

_CONTRADICTED = 1.3  # ratio of noise from which a support is too long
_SHORTEST, _LONGEST = 10, 2560  # half supports tried, samples


def weakform(data: IOData, orders: Orders, *, half_width_s: float | None = None) -> BlackBoxFit:
    """Estimate a transfer function in continuous time for every output; its inputs share a denominator.

    `data`: inputs held over a sample. Returns transferModel with ``dt`` None. `details` tells the supports tried.
    """
    known_orders("weakform", orders, ("nb", "nf", "nk"), ("nb", "nf"))
    n = single("weakform", orders, "nf", 1)
    nb = per_input("weakform", orders, "nb", 1, data.n_inputs)
    nk = per_input("weakform", {"nk": 0, **orders}, "nk", 0, data.n_inputs)
    if max(nb, default=1) > n:
        raise EstimationError(
            f"weakform: {max(nb)} numerator coefficients over a denominator of degree {n}; at most {n}, as an output "
            "that jumps with its input has no samples to be held against. Lower nb, or raise nf"
        )
    long_enough("weakform", data, data.n_samples - max(nk, default=0) - 4 * _SHORTEST, n + sum(nb) + 1)
    halves = supports(data.n_samples - max(nk), half_width_s, data.dt)
    u_mean, y_mean = data.u.mean(axis=0), data.y.mean(axis=0)
    u_sd, y_sd = data.u.std(axis=0), data.y.std(axis=0)
    u, y = (data.u - u_mean) / u_sd, (data.y - y_mean) / y_sd
    with one_thread():
        found = [
            best_support(_system(y[:, o], u, n, nb, nk, data.dt), halves, degree_for(n), min([_SHORTEST, *halves]))
            for o in range(data.n_outputs)
        ]
    solutions = [f[0] for f in found]
    model, covariance = _model(solutions, n, nb, nk, data.dt, u_sd, y_sd)
    noise = np.diag([(s.scale * sd) ** 2 for s, sd in zip(solutions, y_sd, strict=True)])
    return made(
        "weakform",
        data,
        orders={"nb": shown(nb), "nf": n, "nk": shown(nk)},
        model=model,
        covariance=covariance,
        n_estimated=data.n_outputs * (n + sum(nb)),
        offsets=_offsets(solutions, u_mean, y_mean, u_sd, y_sd),
        noise_covariance=noise,
        status="converged" if all(s.converged for s in solutions) else "stalled",
        warnings=contradictions([s.contradiction for s in solutions]),
        details={
            "half_width_s": [s.half * data.dt for s in solutions],
            "rows": [s.rows for s in solutions],
            "condition": [s.condition for s in solutions],
            "supports": {o: tried for o, (_, tried) in zip(data.outputs, found, strict=True)},
        },
    )


def supports(n_samples: int, half_width_s: float | None, dt: float) -> list[int]:
    """Return the half supports to try, in samples.

    `half_width_s`: the one that was asked for.
    """
    if half_width_s is not None:
        half = round(half_width_s / dt)
        if not _SHORTEST // 2 <= half <= n_samples // 4:
            raise EstimationError(
                f"weakform: half_width_s = {half_width_s:g} is {half} samples; it must be {_SHORTEST // 2} to a "
                f"quarter of the record ({n_samples // 4}). Give another"
            )
        return [half]
    halves = [_SHORTEST * 2**k for k in range(12) if _SHORTEST * 2**k <= min(_LONGEST, n_samples // 8)]
    return halves or [_SHORTEST // 2]


def contradictions(found: Sequence[float]) -> list[str]:
    """Return a warning where test functions with the shortest support contradict the result.

    `found`: ratios of noise by output, see `Solution.contradiction`.
    """
    worst = max(found)
    if worst < _CONTRADICTED:
        return []
    return [
        f"over the whole band the weak form leaves {worst:.2g} times the noise that its own test functions show: "
        "they are too long to see the plant, or the model or the whiteness of the noise is wrong. Give a "
        "shorter half_width_s"
    ]


def kink(u: Array, delay: float, dt: float) -> Array:
    """Return what to add to samples of a signal whose slope jumps by `u`'s steps, so that sums are integrals.

    A kink a part f of a sample after one makes the trapezoidal rule wrong by dt^2/2 B2(f) times its jump (Euler and
    Maclaurin; B2(f) = f^2 - f + 1/6). For kinks at the samples the next two terms are taken too: as sampling folds the
    spectrum 1/w^2 of a kink, dt^2 (1/s - 1/x^2) = dt^2 (1/12 + s/240 + 31 s^2/60480 + ...) with x = w dt and
    s = 4 sin^2(x/2), which is minus a second difference.

    `u`: (n_samples,), held signal; `delay`: samples by which it acts late. Returns (n_samples,), for a slope that jumps
    by one per unit of `u`.
    """
    whole = int(np.floor(delay))
    fraction = delay - whole
    jumps = np.diff(u, prepend=u[:1])
    out = np.zeros_like(u)
    out[whole:] = jumps[: u.size - whole]
    first = out * (fraction**2 - fraction + 1 / 6) / 2
    if fraction > 0:
        return np.asarray(first * dt)
    second = -np.diff(out, n=2, prepend=out[:1], append=out[-1:])
    fourth = -np.diff(second, n=2, prepend=second[:1], append=second[-1:])
    return np.asarray((first + second / 240 + fourth * 31 / 60480) * dt)


def _system(y: Array, u: Array, n: int, nb: tuple[int, ...], nk: tuple[int, ...], dt: float) -> System:
    """The equation of one output."""
    signals = {"y": Signal(values=y, sd=1.0), "one": Signal(values=np.ones_like(y))}
    terms = [Term(equation=0, signal="y", order=n)]
    terms += [Term(equation=0, signal="y", order=k, parameter=f"a{k}") for k in range(n)]
    for i in range(u.shape[1]):
        signals[f"u{i}"] = Signal(values=u[:, i], held=True, delay=float(nk[i]))
        terms += [Term(equation=0, signal=f"u{i}", order=k, parameter=f"b{k}.{i}", factor=-1.0) for k in range(nb[i])]
    terms.append(Term(equation=0, signal="one", order=0, parameter="c", factor=-1.0))
    names = tuple(t.parameter for t in terms if t.parameter is not None)
    steep = [i for i in range(u.shape[1]) if nb[i] == n]  # relative degree one: the slope of y jumps with u
    kinks = [Kink(signal="y", pattern=kink(u[:, i], nk[i], dt), parameter=f"b{n - 1}.{i}") for i in steep]
    return System(
        terms=tuple(terms),
        signals=signals,
        names=names,
        dt=dt,
        prior_mean=np.zeros(len(names)),
        prior_sd=np.full(len(names), np.inf),
        kinks=tuple(kinks),
    )


def _model(
    found: list[Solution],
    n: int,
    nb: tuple[int, ...],
    nk: tuple[int, ...],
    dt: float,
    u_sd: Array,
    y_sd: Array,
) -> tuple[TransferModel, Array]:
    """Transfer functions in SI, and the covariance of all their coefficients: shared denominators move together."""
    num, den = [], []
    for s, y in zip(found, y_sd, strict=True):
        d = np.array([1.0, *(s.theta[f"a{k}"] for k in reversed(range(n)))])
        den.append((d,) * len(nb))
        num.append(
            tuple(np.array([s.theta[f"b{k}.{i}"] for k in reversed(range(b))]) * y / u_sd[i] for i, b in enumerate(nb))
        )
    model = TransferModel(num=tuple(num), den=tuple(den), dt=None, delay=tuple(k * dt for k in nk))
    covariance = np.zeros((model.theta.size, model.theta.size))
    for o, s in enumerate(found):
        names = list(s.theta)
        slope = np.zeros((model.theta.size, len(names)))
        for out, i, which, p, place in model.parts():
            if out != o:
                continue
            for k in range(p.size):
                power = p.size - 1 - k
                if which == "num":
                    slope[place.start + k, names.index(f"b{power}.{i}")] = y_sd[o] / u_sd[i]
                elif power < n:
                    slope[place.start + k, names.index(f"a{power}")] = 1.0
        covariance += slope @ s.covariance @ slope.T
    return model, covariance


def _offsets(found: list[Solution], u_mean: Array, y_mean: Array, u_sd: Array, y_sd: Array) -> Offsets:
    """Operating point: a_0 y = b_0 u + c, solved for y, or for the first input where a_0 is lost in its own spread."""
    u, y = u_mean.copy(), y_mean.copy()
    for o, s in enumerate(found):
        names = list(s.theta)
        a0, sd = s.theta["a0"], np.sqrt(s.covariance[names.index("a0"), names.index("a0")])
        if abs(a0) > 2 * sd:
            y[o] += y_sd[o] * s.theta["c"] / a0
        elif len(found) == 1 and s.theta["b0.0"] != 0:
            u[0] -= u_sd[0] * s.theta["c"] / s.theta["b0.0"]
    return Offsets(u=u, y=y)
