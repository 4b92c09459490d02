"""All checks of a physical estimate on its own record, in the order of the report.

Residual tests are score tests (`ambid.validation.residuals`): lagged signals beside the weighted Jacobian, from one
pass of sensitivities. The record is fitted again with every second, and fourth, output only: under the right model
parameters do not move by more than chance allows (Hausman 1978), however far ahead the predictor looks. Without a fit:
one magnet's f = i^2 h(x) carries f = -m g at rest (x grows away from it), so that k_i = 2 f/i0 and k_i/m = -2 g/i0
(theory.md sec. 1; thesis eq. 1.9), while motion alone gives k_i/m: that tests position, rate and the current's zero. A
reversed position gives k_i the other sign and all else its own: a convention, until gravity or a controller decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np

from ambid.arrays import Array
from ambid.bearing.linear import carry, free_delay
from ambid.bearing.multistart import MAX_DELAY
from ambid.bearing.uncertainty import STRETCHES, Uncertainty, experiment_hint
from ambid.errors import counted
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import (
    Fit,
    Freed,
    Products,
    extend,
    products,
    residual_blocks,
    search,
    sparse_gain,
    weight_of,
    workspace_near,
)
from ambid.estimation.linear import column_sizes, directions
from ambid.estimation.predictor import busiest
from ambid.estimation.uncertainty import chi_squared_tail, p_text
from ambid.physics.linear_model import LinearModel
from ambid.record import Record
from ambid.rig.rig import Rig, RigMagnet
from ambid.signals.faults import resolution
from ambid.simulation.plant import closed_loop_poles
from ambid.validation.facts import GRAVITY, agreements, one_sided, resolution_check, signal_checks
from ambid.validation.residuals import P_LEAST, ResidualTest, consistent_check, uncorrelated_check, white_check

_WHITE_LAGS = (1, 2, 3, 5, 8, 13)
_BLIND = 1e-12  # eigenvalue, over the largest, of directions that neither record nor priors see
_SAME = 1e-6  # length left of a column below which it counts as held by the others: lags of a slow input nearly are
_STRIDES = (2, 4)
_MOST = 4.0  # shift in its standard deviations that chance allows
_LONGEST = 100_000  # samples of which bands are left out, the busiest
_KNOWN = 0.25  # of a variance: the difference to one that is nearly equal is not known better
_BEYOND = 10.0  # from which no number is to be used
_LOST = 100.0  # standard deviation over value from which its size says nothing
_FAR = 3.3  # standard deviations between a prior and the record
_MISSED = 0.05  # part of a sample in which a delay may go unseen and move a parameter out of its interval
_SIZES = {"m": (1e-5, 1e5), "k_x": (0.0, 1e11), "k_i": (0.0, 1e6), "R": (1e-4, 1e5), "L": (1e-7, 1e3), "c": (0.0, 1e8)}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Agreement:
    """Estimates from a record used in other ways."""

    names: tuple[str, ...]  # estimated physical parameters
    shift: Array  # (n_refits, n), SI, refitted value minus estimate
    # (n_refits, n), SI, standard deviation of the shift under the right model: the refit uses less of the data, so
    # that its variance less that of the fit is that of their difference (Hausman 1978)
    sd: Array
    strides: tuple[int, ...]  # of the refits that converged

    @property
    def largest(self) -> float:
        """Largest shift in standard deviations; 0 where no refit converged."""
        return float(np.max(np.abs(self.shift / self.sd), initial=0.0))

    @property
    def passed(self) -> bool:
        """Whether there was a refit, and every shift is within 4 standard deviations."""
        return bool(self.strides) and self.largest < _MOST

    def beyond_chance(self) -> Array:
        """Return how far each parameter moves beyond chance in each refit, (n_refits, n), SI."""
        return np.asarray(np.sign(self.shift) * np.sqrt(np.maximum(self.shift**2 - self.sd**2, 0.0)))

    def disagreement(self) -> Array:
        """Return how far parameters (n,), SI, move in the refit in which they move most; zeros where none converged."""
        if not self.strides:
            return np.zeros(len(self.names))
        return np.asarray(self.shift[np.argmax(np.max(np.abs(self.shift / self.sd), axis=1))])


def innovation_products(fit: Fit, e: Array) -> Products:
    """Return the scalar products that tests of scaled innovations `e` (n_used, n_outputs) at the fit and robust
    covariances want, in one pass.
    """
    problem, weight = fit.problem, weight_of(fit.covariance)
    u = problem.u[problem.skip :: problem.stride] / problem.scales.input
    own, inputs = _lags(len(e))
    lagged = ((e @ weight.T, own), (u, inputs))
    sums = products(problem, fit.vector, weight, workspace_near(fit, problem), lagged, STRETCHES)
    if sums is None:
        raise ValueError("the fit has no predictor; it has failed")
    return sums


def _lags(n: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Lags at which innovations and inputs of `n` samples are tested."""
    longest = max(2, n // 20)
    inputs = {round(float(k)) for k in np.geomspace(1, min(longest, 400), 9)}
    return tuple(k for k in _WHITE_LAGS if k < n // 10), tuple(sorted(inputs))


def innovation_checks(fit: Fit, sums: Products, spread: Uncertainty, moved: Agreement) -> dict[str, Check]:
    """Check ``residuals_white``, ``residuals_uncorrelated``, ``uncertainty_consistent``, ``estimates_agree``: where one
    fails, robust standard deviations are to be used. `sums`: of `innovation_products`; `moved`: estimates from the
    record used in other ways.
    """
    own, inputs = innovation_tests(fit, sums)
    return {
        "residuals_white": white_check(own),
        "residuals_uncorrelated": uncorrelated_check(inputs),
        "uncertainty_consistent": consistent_check(spread.inflation),
        "estimates_agree": _estimates_agree(moved, held="position" not in fit.problem.model.outputs),
    }


def innovation_tests(fit: Fit, sums: Products) -> tuple[ResidualTest, ResidualTest]:
    """Test the innovations for whiteness, and against past inputs, from `innovation_products`."""
    own, inputs = _lags(fit.problem.n_used)
    first = len(own) * fit.problem.y.shape[1]
    return (
        _test_columns(fit, sums, own, slice(0, first)),
        _test_columns(fit, sums, inputs, slice(first, None)),
    )


def _test_columns(fit: Fit, sums: Products, lags: tuple[int, ...], which: slice) -> ResidualTest:
    """Score test of some lagged columns, scaled to unit length, as further regressors of every innovation."""
    size = np.maximum(np.sqrt(np.diag(sums.inner)[which]), 1e-300)
    cross = sums.cross[:, :, which] / size
    statistic, degrees = _explain_columns(fit, sums, cross, sums.inner[which, which] / np.outer(size, size))
    correlation = cross[:, -1] / np.sqrt(sums.squares)[:, None]
    place = np.unravel_index(np.argmax(np.abs(correlation)), correlation.shape)
    return ResidualTest(
        p=chi_squared_tail(max(degrees, 1), statistic),
        statistic=statistic,
        degrees=degrees,
        largest=float(np.abs(correlation[place])),
        largest_lag=lags[int(place[1]) // (size.size // len(lags))],
    )


def _explain_columns(fit: Fit, sums: Products, cross: Array, inner: Array) -> tuple[float, int]:
    """Sum of squares that columns for every output explain beyond Jacobian and priors, and their rank: Schur complement
    of products `cross` (n_outputs, size + 1, n_columns) with [J, e] and `inner`, which lose no digits as J is nearly
    orthonormal there.
    """
    p, n_y = fit.problem.size, cross.shape[0]
    prior = fit.J_prior @ sums.turn
    own = sums.rows[:p, :p] + prior.T @ prior
    pull = sums.rows[:p, p] + prior.T @ fit.r_prior
    past = np.hstack(list(cross[:, :p]))
    size = column_sizes(np.sqrt(np.diag(own))[None, :])
    values, vectors = np.linalg.eigh(own / np.outer(size, size))
    visible = values > _BLIND * values[-1]
    factor = (vectors[:, visible] / np.sqrt(values[visible])).T @ (np.column_stack([past, pull]) / size[:, None])
    rest = np.kron(np.eye(n_y), inner) - factor[:, :-1].T @ factor[:, :-1]
    left = cross[:, p].ravel() - factor[:, :-1].T @ factor[:, -1]
    values, vectors = np.linalg.eigh(rest)
    distinct = values > _SAME**2
    inside = (vectors[:, distinct].T @ left) / np.sqrt(values[distinct])
    return float(inside @ inside), int(np.count_nonzero(distinct))


def _estimates_agree(moved: Agreement, *, held: bool) -> Check:
    every = " and ".join(f"{s}{'nd' if s == 2 else 'th'}" for s in moved.strides)
    if not moved.strides:
        detail = "refits to every 2nd or 4th output sample failed: the model fits one step ahead only"
    elif moved.passed:
        detail = f"refits to every {every} output sample agree (largest parameter shift {moved.largest:.1f} sd)"
    else:
        far = ", ".join(f"{k} by {s:.3g}" for k, s in zip(moved.names, moved.disagreement(), strict=True))
        detail = (
            f"refits to every {every} output sample shift the parameters by up to {moved.largest:.1f} sd ({far} in "
            "SI): the model does not fit this record. Excite more, reduce the range of "
            f"{'the current' if held else 'motion'}, or extend the model"
        )
    return Check(
        passed=moved.passed, grave=moved.largest > _BEYOND,
        values={"largest_shift_sd": moved.largest, "refits": float(len(moved.strides))}, detail=detail,
    )  # fmt: skip


def agreement(fit: Fit) -> Agreement:
    """Refit a record, by a fit that has not failed, with every second and fourth output; those that do not converge are
    left out.
    """
    problem = fit.problem
    size, n = problem.magnitude, problem.n_physical
    shifts, spreads, strides = [], [], []
    own = directions(np.vstack([fit.J, fit.J_prior])).inverse()[:n, :n]
    for stride in _STRIDES:
        try:
            sparse = replace(problem, stride=stride, noise="given", gain=sparse_gain(fit, stride))
        except np.linalg.LinAlgError:  # no gain that stabilises is found: a refit less, not a job without an estimate
            continue
        start = carry(fit, sparse)
        again = search(sparse, start, steps=60, work=workspace_near(fit, sparse))
        if again.status != "converged":
            continue
        spread = directions(np.vstack([again.J, again.J_prior])).inverse()[:n, :n]
        shifts.append((again.vector[:n] - fit.vector[:n]) * size)
        spreads.append(np.sqrt(np.maximum(np.diag(spread - own), _KNOWN * np.diag(spread))) * size)
        strides.append(stride)
    return Agreement(
        names=problem.estimated,
        shift=np.array(shifts).reshape(-1, n),
        sd=np.array(spreads).reshape(-1, n),
        strides=tuple(strides),
    )


def by_bands(fit: Fit) -> Array:
    """Return how far parameters move where two octaves of the record are left out, (n_bands, n), SI, as far as it is
    beyond chance, else 0. One Newton step, with the levels of noise as they are: what disturbs a band has moved the
    estimate, and the rest of the record does not agree.

    For intervals of a model that does not fit: where noise is fed back, slopes hold some of it, and bands move the
    numbers a little also if the model is right.
    """
    problem, kept = fit.problem, np.ones(fit.problem.size + 1, dtype=bool)
    kept[problem.slices["noise"]] = False
    longest = 2 * _LONGEST // max(problem.y.shape[1], 2)  # no more numbers than of two outputs
    at = busiest(problem.u[problem.skip :], min(longest, problem.n_used))
    parts, first = list[Array](), 0
    for block in residual_blocks(problem, fit.vector, weight_of(fit.covariance), workspace_near(fit, problem)):
        parts.append(block[max(at.start - first, 0) : max(at.stop - first, 0), :, kept])
        first += len(block)
    prior = np.column_stack([fit.J_prior, fit.r_prior])[:, kept]
    return without_bands(np.concatenate(parts), prior.T @ prior, problem.magnitude)


def without_bands(rows: Array, rest: Array, magnitude: Array) -> Array:
    """Return the moves of `by_bands` from slopes and residual of each sample, (n, n_outputs, p + 1), and the products
    (p + 1, p + 1) of all `rest` that is known of the p numbers, those of a `magnitude` first.
    """
    n = magnitude.size
    lines = np.fft.rfft(rows, axis=0) * np.sqrt(2.0 / len(rows))
    lines[0] /= np.sqrt(2.0)
    octaves = np.split(lines, 2 ** np.arange(1, int(np.log2(len(lines)))))
    sums = [(f.conj().T @ f).real for f in (octave.reshape(-1, octave.shape[-1]) for octave in octaves)]
    whole = np.sum(sums, axis=0) + rest
    scale = np.outer(*(column_sizes(np.sqrt(np.diag(whole)[:-1])[None, :]),) * 2)

    def solved(gram: Array) -> tuple[Array, Array]:
        inverse = np.linalg.pinv(gram[:-1, :-1] / scale, rcond=_BLIND, hermitian=True) / scale
        return -(inverse @ gram[:-1, -1])[:n], np.diag(inverse)[:n]

    (step, variance), moves = solved(whole), list[Array]()
    for two in pairwise(sums):
        without, wider = solved(whole - two[0] - two[1])
        shift, chance = without - step, np.maximum(wider - variance, _KNOWN * wider)
        moves.append(np.where(shift**2 > _MOST**2 * chance, shift, 0.0))
    once = np.sqrt(0.5) * magnitude  # each octave is left out twice
    return np.asarray(np.array(moves).reshape(-1, n) * once)


def assumption_checks(
    fit: Fit, spread: Uncertainty, freed: Freed, delay_how: Literal["estimated", "given"]
) -> dict[str, Check]:
    """Check what was taken for known: ``fixed_agree``, ``priors_agree``, ``delay_in_range``, ``delay_shown``,
    ``long_enough``. `freed`: what `free_one` says of each fixed value.
    """
    return {
        "fixed_agree": _fixed_agree(fit, freed),
        "priors_agree": _priors_agree(fit),
        "delay_in_range": _delay_in_range(fit, delay_how),
        "delay_shown": _delay_shown(fit, delay_how),
        "long_enough": _long_enough(spread),
    }


def _fixed_agree(fit: Fit, freed: Freed) -> Check:
    """Score test of each fixed value: would the record, if asked, put it elsewhere?"""
    units = {p.name: p.unit for p in fit.problem.model.parameters}
    worst, most, detail = 1.0, 0.0, "the data agree with every fixed value"
    for name, (statistic, step) in freed.items():
        value, p = fit.problem.known[name], chi_squared_tail(1, statistic)
        if p != p:
            p, detail = 0.0, f"what the data say of the fixed {name} cannot be told. Check it, or free it"
        elif p < min(worst, P_LEAST):
            detail = (
                f"the data contradict the fixed {name} = {value:.4g} {units[name]}; a "
                f"{'larger' if step[-1] > 0 else 'smaller'} value fits better ({p_text(p)}). Check it, or free it"
            )
        worst, most = min(worst, p), max(most, statistic)
    return Check(passed=worst >= P_LEAST, p=worst, values={"gain": most}, detail=detail)


def _priors_agree(fit: Fit) -> Check:
    """Each prior against where one Newton step without it would take its parameter."""
    problem = fit.problem
    worst, name = 0.0, ""
    for row, r in zip(fit.J_prior, fit.r_prior, strict=True):
        j = int(np.argmax(np.abs(row)))
        if j >= problem.n_physical:
            continue
        others = fit.J_prior[fit.J_prior[:, j] == 0.0]
        # at the optimum the pull of the prior is what the data and the other priors hold against
        without = directions(np.vstack([fit.J, others])).inverse()
        step, variance = float(without[j] @ row) * float(r), float(without[j, j])
        size = problem.magnitude[j]
        # r = (value - mean) / sd, so that the data alone would be at mean + r sd + step
        far = abs(step * size + float(r) * problem.prior_sd[j])
        far /= float(np.hypot(np.sqrt(variance) * size, problem.prior_sd[j]))
        if not name or far > worst:
            worst, name = far, problem.estimated[j]
    if worst > _FAR:
        detail = f"the data place {name} {worst:.1f} sd from its prior: one of them is wrong. Check the prior"
    else:
        detail = "the data agree with every prior" if name else "no priors were given"
    return Check(passed=worst <= _FAR, values={"largest_sd": worst}, detail=detail)


def _delay_in_range(fit: Fit, how: Literal["estimated", "given"]) -> Check:
    total = fit.problem.delay_samples(fit.vector)
    inside = how == "given" or total < 2 * MAX_DELAY
    doubt = "" if inside else ", unusually long. Check the columns, or give channels.<input>.delay"
    detail = f"the input delay is {counted(total, 'sample')}{doubt}"
    return Check(passed=inside, values={"samples": total}, detail=detail)


def _delay_shown(fit: Fit, how: Literal["estimated", "given"]) -> Check:
    """Could a fraction of a sample of delay, taken for none, move a parameter out of its interval? Freed, the delay has
    deviation s, each s moving a parameter by t of its own (at a held delay); it is freed where the criterion falls by
    log n, beyond s sqrt(log n) on average: fractions from 1.96 s / t to there go unseen.
    """
    problem, n = fit.problem, fit.problem.n_physical
    if how == "given":
        return Check(passed=True, detail="the delay was given; the estimates assume that it is right")
    if problem.fractional:
        return Check(passed=True, detail="a fractional delay was estimated; the intervals allow for it")
    freed = fit.freed
    if freed is None:
        rows = extend(fit, *free_delay(fit))
        freed = None if rows is None else rows[0]
    if freed is None:
        return Check(passed=False, detail="a fractional delay could not be tested. Give channels.<input>.delay")
    inverse = directions(freed).inverse()
    s, own = float(np.sqrt(inverse[n, n])), np.diag(inverse)[:n]
    along = inverse[:n, n] / s
    t = np.abs(along) / np.sqrt(np.maximum(own - along**2, _BLIND * own))
    worst = int(np.argmax(t))
    unseen = min(s * float(np.sqrt(np.log(problem.n_used))), 1.0)
    shift = float(t[worst]) * unseen / s
    missed = unseen * max(1.0 - 1.96 / max(shift, 1.96), 0.0)
    name, passed = problem.estimated[worst], missed < _MISSED
    return Check(
        passed=passed,
        values={"unseen_samples": unseen, "shift_sd": shift, "missed": missed},
        detail="a fractional delay large enough to bias a parameter beyond its interval would be detected"
        if passed
        else f"an undetected further delay of up to {counted(unseen, 'sample')} could bias {name} by up to "
        f"{shift:.2g} sd. Sample faster, excite more at high frequencies, or give channels.<input>.delay",
    )


def _long_enough(spread: Uncertainty) -> Check:
    enough = spread.widening == 1.0
    detail = (
        "the record is long enough to estimate the noise levels"
        if enough
        else "the record is too short to estimate the noise levels: standard deviations are multiplied by up to "
        f"{spread.widening:.2g}. Record longer"
    )
    return Check(passed=enough, values={"widening": spread.widening}, detail=detail)


def physical_checks(fit: Fit, spread: Uncertainty, record: Record, *, robust: bool) -> dict[str, Check]:
    """Check ``identifiable``, ``plausible``, ``within_limits``, ``signals_sound``; `record`: channels named by role;
    `robust`: which standard deviations count.
    """
    theta = fit.problem.parameters(fit.vector)
    sd = dict(zip(spread.names, spread.standard_deviations(robust=robust).tolist(), strict=True))
    wrong = implausible(fit.problem.model, theta, sd)
    return {
        "identifiable": _identifiable(fit, spread, theta, robust=robust),
        "plausible": Check(passed=not wrong, detail="; ".join(wrong) or "signs are physical; the coil is passive"),
        **signal_checks(record, fit.problem.model.outputs),
    }


def _identifiable(fit: Fit, spread: Uncertainty, theta: Mapping[str, float], *, robust: bool) -> Check:
    visible = spread.identifiable_at(robust=robust)
    unseen = [
        f"{name} (sd {100 * r:.0f} %)" if r < _LOST else f"{name} (sd beyond {100 * _LOST:.0f} %)"
        for name, ok, r in zip(spread.names, visible, spread.relative_sd(robust=robust), strict=True)
        if not ok
    ]
    values = {"condition": float(spread.singular_values[0] / spread.singular_values[-1])}
    if not unseen:
        return Check(passed=True, values=values, detail="every estimated parameter is identifiable")
    what = f"not identifiable from this record: {', '.join(unseen)}"
    if np.any(np.abs(spread.disagreement) > 0.5 * spread.standard_deviations(robust=robust)):
        hint = "The cause is not noise but disagreement of the refits: stay away from limits, and excite more"
        return Check(passed=False, values=values, detail=f"{what}. {hint}")
    rate, length = fit.problem.rate_hz, fit.problem.u.shape[0]
    band = (rate / length, lowest_power_hz(fit.problem.u, rate), rate / 2)
    hint = experiment_hint(spread, theta, band, robust=robust) or ""
    return Check(passed=False, values=values, detail=f"{what}. {hint}")


def lowest_power_hz(u: Array, rate_hz: float) -> float:
    """Return the frequency in Hz below which inputs `u` (n_samples, n_inputs) have 0.1 % of their power."""
    power = np.sum(np.abs(np.fft.rfft(u - u.mean(axis=0), axis=0)) ** 2, axis=1)
    total = np.cumsum(power)
    return float(np.searchsorted(total, 1e-3 * total[-1]) * rate_hz / u.shape[0])


def implausible(model: LinearModel, values: Mapping[str, float], sd: Mapping[str, float]) -> list[str]:
    """List what physics forbids in `values` with `sd`, SI, one line each: mass, resistance and inductance not positive
    (a coil with R > 0 and L > 0 is passive), beyond its uncertainty damping negative, and sizes outside what is built,
    from micro-bearings to turbines (a slip of units).
    """
    texts = []
    for spec in model.parameters:
        value, spread = values[spec.name], sd.get(spec.name, 0.0)
        if spec.positive and value <= 0:
            texts.append(f"{spec.name} = {value:.4g} {spec.unit} ({spec.meaning}) must be positive")
        low, high = _SIZES.get(spec.name, (0.0, float("inf")))
        if not low - 2.0 * spread <= abs(value) <= high + 2.0 * spread:
            texts.append(
                f"{spec.name} = {value:.4g} {spec.unit} is impossible for a bearing: check the units and calibration "
                "of the columns and the sampling rate"
            )
        if spec.name == "c" and value < -3.3 * spread:
            texts.append(f"c = {value:.4g} {spec.unit} is negative: motion would generate energy")
    return texts


_MIRROR = 0.5  # of the difference to the mirrored value: nearer to that, the sign is wrong and not the size
_NEAR = 0.3  # relative, up to which a calibration may explain it
_OWN_CURRENT = 0.5  # relative, between R and the means: nearer, the mean current is the magnet's and no offset


def fact_checks(
    fit: Fit, rig: Rig, bench: Record, spread: Uncertainty, *, robust: bool, freed: Freed | None = None
) -> dict[str, Check]:
    """Check an estimate against what its record, and of model one-axis gravity and the rig's controller, say without a
    fit.

    `robust`: which standard deviations count; `freed`: as of `assumption_checks`. The balance of gravity is asked for
    by default where the current keeps its sign, as that of one magnet that carries a weight does, and its mean is that
    of the voltage, so that it is no offset.
    """
    theta = fit.problem.parameters(fit.vector)
    sd, alone = (
        dict(zip(spread.names, spread.standard_deviations(robust=which).tolist(), strict=True))
        for which in (robust, False)
    )
    checks = agreements(bench, rig, theta, sd, alone, freed)
    if robust:
        scale = zip(fit.problem.model.outputs, np.diag(fit.covariance) * fit.problem.scales.output**2, strict=True)
        checks["resolution"] = resolution_check(bench, dict(scale))
    if "position" not in bench:
        return checks
    loop = loop_agrees(rig, theta, bench.rate_hz)
    checks |= {} if loop is None else {"loop_agrees": loop}
    magnet, means = rig.magnet, checks["ohm"].values if "ohm" in checks else {}
    if magnet is None and "value" in means and abs(means["value"] / theta["R"] - 1.0) < _OWN_CURRENT:
        magnet = RigMagnet()
    if carries_weight(magnet, bench["current"].values):
        assert magnet is not None
        checks["gravity_balance"] = gravity_balance(
            magnet, bench, theta, spread.names, spread.covariance(robust=False), scale_sd=_scale_sd(rig),
            offset_sd=rig.channel("current").offset_sd or 0.0,
        )  # fmt: skip
        if not checks["gravity_balance"].passed and theta["k_x"] > _FAR * sd.get("k_x", np.inf):
            checks["sign_of_k_x"] = Check(
                passed=False, grave=True, cause="belonging", values={"k_x": theta["k_x"]},
                detail=f"k_x = {theta['k_x']:.3g} N/m is that of a spring, and no magnet that carries a weight has "
                "k_x > 0. Check that all columns are of one run, and their signs",
            )  # fmt: skip
    return checks


def carries_weight(magnet: RigMagnet | None, current: Array) -> bool:
    """Whether a rig says that one magnet carries the weight, with a force that grows as the square of `current`."""
    if magnet is None or magnet.kind == "pair" or magnet.saturation:
        return False
    gravity = magnet.known("g")
    return (magnet.kind == "single" or one_sided(current)) and (gravity is None or gravity.value != 0.0)


def gravity_balance(
    magnet: RigMagnet,
    record: Record,
    theta: Mapping[str, float],
    names: tuple[str, ...],
    covariance: Array,
    *,
    scale_sd: float = 0.0,
    offset_sd: float = 0.0,
) -> Check:
    """Check k_i/m against -2 g/i0, within what is not known: of the estimate, of gravity and the current's zero (of the
    rig, else its resolution), and of the law beyond its tangent, E[f] = f (1 + var(i)/i0^2 + ...), for the motion seen.
    `record`: channels named by role; `names`, `covariance`: of estimated numbers, under the model.
    """
    x, i = record["position"].values, record["current"].values
    numbers = {name: magnet.known(name) for name in ("g", "i_offset")}
    g, g_sd = _value(numbers["g"], GRAVITY, 0.0)
    zero, zero_sd = _value(numbers["i_offset"], 0.0, max(resolution(record, "current").step / np.sqrt(12.0), offset_sd))
    i0, (spread, along) = float(i.mean()) - zero, np.cov(x, i)
    ratio, expected = theta["k_i"] / theta["m"], -2.0 * g / i0
    slope = np.array([(name == "k_i") / theta["k_i"] - (name == "m") / theta["m"] for name in names])
    sd = abs(ratio) * float(np.sqrt(max(slope @ covariance @ slope, 0.0) + scale_sd**2))
    rise = theta["k_x"] / (theta["m"] * g)  # f_x/f, as f = -m g
    ripple = float(along[1]) / i0**2
    bend = ripple + 2.0 * rise * float(along[0]) / i0 + 0.75 * rise**2 * float(spread[0])
    doubt = abs(expected) * float(np.sqrt((g_sd / g) ** 2 + (zero_sd / i0) ** 2 + bend**2 + ripple**2))
    total = float(np.hypot(sd, doubt))
    off = ratio / expected - 1.0
    passed = abs(ratio - expected) <= _FAR * total
    detail = f"k_i/m = {ratio:.4g} N/(A kg), sd {sd:.2g} if the model is right; the weight at {i0:.4g} A asks for "
    detail += f"-2 g/i0 = {expected:.4g}, sd {doubt:.2g}"
    if abs(ratio + expected) < _MIRROR * abs(expected):
        detail += (
            ": position is reversed. It has to grow away from the magnet: give channels.position.gain the other sign "
            "(k_i changes its sign with it, no other parameter does), or magnet.parameters.g"
        )
    else:
        detail += f": {100.0 * abs(off):.3g} % {'more' if off > 0 else 'less'}"
    if not passed and abs(off) < _NEAR:
        detail += (
            f". A position that reads as much too {'large' if off > 0 else 'small'}, or a current that reads "
            f"{zero + i0 * off / (1.0 + off):.3g} A at zero would explain it (a factor on current, voltage or mass "
            "would not). Check these two, and that one magnet alone carries the rotor; else record away from limits, "
            "with more excitation"
        )
    if not passed and magnet == RigMagnet():
        detail += (
            ". If a pair of magnets or a permanent magnet carries the rotor, or none of its weight, give magnet.kind = "
            "'pair'"
        )
    values = {
        "current_offset": i0 * off / (1.0 + off),
        "k_i_over_m": ratio,
        "expected": expected,
        "relative": off,
        "sd": sd,
        "expected_sd": doubt,
    }
    return Check(
        passed=passed, values=values, detail=detail, cause="" if passed else "weight", size=None if passed else off
    )


def _scale_sd(rig: Rig) -> float:
    """What a rig says of the scale of k_i/m, which position and the square of the rate share, relative."""
    return float(np.hypot(2.0 * (rig.record.rate_sd or 0.0), rig.channel("position").gain_sd or 0.0))


def _value(p: object, value: float, sd: float) -> tuple[float, float]:
    """A number of the rig and its standard deviation, or what stands where it says nothing."""
    given = getattr(p, "value", None)
    return (value, sd) if given is None else (float(given), float(getattr(p, "sd", None) or 0.0))


def loop_agrees(rig: Rig, theta: Mapping[str, float], rate_hz: float) -> Check | None:
    """Check that the rig's controller holds what was identified (`theta` of model one-axis, SI), and not its mirror
    image; None without a coil, or a loop in the rig or the record.
    """
    if rig.loop is None or not rig.loop.closed or rig.open_loop or "R" not in theta:
        return None
    poles, mirrored = (
        float(np.abs(closed_loop_poles({**theta, "k_i": sign * theta["k_i"]}, rig.loop, rate_hz)).max())
        for sign in (1.0, -1.0)
    )
    values = {"largest_pole": poles, "mirrored": mirrored}
    if poles < 1.0 <= mirrored:
        return Check(passed=True, values=values, detail="the controller of the rig holds the identified plant")
    if mirrored < 1.0 <= poles:
        detail = (
            f"the controller of the rig would not hold the identified plant (largest pole {poles:.4g}), but its mirror "
            f"image (k_i = {-theta['k_i']:.4g} N/A): position is reversed, or voltage and current both are. Give "
            "channels.position.gain the other sign (k_i changes its sign with it, no other parameter does), or correct "
            "the signs of [loop]"
        )
        return Check(passed=False, values=values, detail=detail)
    detail = "the controller of the rig does not tell the sign of the position: "
    detail += (
        "it holds both" if poles < 1.0 else f"it holds neither this plant (largest pole {poles:.4g}) nor its mirror"
    )
    return Check(passed=True, values=values, detail=detail)
