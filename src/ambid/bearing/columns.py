"""Columns that are not what the rig says: one without a signal, reversed, swapped, or late; refused by name.

No bearing explains such a record, and the search for one is long. Without a signal: the others explain nothing of it;
wrong sign or order: the start values fit badly, and lead to a full fit with it changed. For a lag between channels the
rotor's x'' = -(k_x/m) x + (k_i/m) i + constant is regressed over frequencies (`take_moments`), the current shifted to
where it explains most. A delay of the voltage, or of both channels, is the model's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Candidate, Delay, Signals, Spectrum, starts, take_moments
from ambid.bearing.sizes import check_units, possible
from ambid.errors import EstimationError
from ambid.estimation.estimate import Check
from ambid.estimation.likelihood import Fit, failure
from ambid.estimation.predictor import busiest
from ambid.estimation.uncertainty import chi_squared_tail
from ambid.physics.linear_model import LinearModel, Parameter
from ambid.rig.roles import Coil, coil_of
from ambid.signals.delay import fit_arx

Change = tuple[str, str, Signals]
"""What may be wrong, what to do about it, and the record with it changed."""

_LOOKED = 16384  # samples that show whether a column holds a signal
_LAGS = (0, 1, 2, 4, 8, 16, 40)  # before and after
_RIDGE = 1e-9  # of the norm of a column: slow signals are nearly the same at neighbouring lags
_CHANCE = 1e-4  # probability above which what the others explain of a column, and of its differences, is chance
_FAR = 12.0  # median distances from the median at which values are held: about eight standard deviations
_OWN = 4  # lags of its own from which a set point follows
_NOISELESS = 1e-6  # of its spread: half of what its own past leaves of a column without noise
_ROUNDING = 1e-9  # of its spread: below, comparisons are those of rounding
_SAME = 1e-9  # from a correlation of one
POOR = 2.5  # criterion per sample of a start that may be the wrong record's; good ones are below 2
_GAIN = 0.7  # fall of the criterion per sample by which a change of the record must do better

_STRETCH = 4096  # samples that show a coil
_CLEAR = 0.9  # part that a coil has to explain before its signs are believed
_OFFSETS = 0.5  # relative, that offsets may put between R and mean voltage over mean current
_FOLLOWED = 2  # changes that are searched from, the best first


def refuse_silent(model: LinearModel, signals: Signals) -> None:
    """Raise where a column has nothing to do with the others, or is one of them a second time."""
    roles = (*model.inputs, *model.outputs)
    at = busiest(signals.u, _LOOKED)
    columns = np.column_stack([signals.u[at], signals.y[at]])
    centre = np.median(columns, axis=0)
    reach = _FAR * np.median(np.abs(columns - centre), axis=0)
    reach[reach == 0.0] = np.inf  # of a signal that mostly stands still everything counts
    clipped = np.clip(columns - centre, -reach, reach)  # a glitch is no reason
    _refuse_twins(roles, clipped)
    _refuse_set_points(model, replace(signals, u=signals.u[at], y=signals.y[at]))
    chance = _by_chance(clipped)
    if max(chance) > _CHANCE:
        chance = [min(pair) for pair in zip(chance, _by_chance(np.diff(clipped, axis=0)), strict=True)]
    most = int(np.argmax(chance))
    if chance[most] > _CHANCE:
        role, others = roles[most], " and ".join(r for j, r in enumerate(roles) if j != most)
        raise EstimationError(
            f"channel {role!r} is unrelated to {others}: they explain none of it. Check channels.{role}.column in the "
            "rig, and the wiring"
        )


def _refuse_set_points(model: LinearModel, signals: Signals) -> None:
    """Raise where an output is computed, not measured: without noise, and nothing that the others do moves it."""
    for j, role in enumerate(model.outputs):
        y, others = signals.y[:, j], [*signals.u.T, *np.delete(signals.y, j, axis=1).T]
        spread = float(np.std(y))
        if spread == 0.0 or len(y) < 40 * (len(others) + 1):
            continue
        scaled = (y - y.mean()) / spread
        own = fit_arx(scaled, (), _OWN, ())
        past = np.column_stack([scaled[_OWN - k : len(scaled) - k] for k in range(1, _OWN + 1)])
        left = scaled[_OWN:] - past @ own.coefficients[:_OWN] - own.coefficients[-1]
        if min(float(np.median(np.abs(d))) for d in (left, np.diff(scaled))) > _NOISELESS:
            continue
        driven = fit_arx(scaled, [(x - x.mean()) / (np.std(x) or 1.0) for x in others], _OWN, range(_OWN + 1))
        moved = own.variance * own.n_rows / max(driven.variance * driven.n_rows, 1e-300) - 1.0
        degrees = len(others) * (_OWN + 1)
        if own.variance < _ROUNDING**2 or chi_squared_tail(degrees, driven.n_rows * moved) > _CHANCE:
            raise EstimationError(
                f"channel {role!r} has no noise and is not moved by the others: it is a set point or a computed "
                f"signal. Check channels.{role}.column in the rig"
            )


def _refuse_twins(roles: Sequence[str], columns: Array) -> None:
    """Raise where two columns are the same but for a factor."""
    size = np.linalg.norm(columns, axis=0)
    for j, one in enumerate(roles):
        for k, other in enumerate(roles[:j]):
            if abs(float(columns[:, j] @ columns[:, k])) > (1.0 - _SAME) * size[j] * size[k]:
                raise EstimationError(
                    f"channels {other!r} and {one!r} hold the same signal. Check channels.{one}.column in the rig"
                )


def _by_chance(columns: Array) -> list[float]:
    """Probability, for each column, that the others explain as much of it if they have nothing to do with it."""
    most, (n, width) = _LAGS[-1], columns.shape
    moves = sorted({*_LAGS, *(-k for k in _LAGS)}, key=abs)  # a column as it is comes first
    if n - 2 * most < 4 * len(moves) * width:
        return [0.0] * width
    rows = np.ascontiguousarray(columns.T)
    Z = np.vstack([rows[:, most + k : n - most + k] for k in moves])
    Z -= Z.mean(axis=1, keepdims=True)
    inner = Z @ Z.T
    size = np.maximum(np.sqrt(np.diag(inner)), 1e-300)
    inner = inner / size[:, None] / size + _RIDGE * np.eye(len(Z))
    chances: list[float] = []
    for j in range(width):
        others = np.arange(len(Z)) % width != j
        along = inner[others, j]
        part = float(along @ np.linalg.solve(inner[np.ix_(others, others)], along))
        degrees = int(np.count_nonzero(others))
        chances.append(chi_squared_tail(degrees, (Z.shape[1] - degrees) * part / max(1.0 - part, 1e-12)))
    return chances


def refuse_mistaken(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    as_is: float,
    follow: Callable[[Sequence[Candidate]], Fit],
    *,
    searched: bool = False,
) -> None:
    """Raise where the record fits badly, and well with one sign reversed or two columns swapped. `as_is`: criterion per
    sample of the best start, infinite where there is none, or (`searched`) of a failed fit; `follow`: searches from
    start values.
    """
    coil = _coil(model, signals)
    turned = coil is not None and coil.reversed and coil.share > _CLEAR
    if as_is < POOR and not (searched or turned):
        return
    below = as_is - (0.0 if searched else _GAIN)
    _refuse_units(model, signals, parameters, delay, follow, np.inf if searched else below)
    better: list[tuple[float, str, str, Signals, list[Candidate]]] = []
    likely, others = _likely(model, _changes(model, signals), 0.0 if coil is None or turned else coil.share)
    for text, remedy, changed in likely:  # one start and one search, where a coil shows what is wrong
        _refuse_explained(text, remedy, changed, _starts(model, changed, parameters, delay), follow)
    if model.name == "one-axis":  # after them: two columns that are swapped look like one that lags by a lot
        _refuse_late(model, signals, parameters, delay, follow)
    for text, remedy, changed in others:
        candidates = _starts(model, changed, parameters, delay)
        per_sample = candidates[0].criterion / candidates[0].problem.n_used if candidates else np.inf
        if per_sample < below:
            better.append((per_sample, text, remedy, changed, candidates))
    for _, text, remedy, changed, candidates in sorted(better, key=lambda b: b[0])[:_FOLLOWED]:
        _refuse_explained(text, remedy, changed, candidates, follow)


def _refuse_explained(
    text: str,
    remedy: str,
    changed: Signals,
    candidates: Sequence[Candidate],
    follow: Callable[[Sequence[Candidate]], Fit],
) -> None:
    """Raise where a changed record, of which these are the start values, is explained, its means too."""
    fit = _try(follow, candidates) if candidates else None
    if fit is not None and _can_be(fit) and not _means_contradict(fit, changed):
        raise EstimationError(
            f"{text}: no bearing explains the record as it is, but one does after this change ({_numbers(fit)}). "
            f"{remedy}"
        )


def _means_contradict(fit: Fit, signals: Signals) -> bool:
    """Return whether mean voltage over mean current of a record is far from R, where both keep to one side."""
    model, theta = fit.problem.model, fit.problem.parameters(fit.vector)
    columns = dict(zip((*model.inputs, *model.outputs), [*signals.u.T, *signals.y.T], strict=True))
    if "R" not in theta or not {"voltage", "current"} <= columns.keys():
        return False
    (v, v_sd), (i, i_sd) = ((float(x.mean()), float(x.std())) for x in (columns["voltage"], columns["current"]))
    return abs(v) > v_sd and abs(i) > i_sd and abs(v / (i * theta["R"]) - 1.0) > _OFFSETS


def _coil(model: LinearModel, signals: Signals) -> Coil | None:
    """The coil that a stretch of the record shows."""
    at = busiest(signals.u, _STRETCH)
    columns = dict(zip((*model.inputs, *model.outputs), [*signals.u[at].T, *signals.y[at].T], strict=True))
    if "voltage" not in columns or "current" not in columns:
        return None
    return coil_of(columns["voltage"], columns["current"], columns.get("position"), signals.rate_hz)


def _likely(model: LinearModel, changes: Iterable[Change], share: float) -> tuple[list[Change], list[Change]]:
    """Changes that leave a coil no less clear than its `share` as it is, the clearest first; and the others."""
    coils, others = [], []
    for change in changes:
        coil = _coil(model, change[2])
        if coil is not None and coil.share > _CLEAR and not coil.reversed:
            coils.append((coil.share, change))
        elif coil is None or coil.share >= share:
            others.append(change)
    return [change for _, change in sorted(coils, key=lambda f: -f[0])], others


def _refuse_late(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    follow: Callable[[Sequence[Candidate]], Fit],
) -> None:
    """Raise where a channel lags behind the others, and a bearing explains the record once that is taken back."""
    lag = lag_of(signals)
    if lag is not None and lag.shown and round(lag.samples):
        candidates = _starts(model, without_lag(signals, lag), parameters, delay)
        fit = _try(follow, candidates) if candidates else None
        if fit is not None and _can_be(fit):
            raise EstimationError(
                f"{lag.describe(signals.rate_hz)}: no bearing explains the record as it is, but one does after that "
                f"({_numbers(fit)})"
            )


def _refuse_units(
    model: LinearModel,
    signals: Signals,
    parameters: Sequence[Parameter],
    delay: Delay,
    follow: Callable[[Sequence[Candidate]], Fit],
    below: float,
) -> None:
    """Raise where only what the rig says of a parameter stands in the way, and a mistaken unit would explain that;
    `below`: criterion per sample that the start values without it have to reach.
    """
    if all(p.role == "free" for p in parameters if p.value):
        return
    free = [replace(p, role="free", sd=None, value=None) if p.value else p for p in parameters]
    candidates = _starts(model, signals, free, delay)
    if not candidates or candidates[0].criterion / candidates[0].problem.n_used > below:
        return
    fit = _try(follow, candidates)
    check = None if fit is None else check_units(fit.problem.parameters(fit.vector), parameters, signals, model)
    if check is not None and not check.passed:
        raise EstimationError(check.detail)


def _starts(model: LinearModel, signals: Signals, parameters: Sequence[Parameter], delay: Delay) -> list[Candidate]:
    """Start values of a trial; none where there are none."""
    try:
        return starts(model, signals, parameters, delay)
    except (EstimationError, np.linalg.LinAlgError):
        return []


def _try(follow: Callable[[Sequence[Candidate]], Fit], candidates: Sequence[Candidate]) -> Fit | None:
    """Return a trial's fit where it explains the record; a trial never ends the job."""
    try:
        fit = follow(candidates)
    except (EstimationError, np.linalg.LinAlgError):
        return None
    return fit if failure(fit) == "" else None


def _can_be(fit: Fit) -> bool:
    """Whether what was found is a bearing that could be built."""
    theta, problem = fit.problem.parameters(fit.vector), fit.problem
    signals = Signals(u=problem.u, y=problem.y, rate_hz=problem.rate_hz)
    return possible(theta, signals, problem.model) and all(
        theta[p.name] > 0 for p in problem.model.parameters if p.positive
    )


def _changes(model: LinearModel, signals: Signals) -> Iterator[Change]:
    """Yield one sign reversed, and two columns swapped."""
    roles, size = (*model.inputs, *model.outputs), len(model.inputs)
    columns = np.column_stack([signals.u, signals.y])

    def changed(order: Sequence[int], sign: Sequence[float]) -> Signals:
        moved = columns[:, order] * sign
        return replace(signals, u=moved[:, :size], y=moved[:, size:])

    own, same = list(range(len(roles))), [1.0] * len(roles)
    if "voltage" in roles and "current" in roles:
        i = columns[:, roles.index("current")]
        bias = -float(np.mean(i)) > float(np.std(i))  # a current of one sign is positive where it is wired right
        first, second = ("current", "voltage") if bias else ("voltage", "current")
        yield (
            f"channel {first!r} is reversed (or {second!r} is)",
            f"Swap the sensor's leads, or reverse the sign of channels.{first}.gain",
            changed(own, [-1.0 if role == first else 1.0 for role in roles]),
        )
    for a, b in combinations(own, 2):
        order = [b if k == a else a if k == b else k for k in own]
        yield (
            f"channels {roles[a]!r} and {roles[b]!r} are swapped",
            f"Exchange channels.{roles[a]}.column and channels.{roles[b]}.column",
            changed(order, same),
        )


def _numbers(fit: Fit) -> str:
    theta = fit.problem.parameters(fit.vector)
    return ", ".join(f"{p.name} = {theta[p.name]:.3g} {p.unit}" for p in fit.problem.model.parameters if theta[p.name])


_FARTHEST = 40  # samples
_BANDS = (0.15, 0.06, 0.025)  # of the Nyquist frequency: above, the noise of the position counts most
_FEWEST = 20  # lines
_SHARE = 0.7  # of the acceleration that has to be explained before a lag is one
_SURE = 4.0  # standard deviations
_LEAST = 0.5  # samples: a smaller lag moves parameters by a percent at most
_ALIKE = 48.0  # over the lines: rise of what is left over that is no more than chance, 4 sd, of lines joined in threes
_STEPS = 3
_REACH = 8  # lines whose products count, less and less: twice the width of the window's main lobe
_JOINED, _HELD = 3, 0.9  # lines that are left out together, and the most that they may be said to hold of themselves


@dataclass(frozen=True, slots=True, kw_only=True)
class Lag:
    """How much later the position is logged than the current; negative: the current lags."""

    samples: float
    sd: float
    share: float  # part of the acceleration that is explained with it

    @property
    def shown(self) -> bool:
        """Whether the record shows a lag that counts."""
        return self.share > _SHARE and abs(self.samples) - _SURE * self.sd > _LEAST

    @property
    def channel(self) -> str:
        """The channel that is late."""
        return "position" if self.samples > 0 else "current"

    def describe(self, rate_hz: float) -> str:
        """Return what is late, by how much, and the remedy."""
        late, other = abs(self.samples), "current" if self.samples > 0 else "position"
        whole = f", or give channels.{self.channel}.delay = {round(late)}" if round(late) else ""
        size = f"{late:.2g} samples ({1e3 * late / rate_hz:.3g} ms)"
        return (
            f"channel {self.channel!r} lags behind {other} by {size}. Sample both at the same instant and filter them "
            f"alike{whole}" + ("; or eddy currents delay the force" if self.samples > 0 else "")
        )


def lag_of(signals: Signals) -> Lag | None:
    """Measure the lag between position and current of a record of model one-axis; None where nothing moves."""
    at = busiest(signals.u, _LOOKED)
    x, i = (signals.y[at] - signals.y[at].mean(axis=0)).T
    m = take_moments({"position": x, "current": i}, (), signals.rate_hz)
    turn = m.omega / signals.rate_hz  # rad per sample
    best: tuple[float, int, slice] = (0.0, 0, slice(0))
    for band in _BANDS:
        lines = slice(3, int(band * m.omega.size))
        if lines.stop - lines.start >= _FEWEST:
            rows = _rows(m.signals["position"], m.signals["current"][0], m.omega, lines)
            best = max(best, (*_coarse(*rows, turn[lines]), lines), key=lambda b: b[0])
    share, whole, lines = best
    if share <= 0.0:
        return None
    target, stiffness, current = _rows(m.signals["position"], m.signals["current"][0], m.omega, lines)
    samples, sd = float(whole), np.inf
    for _ in range(_STEPS):  # Gauss-Newton on the fraction
        moved = current * np.exp(-1j * turn[lines] * samples)
        terms = np.column_stack([_real(stiffness), _real(moved), _real(-1j * turn[lines] * moved)])
        size = np.linalg.norm(terms, axis=0)
        values = np.linalg.lstsq(terms / size, _real(target), rcond=None)[0]
        force = float(values[1] / size[1]) or np.inf
        samples += float(np.clip(values[2] / size[2] / force, -0.5, 0.5))
        sd = _sd(terms / size, _real(target) - terms / size @ values) / size[2] / abs(force)
    return Lag(samples=samples, sd=sd, share=share)


def late(model: LinearModel, signals: Signals) -> bool:
    """Whether position or current of a record lag."""
    lag = lag_of(signals) if model.name == "one-axis" else None
    return lag is not None and lag.shown


def check_lag(signals: Signals) -> Check:
    """Check that position and current are logged at the same instants."""
    lag = lag_of(signals)
    if lag is None or lag.share <= _SHARE:
        return Check(passed=True, detail="the current explains too little of the motion to tell whether a channel lags")
    values = {"samples": lag.samples, "sd": lag.sd}
    if lag.shown:
        late = "sensor_lag" if lag.samples > 0 else "current_sensor_pole"
        others = ("sensor_pole", "eddy_pole") if lag.samples > 0 else ("current_lag",)
        detail = lag.describe(signals.rate_hz)
        return Check(passed=False, values=values, detail=detail, cause=late, alternatives=others)
    detail = f"position and current are logged at the same instants (lag {lag.samples:.2g} ± {lag.sd:.1g} samples)"
    return Check(passed=True, values=values, detail=detail)


def without_lag(signals: Signals, lag: Lag) -> Signals:
    """Return a record whose late channel is taken earlier by whole samples, at the cost of its end."""
    k = round(abs(lag.samples))
    n = len(signals.u) - k
    x, i = signals.y.T
    moved = (x[k:], i[:n]) if lag.samples > 0 else (x[:n], i[k:])
    return replace(signals, u=signals.u[:n], y=np.column_stack(moved))


def _rows(
    position: tuple[Spectrum, Spectrum, Spectrum], current: Spectrum, omega: Array, lines: slice
) -> tuple[Spectrum, Spectrum, Spectrum]:
    """Acceleration, position and current over some lines, weighted so that low and high ones count alike."""
    weight = 1.0 / (omega[lines] + omega[lines][-1] / 3.0) ** 2
    return position[2][lines] * weight, position[0][lines] * weight, current[lines] * weight


def _coarse(target: Spectrum, stiffness: Spectrum, current: Spectrum, turn: Array) -> tuple[float, int]:
    """The whole lag at which most is explained, the smallest of equals, and how much: with one resonance dominant, half
    its period later the current explains as much with the other sign.
    """
    if not (np.any(target) and np.any(stiffness) and np.any(current)):
        return 0.0, 0
    power, size = (float(np.vdot(x, x).real) for x in (target, current))
    aside = stiffness / float(np.linalg.norm(stiffness))
    goal = target - aside * float(np.vdot(aside, target).real)
    unexplained = float(np.vdot(goal, goal).real)
    shares = np.empty(2 * _FARTHEST + 1)
    moved, step = current * np.exp(1j * turn * _FARTHEST), np.exp(-1j * turn)
    for k in range(shares.size):
        own = size - float(np.vdot(aside, moved).real) ** 2  # of what position does not explain of the current
        shares[k] = 1.0 - (unexplained - float(np.vdot(moved, goal).real) ** 2 / own) / power
        moved = moved * step
    alike = (1.0 - shares.max()) * (1.0 + _ALIKE / turn.size)
    near = np.flatnonzero(1.0 - shares <= alike) - _FARTHEST
    at = int(near[np.argmin(np.abs(near))])
    return float(shares[at + _FARTHEST]), at


def _sd(terms: Array, left: Array) -> float:
    """Standard deviation of the last coefficient, whatever the spectrum of what is `left`. Products of lines that the
    window joins are summed (Newey and West 1987), each judged as if its neighbours were left out (MacKinnon and White
    1985): over sound records the lag over this has a root mean square of 1, without it of 2 to 3.
    """
    inverse, n = np.linalg.pinv(terms.T @ terms), left.size // 2  # real parts of the lines, then imaginary ones
    leverage = np.einsum("ij,jk,ik->i", terms, inverse, terms)
    share = np.convolve(leverage[:n] + leverage[n:], np.ones(_JOINED), "same")
    each = terms @ inverse[2] * left
    scores = (each[:n] + each[n:]) / (1.0 - np.minimum(share, _HELD))
    sums = [(1.0 - k / _REACH) * float(scores[k:] @ scores[: n - k]) for k in range(_REACH)]
    return float(np.sqrt(2.0 * sum(sums) - sums[0]))


def _real(x: Spectrum) -> Array:
    return np.concatenate([x.real, x.imag])
