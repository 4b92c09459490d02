"""The lines of a frequency response as every fit sees them: checked, with the square root of their covariance.

The likelihood of circular complex errors is the sum of e^H C^-1 e over the lines (Pintelon and Schoukens 2012, ch. 9).
Where C is itself estimated with few degrees of freedom, its inverse is too large on average and scatters; `Lines` knows
by how much, so that cost and standard deviations stay honest (complex Wishart moments; their ch. 12 for one output).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import UsedOrders
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import BlackBoxModel, Offsets
from ambid.errors import EstimationError
from ambid.estimation.parts import Check
from ambid.estimation.search import Rows, search
from ambid.signals.response import FrequencyResponse

Complex = NDArray[np.complex128]

SUSPICIOUS = 1e-3  # probability below which a cost speaks of model errors


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lines:
    """Checked lines of a frequency response."""

    omega: Array  # (n_frequencies,), rad/s
    G: Complex  # (n_frequencies, n_outputs, n_inputs), complex
    # (n_frequencies, m, m), complex, inverse of the lower Cholesky factor of the covariance of G, row by row, m =
    # n_outputs * n_inputs
    root: Complex
    # (n_frequencies, n_outputs, n_inputs), standard deviations of the entries of G (of the complex number: real and
    # imaginary part share the variance)
    sd: Array
    # (n_frequencies,), complex degrees of freedom of the covariance (half the real ones); infinite where it is known
    freedom: Array
    # numbers on a line whose covariance was estimated from the same draws: the size of its Wishart matrix
    together: int
    alike: float  # neighbouring lines that share one independent error
    dt: float
    held: bool  # whether G is from a command that is held over a sample to samples of the output

    @property
    def n_lines(self) -> int:
        """Number of lines."""
        return int(self.omega.size)

    @property
    def entries(self) -> int:
        """Complex numbers on each line."""
        return int(self.root.shape[1])

    def whitened(self, error: Complex) -> Array:
        """Return errors as independent real numbers of unit variance.

        `error`: (n_frequencies, n_outputs, n_inputs, ...), complex, the last axes are taken along (columns of a
        Jacobian). Returns (2 * n_frequencies * m, ...).
        """
        flat = error.reshape(self.n_lines, self.entries, -1)
        white = (self.root @ flat).reshape(self.n_lines * self.entries, -1) * np.sqrt(2.0)
        rows = np.concatenate([white.real, white.imag])
        return np.asarray(rows[:, 0] if error.ndim == 3 else rows)

    @property
    def widening(self) -> float:
        """Factor on the inverse information, for a covariance that was estimated and for lines that share errors."""
        v = float(np.min(self.freedom))
        q = v - self.together
        return self.alike * (1.0 if np.isinf(v) else v**2 / (q**2 - 1.0))

    def covariance(self, J: Array, n_seen: int) -> tuple[Array, float]:
        """Return the covariance of what a Jacobian of `whitened` rows shows, and the condition of the scaled Jacobian.

        `J`: (n_rows, n_vector); `n_seen`: directions that carry information, the strongest ones: zero along others.
        """
        norm = np.maximum(np.linalg.norm(J, axis=0), 1e-300)
        _, s, vt = np.linalg.svd(J / norm, full_matrices=False)
        half = (vt[:n_seen].T / np.maximum(s[:n_seen], 1e-15 * s[0])) / norm[:, None]
        return half @ half.T * self.widening, float(s[0] / s[n_seen - 1])

    def verdict(self, cost: float, n_estimated: int, n_extra: int = 0) -> Check:
        """Compare a cost with what noise alone would leave.

        Periods that are short beside the memory of the noise make its scatter, and so the standard deviations, a
        little too large: the cost then comes out under its expectation.

        `cost`: sum of e^H C^-1 e: half the sum of squares of `whitened`; `n_estimated`: real numbers that were
        estimated; `n_extra`: real data beside the lines (priors). Returns with ``cost``, ``expected_cost`` and
        ``cost_sd``; `p` is the probability of so large a cost.
        """
        from scipy.stats import gamma

        p, columns, v = self.together, self.entries // self.together, self.freedom
        mean, variance = np.full(v.size, float(p * columns)), np.full(v.size, float(p * columns))
        few = np.isfinite(v)
        v, q = v[few], v[few] - p
        mean[few] = p * columns * v / q
        variance[few] = columns * (v**2 * p * (p + 1) / (q * (q - 1)) - (p * v / q) ** 2)
        share = max(1.0 - (n_estimated - n_extra) / (2.0 * self.n_lines * self.entries), 1e-6)
        expected, sd = share * float(np.sum(mean)), float(np.sqrt(share * np.sum(variance) * self.alike))
        probability = float(gamma.sf(cost, (expected / sd) ** 2, scale=sd**2 / expected))
        passed = probability > SUSPICIOUS
        say = (
            "as large as noise alone leaves" if passed else "larger than noise explains: model errors, or a wrong order"
        )
        return Check(
            passed=passed,
            detail=f"cost {cost:.5g}, expected {expected:.5g} with sd {sd:.3g}: {say}",
            p=probability,
            values={"cost": cost, "expected_cost": expected, "cost_sd": sd},
        )


def check_lines(frf: FrequencyResponse, n_estimated: int) -> Lines:
    """Check a frequency response and take its covariance apart.

    `n_estimated`: real numbers that are to be estimated from it.
    """
    f, G = np.asarray(frf.frequency_hz, dtype=np.float64), np.asarray(frf.G, dtype=np.complex128)
    n, m = f.size, int(np.prod(G.shape[1:]))
    C = np.asarray(frf.covariance, dtype=np.complex128)
    if G.ndim != 3 or G.shape[0] != n or C.shape != (n, m, m):
        raise EstimationError(
            f"the frequency response has {n} frequencies, G {G.shape} and covariance {C.shape}; they must be "
            "(n,), (n, n_outputs, n_inputs) and (n, m, m) with m = n_outputs * n_inputs. Pass them so"
        )
    for what, values in (("frequency", f[:, None]), ("G", G.reshape(n, -1)), ("covariance", C.reshape(n, -1))):
        bad = np.nonzero(~np.all(np.isfinite(values), axis=1))[0]
        if bad.size:
            raise EstimationError(f"the {what} is not finite on line {bad[0]}; leave lines without excitation out")
    if np.any(f < 0) or np.any(np.diff(f) <= 0):
        raise EstimationError("the frequencies are not increasing from 0 or above; sort the lines and leave twins out")
    if 2 * n * m < n_estimated or n < 2:
        raise EstimationError(
            f"{n} lines of {m} numbers are too few for {n_estimated} coefficients. Lower the orders, or measure "
            "more lines"
        )
    sd = np.sqrt(np.maximum(np.real(np.diagonal(C, axis1=1, axis2=2)), 0.0))
    if np.any(sd == 0.0):
        line = int(np.nonzero(sd == 0.0)[0][0])
        raise EstimationError(
            f"line {line} ({f[line]:g} Hz) has no variance; weights would be infinite. Measure two or more periods, or "
            "give the covariance of the noise"
        )
    freedom = np.broadcast_to(np.asarray(frf.degrees_of_freedom, dtype=np.float64), f.shape) / 2.0
    # scatter over realisations takes all numbers of a line together, noise of single experiments one input at a time
    together = m if frf.details.get("realisations", 1) != 1 else G.shape[1]
    if not np.min(freedom) > together + 1:
        raise EstimationError(
            f"the covariance has {2 * np.min(freedom):g} degrees of freedom for {together} number(s) on a line; "
            f"it must have more than {2 * (together + 1)}. Measure more periods, or average more"
        )
    try:
        unit = C / (sd[:, :, None] * sd[:, None, :])
        factor = np.linalg.cholesky(unit)
    except np.linalg.LinAlgError:
        raise EstimationError(
            "the covariance of G is not positive definite on every line; more periods than numbers on a line are "
            "needed. Measure more periods, or fit fewer channels together"
        ) from None
    root = np.linalg.solve(factor, np.broadcast_to(np.eye(m), C.shape)) / sd[:, None, :]
    return Lines(
        omega=2 * np.pi * f,
        G=G,
        root=np.asarray(root, dtype=np.complex128),
        sd=sd.reshape(G.shape),
        freedom=freedom,
        together=together,
        alike=frf.lines_per_independent,
        dt=1.0 / frf.rate_hz,
        held=frf.hold == "zoh",
    )


def search_lines(
    residual: Callable[[Array], Array], slope: Callable[[Array], Array], start: Array
) -> tuple[float, Array, bool]:
    """Search the likelihood: half the least sum of squares, where it is, and whether the search converged.

    `residual`, `slope`: whitened rows and their derivative at a vector, (n_rows,) and (n_rows, n_vector).
    """
    found = search(Rows(residual, slope), start, most=200, tolerance=1e-13, settled=1e-12)
    return found.cost / 2, found.theta, found.converged


def build_response_fit(
    name: str,
    frf: FrequencyResponse,
    checked: Lines,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array,
    cost: float,
    n_estimated: int,
    converged: bool = True,
    details: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
) -> BlackBoxFit:
    """Put the result of a fit to a frequency response together.

    Such a fit has no innovations: `noise_covariance` is zero, and nothing is said of a predictor. What the noise does
    stands in the covariance of the response, and from there in that of the coefficients.

    `name`: structure; `covariance`: (n_theta, n_theta); `cost`: sum of e^H C^-1 e at the model. Returns with the check
    ``cost``; a warning where it fails.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(covariance)):
        raise EstimationError(
            f"{name}: no finite coefficients fit these lines. Lower the orders, or check the response"
        )
    check = checked.verdict(cost, n_estimated)
    found = [*warnings, *frf.warnings]
    if not converged:
        found.insert(0, "the search did not converge: treat the numbers as a first guess")
    if not check.passed:
        found.insert(0, f"{name}: {check.detail}; standard deviations hold for noise alone")
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=Offsets(u=np.zeros(frf.n_inputs), y=np.zeros(frf.n_outputs)),
        noise_covariance=np.zeros((frf.n_outputs, frf.n_outputs)),
        inputs=frf.inputs,
        outputs=frf.outputs,
        units=dict(frf.units),
        dt=checked.dt,
        record={"lines": checked.n_lines, "rate_hz": frf.rate_hz, "method": frf.method, "hold": frf.hold},
        status="converged" if converged else "stalled",
        checks={"cost": check},
        warnings=tuple(found),
        details={**dict(check.values), "p": check.p, **({} if details is None else dict(details))},
    )
