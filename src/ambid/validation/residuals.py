"""How large residuals are, and whether anything is left in them that the past explains: tests, and their words.

All are score tests: a consistent estimate's residuals are e0 - J (theta - theta0); with J projected out of regressors
they do not see the estimate's error (Neyman's C(alpha) test; Ljung 1999, sec. 16.6, Soederstrom and Stoica 1989, sec.
11.2), and the part explained is chi-squared, each correlation normal. Regressors are the past alone: under feedback
future inputs depend on present residuals. A nonlinear model's e is tested against past u^2 and e u too, and e^2 against
past u^2 (Billings and Voon 1986), as u^2 is uncorrelated with u. Outputs are tested one by one, all records together,
their p-values joined by Bonferroni's rule.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, OutputFit
from ambid.estimation.linear import column_sizes, directions, triangle_of
from ambid.estimation.result import NORMAL_95
from ambid.estimation.uncertainty import chi_squared_tail, p_text

P_LEAST = 1e-3  # 99.9 % bounds
_INFLATION = 1.7  # robust over information standard deviation from which the model, not the noise, sets the error
_SEEN = 1e-3  # part of a regressor that J must leave for it to be tested
_SAME = 1e-6  # the same where several residuals are tested together: lags of a slow input are nearly one column
_PREDICTED = 1e-16  # power from which a residual is more than rounding
_DEPENDENT = 1e-9  # singular value from which a direction of J counts
LEAST = 60  # samples of a record from which its residuals are tested
MOST = 2e7  # numbers in a test's regressors: of longer records the last part is tested
_WHITE_LAGS = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 16, 20, 25)
_PRODUCT_LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20)
_INPUT_LAGS, _LONGEST = 16, 400
_LOOP_LAGS, _OWN_LAGS = 10, 20
_MEMORY = (0.5, 0.9, 0.98)  # what a sample keeps of sums of past errors: feedback of slow noise, or by an integral

Sizes = list[dict[str, float]]
"""Of each output: ``fit``, 1 - |e| / |y - mean|, and ``rmse``, SI."""


def fit_of(error: Array, y: Array) -> Array:
    """Return ``1 - |e| / |y - mean|`` of each column, (n_outputs,): 1 is perfect, 0 as good as the mean."""
    spread = np.linalg.norm(y - y.mean(axis=0), axis=0)
    return np.asarray(1 - np.linalg.norm(error, axis=0) / np.where(spread > 0, spread, np.nan))


def error_sizes(errors: Sequence[Array], outputs: Sequence[Array]) -> Sizes:
    """Return fit and rms error (SI) of each output over several records, the fit by each record's own mean: different
    levels do not help.
    """
    e, y = np.concatenate(errors), np.concatenate([x - x.mean(axis=0) for x in outputs])
    fits, rmse = fit_of(e, y), np.sqrt(np.mean(e**2, axis=0))
    return [{"fit": float(f), "rmse": float(s)} for f, s in zip(fits, rmse, strict=True)]


def output_fits(
    outputs: Sequence[str], one_step: Sizes | None, simulation: Sizes | None, noise: Array
) -> dict[str, OutputFit]:
    """Return how well each output is explained; `noise` is the covariance of the innovations."""
    sd = np.sqrt(np.maximum(np.diag(noise), 0.0))
    return {
        name: OutputFit(
            one_step=float("nan") if one_step is None else one_step[j]["fit"],
            simulation=None if simulation is None else simulation[j]["fit"],
            innovation_sd=float(sd[j]),
        )
        for j, name in enumerate(outputs)
    }


def refuse_constant(second: IOData) -> None:
    """Refuse a second record on which nothing can be judged."""
    for name, y in zip(second.outputs, second.y.T, strict=True):
        if not np.any(y != y[0]):
            raise EstimationError(
                f"output {name!r} is constant in the second record, which cannot test a model. Give another record"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualTest:
    """Outcome of a residual test."""

    p: float  # probability of at least this much if the model is right
    statistic: float  # fall of the weighted sum of squares
    degrees: int  # degrees of freedom
    largest: float  # largest correlation coefficient among the tested pairs, in magnitude
    largest_lag: int  # its lag in samples
    channel: str = ""  # whose residual, or which input, this is the worst of

    @property
    def passed(self) -> bool:
        """Whether p is at least 0.001."""
        return self.p >= P_LEAST


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Score:
    """Outcome of a score test."""

    p: float  # probability of at least this much if the model is right
    statistic: float
    degrees: int
    correlation: Array  # (n_regressors,), correlation coefficient of the residual with each regressor
    # (n_regressors,), its standard deviation if the model is right; smaller than 1/sqrt(N) where estimated numbers
    # take part
    sd: Array


def score(e: Array, J: Array, regressors: Array, *, colour: Array | None = None) -> Score:
    """Test whether `regressors` explain a residual `e` (n_used,) of unknown variance and any mean; `J` (n_used,
    n_directions): derivative of the prediction by what was estimated. Regressors are known before each residual or,
    where these have a `colour` (see `autoregression`), independent of all.
    """
    n, rows = e.size, np.hstack([J, np.ones((e.size, 1)), regressors, e[:, None]])
    colour = None if colour is None or colour.size == 1 else colour
    if colour is None:  # inner products are all that counts: those of the triangle are the same
        rows = triangle_of([rows])
    L, rest, rank = _project(rows, J.shape[1] + 1)
    power = float(rest @ rest)
    if power <= _PREDICTED * float(rows[:, -1] @ rows[:, -1]) or not L.shape[1]:
        nothing = np.zeros(L.shape[1])
        return Score(p=1.0, statistic=0.0, degrees=0, correlation=nothing, sd=nothing)
    variance = power / max(n - rank, 1)
    inner = rest @ L
    half, z = _explain(L, inner, _SEEN)
    if colour is None:
        spread = np.sqrt(np.sum(L**2, axis=0))
        statistic = float(z @ z) / variance
    else:
        M = filter_backwards(L, colour)
        gain = variance / power_gain(colour)
        spread = np.sqrt(np.sum(M**2, axis=0) * gain / variance)
        W = triangle_of([M @ half])
        statistic = float(np.sum(np.linalg.lstsq(W.T, z, rcond=1e-8)[0] ** 2)) / gain
    return Score(
        p=chi_squared_tail(z.size, statistic) if z.size else 1.0,
        statistic=statistic,
        degrees=z.size,
        correlation=inner / np.sqrt(power),
        sd=np.asarray(spread * np.sqrt(variance / power)),
    )


def joint_triangle(slopes: Array, residuals: Array, regressors: Array) -> Array:
    """Return the triangle of a test whether `regressors` (n_rows, n_outputs, n_regressors) explain any of several
    residuals of unit variance. Rows are samples, or those of each output's triangle of [slopes, regressors, residual].
    """
    (n, n_y), p, width = residuals.shape, slopes.shape[2], regressors.shape[2]
    rows = np.zeros((n, n_y, p + n_y * width + 1))
    rows[:, :, :p], rows[:, :, -1] = slopes, residuals
    for o in range(n_y):
        rows[:, o, p + o * width : p + (o + 1) * width] = regressors[:, o]
    return triangle_of([rows.reshape(n * n_y, -1)])


def score_of(triangle: Array, n_directions: int) -> tuple[float, float, int]:
    """Return p, statistic and degrees of a test from the triangle of all samples, see `joint_triangle`."""
    L, rest, _ = _project(triangle, n_directions)
    _, z = _explain(L, rest @ L, _SAME)
    return chi_squared_tail(z.size, float(z @ z)) if z.size else 1.0, float(z @ z), z.size


def instrumental_score(e: Array, J: Array, instruments: Array, *, colour: Array | None) -> Score:
    """Test whether instruments, independent of all noise, explain a residual that feedback makes depend on `J`, which
    cannot be projected out: only combinations orthogonal to J count, which the estimate's error does not reach (the
    overidentification test of Sargan 1958). Correlations are those with the instruments (n_used, n_regressors).
    """
    centred, rest = instruments - instruments.mean(axis=0), e - e.mean()
    L = centred / column_sizes(centred)
    u, s, _ = np.linalg.svd(L.T @ (J / column_sizes(J)))
    rank = int(np.count_nonzero(s > _DEPENDENT * max(float(s[0]), 1e-300))) if s.size else 0
    inner = score(rest, np.zeros((e.size, 0)), L @ u[:, rank:], colour=colour)
    power = float(np.linalg.norm(rest))
    return Score(
        p=inner.p,
        statistic=inner.statistic,
        degrees=inner.degrees,
        correlation=rest @ L / power if power > 0 else np.zeros(L.shape[1]),
        sd=np.full(L.shape[1], 1 / np.sqrt(e.size)),
    )


def _project(rows: Array, n_base: int) -> tuple[Array, Array, int]:
    """Regressors of unit length and residual (the last column), each less what the base columns explain; their rank."""
    base = rows[:, :n_base]
    Q, R = np.linalg.qr(base / column_sizes(base))
    factor = directions(np.asarray(R))
    Q = Q @ factor.U[:, factor.s > _DEPENDENT * max(factor.s[0], 1e-300)] if factor.s.size else Q
    L, e = rows[:, n_base:-1], rows[:, -1]
    L = L / column_sizes(L)
    for _ in range(2):  # twice is enough (Kahan): the first pass loses what cancels
        L = L - Q @ (Q.T @ L)
    return L, e - Q @ (Q.T @ e), Q.shape[1]


def _explain(L: Array, inner: Array, least: float) -> tuple[Array, Array]:
    """Orthonormal combinations of regressors, one a column, and their inner products with the residual."""
    _, s, right = np.linalg.svd(triangle_of([L]), full_matrices=False)
    half = right[s > least].T / s[s > least]
    return half, inner @ half


def autoregression(e: Array) -> Array:
    """Describe a residual's colour by Yule-Walker, order by BIC: stable [1, a1, ..., an]; [1] for a white one."""
    n = e.size
    longest = max(1, min(int(10 * np.log10(n)), n // 10))
    v = e - e.mean()
    r = np.array([v[k:] @ v[: n - k] for k in range(longest + 1)]) / n
    best, a, power = np.ones(1), np.ones(1), float(r[0])
    if power <= 0:
        return best
    least = n * np.log(power)
    for k in range(1, longest + 1):  # Levinson's recursion
        reflection = -float(a @ r[k:0:-1]) / power
        a = np.concatenate([a, [0.0]]) + reflection * np.concatenate([[0.0], a[::-1]])
        power *= 1 - reflection**2
        if power <= 0:
            break
        bic = n * np.log(power) + k * np.log(n)
        if bic < least:
            least, best = bic, a
    return best


def filter_backwards(L: Array, a: Array) -> Array:
    """Return H' L for residuals H w of white w: `L` (n_used, n_columns) filtered by 1/A backwards in time."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], a, L[::-1], axis=0)[::-1])


def power_gain(a: Array) -> float:
    """Return the variance of an autoregressive residual over that of the white noise behind it."""
    from scipy.signal import lfilter

    impulse = np.zeros(20_000)
    impulse[0] = 1.0
    return float(np.sum(lfilter([1.0], a, impulse) ** 2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Residuals:
    """What the tests look at; of each signal one array for each record."""

    e: Sequence[Array]  # (n_samples, n_outputs), one-step errors
    u: Sequence[Array]  # (n_samples, n_inputs), deviations of the inputs from their mean over all records
    J: Sequence[Sequence[Array]]  # of each output: (n_samples, n_directions), derivatives of the predictions
    first: int = 0  # samples at the start of a record that are past only
    # autoregression of each output's error; None where the model describes the noise
    colours: Sequence[Array | None]
    source: Sequence[Array]  # (n_samples, n_sources), what errors are tested against: inputs, or references
    # whether `J` holds noise that errors depend on, as it does in a loop for a model without noise; the sources then
    # serve as instruments
    instrumental: bool = False
    nonlinear: bool  # whether squares and products are tested, too
    outputs: Sequence[str] = ()  # names, where words are to use them
    inputs: Sequence[str] = ()

    @property
    def shortest(self) -> int:
        """Samples of the shortest record."""
        return min(len(x) for x in self.e)

    @property
    def squares(self) -> list[Array]:
        """Squares of the inputs' deviations, less their mean over all records."""
        level = np.mean(np.concatenate(self.u) ** 2, axis=0)
        return [x**2 - level for x in self.u]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ResidualTests:
    """What the residuals say; each the worst output, or input."""

    white: ResidualTest  # e against past e
    # e against past inputs; None without inputs, and where the model has more parameters than a test has instruments
    uncorrelated: ResidualTest | None = None
    feedback: ResidualTest | None = None  # inputs against past e: small p is evidence for feedback
    squares: ResidualTest | None = None  # e against past u^2, e^2 against past u^2; None for a linear model
    variance: ResidualTest | None = None
    products: ResidualTest | None = None  # e against past e u; None where the colour of the noise is left open

    @property
    def feedback_seen(self) -> bool:
        """Whether the data show feedback."""
        return self.feedback is not None and not self.feedback.passed

    @property
    def explained_by_inputs(self) -> bool:
        """Whether residuals hold a function of past inputs: then inputs depend on them without any feedback."""
        return any(x is not None and not x.passed for x in (self.uncorrelated, self.squares))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Correlation:
    """Correlation coefficients, ready to be drawn."""

    output: str  # whose error; what is correlated with what
    title: str
    lags: NDArray[np.int64]  # (n_lags,), samples, the second comes before the first by this much
    values: Array  # (n_lags,)
    # (n_lags,), 95 % of the values are within -+ band if the model is right; the estimated numbers are accounted for
    band: Array


def residual_tests(residuals: Residuals, *, open_loop: bool) -> ResidualTests:
    """Test the residuals; in open loop the present input may explain the present residual, too."""
    white, products = (
        tuple(k for k in x if k < residuals.shortest // 10) or (1,) for x in (_WHITE_LAGS, _PRODUCT_LAGS)
    )
    tests = ResidualTests(
        white=_worst([_score(residuals, o, residuals.e, white) for o in _outputs(residuals)], white, residuals.outputs)
    )
    if not residuals.u[0].shape[1]:
        return tests
    loop = _feedback(residuals)
    # under feedback the present input may depend on the present residual, whatever the user says of the loop
    lags = input_lags(residuals.shortest, with_now=open_loop and loop.passed)
    tests = replace(tests, feedback=loop, uncorrelated=_against(residuals, residuals.source, lags))
    if loop.passed and not tests.explained_by_inputs:  # else such sums may foretell an input without any feedback
        slow = _feedback(residuals, slow=True)
        tests = tests if slow.passed else replace(tests, feedback=slow)
    if not residuals.nonlinear:
        return tests
    squares = residuals.squares
    # as instruments, squares alone are too few for most models
    instruments = (
        [np.hstack([a, b]) for a, b in zip(residuals.u, squares, strict=True)] if residuals.instrumental else squares
    )
    variance = [_variance(residuals, o, squares, products) for o in _outputs(residuals)]
    mixed = [
        _score(residuals, o, _times(residuals, o), products)
        for o in _outputs(residuals)
        if residuals.colours[o] is None
    ]
    return replace(
        tests,
        squares=_against(residuals, instruments, products),
        variance=_worst(variance, products, residuals.outputs),
        products=_worst(mixed, products, residuals.outputs) if mixed else None,
    )


def input_lags(n_samples: int, *, with_now: bool) -> tuple[int, ...]:
    """Return the lags at which inputs are tested: up to 16, then in even ratios to a twentieth of the record, at most
    400.
    """
    longest = max(3, min(n_samples // 20, _LONGEST))
    near = range(0 if with_now else 1, min(_INPUT_LAGS, longest) + 1)
    far = (round(float(k)) for k in np.geomspace(_INPUT_LAGS, longest, 7)) if longest > _INPUT_LAGS else ()
    return tuple(sorted({*near, *far}))


def correlations(
    residuals: Residuals, inputs: Sequence[str], outputs: Sequence[str], *, n_lags: int = 20
) -> list[Correlation]:
    """Correlate each output's errors, lag by lag, with their past, then each input; for a nonlinear model also with u^2
    and e u, and e^2 with u^2.
    """
    lags = tuple(range(1, min(n_lags, residuals.shortest // 4) + 1))
    results, squares = list[Correlation](), residuals.squares
    for o, output in enumerate(outputs):
        one = [(f"e of {output}, its past", _score(residuals, o, [x[:, [o]] for x in residuals.e], lags))]
        for i, name in enumerate(inputs):
            u, u2 = [x[:, [i]] for x in residuals.u], [x[:, [i]] for x in squares]
            one.append((f"e of {output}, {name}", _score(residuals, o, u, lags, against_inputs=True)))
            if not residuals.nonlinear:
                continue
            one.append((f"e of {output}, {name}²", _score(residuals, o, u2, lags, against_inputs=True)))
            if residuals.colours[o] is None:
                mixed = [x[:, [i]] for x in _times(residuals, o)]
                one.append((f"e of {output}, e × {name}", _score(residuals, o, mixed, lags)))
            one.append((f"e² of {output}, {name}²", _variance(residuals, o, u2, lags)))
        results += [
            Correlation(output=output, title=t, lags=np.array(lags), values=s.correlation, band=NORMAL_95 * s.sd)
            for t, s in one
        ]
    return results


def _outputs(residuals: Residuals) -> range:
    return range(residuals.e[0].shape[1])


def _rows(x: Array, lags: Sequence[int], first: int) -> Array:
    """Columns of all signals at all lags, lag by lag, from a sample on that all lags reach back from."""
    return np.hstack([x[first - k : x.shape[0] - k] for k in lags])


def _score(
    residuals: Residuals, o: int, signals: Sequence[Array], lags: tuple[int, ...], *, against_inputs: bool = False
) -> Score:
    """Score test of lagged signals as regressors of the errors of one output."""
    width = max(1, residuals.J[o][0].shape[1] + len(lags) * signals[0].shape[1])
    start = [max(residuals.first, *lags, x.shape[0] - int(MOST / width / len(residuals.e))) for x in residuals.e]
    e = np.concatenate([x[k:, o] for x, k in zip(residuals.e, start, strict=True)])
    J = np.concatenate([x[k:] for x, k in zip(residuals.J[o], start, strict=True)])
    lagged = np.concatenate([_rows(s, lags, k) for s, k in zip(signals, start, strict=True)])
    colour = residuals.colours[o] if against_inputs else None
    if against_inputs and residuals.instrumental:
        return instrumental_score(e, J, lagged, colour=colour)
    return score(e, J, lagged, colour=colour)


def _times(residuals: Residuals, o: int) -> list[Array]:
    """One output's error times the inputs."""
    return [e[:, [o]] * u for e, u in zip(residuals.e, residuals.u, strict=True)]


def _against(residuals: Residuals, signals: Sequence[Array], lags: tuple[int, ...]) -> ResidualTest | None:
    """Test errors against inputs; None where no instrument is left over."""
    worst = _worst(
        [_score(residuals, o, signals, lags, against_inputs=True) for o in _outputs(residuals)], lags, residuals.outputs
    )
    return None if residuals.instrumental and not worst.degrees else worst


def _variance(residuals: Residuals, o: int, squares: Sequence[Array], lags: tuple[int, ...]) -> Score:
    """Test e^2 against past u^2; the estimated numbers shift e^2 in second order only, and need no account."""
    first = max(residuals.first, *lags)
    power = np.concatenate([x[first:, o] ** 2 for x in residuals.e])
    colour = None if residuals.colours[o] is None else autoregression(power)
    lagged = np.concatenate([_rows(x, lags, first) for x in squares])
    return score(power, np.zeros((power.size, 0)), lagged, colour=colour)


def _feedback(residuals: Residuals, *, slow: bool = False) -> ResidualTest:
    """Granger's test of errors -> inputs: do past errors say more of an input than its own past (Caines 1975)? `slow`:
    a few fading sums of past errors in place of lags, p of two tests; weak feedback moves few degrees of freedom more.
    """
    own, loop = (tuple(range(1, max(1, min(k, residuals.shortest // 20)) + 1)) for k in (_OWN_LAGS, _LOOP_LAGS))
    width = len(own) * residuals.u[0].shape[1] + len(loop) * residuals.e[0].shape[1]
    start = [max(residuals.first, *own, x.shape[0] - int(MOST / width / len(residuals.e))) for x in residuals.e]
    past = np.concatenate([_rows(u, own, k) for u, k in zip(residuals.u, start, strict=True)])
    past_errors: Sequence[Array] = residuals.e
    if slow:
        from scipy.signal import lfilter

        loop = (1,)
        past_errors = [np.hstack([lfilter([1.0], [1.0, -k], x, axis=0) for k in _MEMORY]) for x in residuals.e]
    errors = np.concatenate([_rows(e, loop, k) for e, k in zip(past_errors, start, strict=True)])
    now = np.concatenate([u[k:] for u, k in zip(residuals.u, start, strict=True)])
    left = now - past @ np.linalg.lstsq(past, now, rcond=None)[0] if slow else now  # as of a periodic input
    colours = [autoregression(x) if slow else None for x in left.T]
    scores = [score(x, past, errors, colour=c) for x, c in zip(now.T, colours, strict=True)]
    test = _worst(scores, loop * errors.shape[1], residuals.inputs)
    return replace(test, p=min(1.0, 2.0 * test.p)) if slow else test


def _worst(tests: Sequence[Score], lags: tuple[int, ...], channels: Sequence[str]) -> ResidualTest:
    worst = min(range(len(tests)), key=lambda k: tests[k].p)
    s = tests[worst]
    k = int(np.argmax(np.abs(s.correlation))) if s.correlation.size else 0
    return ResidualTest(
        p=min(1.0, s.p * len(tests)),
        statistic=s.statistic,
        degrees=s.degrees,
        largest=float(np.abs(s.correlation[k])) if s.correlation.size else 0.0,
        largest_lag=lags[k // max(1, s.correlation.size // len(lags))],
        channel=channels[worst] if channels else "",
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Subject:
    """Whose residuals are judged."""

    name: str  # as in "this narx"
    coloured: bool  # whether it leaves the colour of the noise open
    biased: bool  # whether feedback biases it
    closed: bool = False  # whether a reference, or the loop of a rig, says that there is feedback


def white_check(test: ResidualTest) -> Check:
    """Return the check that residuals are white, from their test against their own past."""
    return _residual_check(test)


def uncorrelated_check(test: ResidualTest) -> Check:
    """Return the check that residuals are uncorrelated with past inputs."""
    return _residual_check(test, "past inputs")


def _residual_check(test: ResidualTest, against: str = "", *, subject: str = "residuals") -> Check:
    """State whether residuals are white or, with `against`, uncorrelated with another signal."""
    whose = f" of {test.channel}" if test.channel else ""
    words = ("white", "not white") if not against else (f"uncorrelated with {against}", f"correlated with {against}")
    measure = "cross-correlation" if against else "autocorrelation"
    return Check(
        passed=test.passed,
        p=test.p,
        values={
            "statistic": test.statistic,
            "degrees_of_freedom": float(test.degrees),
            "largest_correlation": test.largest,
            "largest_lag": float(test.largest_lag),
        },
        detail=f"{subject}{whose} are {words[not test.passed]} "
        f"(largest {measure} {test.largest:.3f} at lag {test.largest_lag}, {p_text(test.p)})",
    )


def residual_checks(tests: ResidualTests, subject: Subject) -> dict[str, Check]:
    """Return the checks ``residuals_white``, with inputs ``residuals_uncorrelated`` and ``feedback``, and of a
    nonlinear model ``residuals_nonlinear`` and ``residual_variance``.
    """
    white = white_check(tests.white)
    if not white.passed and subject.coloured:
        detail = f"residuals are coloured, which is no fault: {subject.name} has no noise model"
        white = Check(passed=True, p=white.p, values=white.values, detail=detail)
    checks = {"residuals_white": white}
    if tests.uncorrelated is not None:
        checks["residuals_uncorrelated"] = uncorrelated_check(tests.uncorrelated)
    if tests.squares is not None:
        checks["residuals_nonlinear"] = _check_nonlinear(tests.squares, tests.products)
    if tests.variance is not None:
        checks["residual_variance"] = _check_variance(tests.variance)
    if tests.feedback is not None:
        checks["feedback"] = _check_feedback(tests, tests.feedback, subject)
    return checks


def _check_nonlinear(squares: ResidualTest, products: ResidualTest | None) -> Check:
    """One verdict of both; p by Bonferroni's rule."""
    both = [(squares, "squares of past inputs")]
    if products is not None:
        both.append((products, "products of past residuals and inputs"))
    worst, what = min(both, key=lambda x: x[0].p)
    check = _residual_check(replace(worst, p=min(1.0, len(both) * worst.p)), what)
    values = {**check.values, "p_squares": squares.p}
    if products is not None:
        values["p_products"] = products.p
    return Check(passed=check.passed, p=check.p, detail=check.detail, values=values)


def _check_variance(test: ResidualTest) -> Check:
    check = _residual_check(test, "squares of past inputs", subject="squared residuals")
    if check.passed:
        return check
    detail = f"{check.detail}: the noise level varies, or a nonlinearity is missing; standard deviations assume neither"
    return replace(check, detail=detail)


def describe_feedback(test: ResidualTest) -> str:
    """Say which input depends on past residuals."""
    return f"{f'input {test.channel!r} depends' if test.channel else 'inputs depend'} on past residuals"


def _check_feedback(tests: ResidualTests, test: ResidualTest, subject: Subject) -> Check:
    visible, evidence = tests.feedback_seen, describe_feedback(test)
    if not visible and subject.biased and subject.closed:
        detail = f"the record was taken in a loop, as its reference or its rig says, which biases {subject.name}"
    elif not visible:
        detail = "no sign of feedback (no proof of an open loop): inputs do not depend on past residuals"
    elif tests.explained_by_inputs:
        detail = f"{evidence}, but residuals also on past inputs: feedback, or an incomplete model"
    elif subject.biased:
        detail = f"{evidence}: there is feedback, which biases {subject.name}"
    else:
        detail = f"{evidence}: there is feedback; {subject.name} is consistent in closed loop"
    return Check(
        passed=not (subject.biased and (visible or subject.closed)),
        p=test.p,
        values={"largest_correlation": test.largest, "largest_lag": float(test.largest_lag), "seen": float(visible)},
        detail=f"{detail} ({p_text(test.p)})",
    )


def consistent_check(inflation: float) -> Check:
    """Judge by how much robust standard deviations are larger than those from the information matrix."""
    return Check(
        passed=inflation < _INFLATION, values={"inflation": inflation},
        detail=f"robust standard deviations are up to {inflation:.2f} times those from the information matrix (limit "
        f"{_INFLATION:g})",
    )  # fmt: skip
