"""What the law of a nonlinear bearing leaves out: the score tests of `causes`, of its linearised predictor.

How a signal shows in the innovations is had by running the predictor again with a little of it as known: an error is
taken off what a sensor logged, a force or a voltage is given. Slopes of the numbers come with the likelihood; numbers
and the other records are projected out with their whole information, also where a part of one record is looked at.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.bearing.magnet_estimate import with_fraction
from ambid.bearing.magnet_likelihood import BearingFit, Innovations, run, search, sweep, with_error
from ambid.bearing.magnet_problem import BearingProblem, BearingRecord
from ambid.estimation.predictor import busiest
from ambid.physics.sensor_errors import SensorError
from ambid.validation.cause_signals import Column, Course
from ambid.validation.causes import SETTLED, Cause, Sums, again, beside, ranked, seen, tested, to_take
from ambid.validation.physical import without_bands

_LONGEST = 20_000  # samples that are looked at, the busiest
_STEP = 1e-4  # of a signal, over the spread of its channel
_OUTPUTS = ("position", "current")
_STEPS, _TURNS = 30, 8  # iterations of a search that begins at a fit, and searches by turns with sizes
_CLOSE = 1e-9  # its damping
_LAW = "law"  # what powers of the motion say of a law


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BearingLook:
    """Innovations of a record of a moving rotor, or of its busiest part, with slopes."""

    fit: BearingFit
    problem: BearingProblem  # of the samples that are looked at alone
    vector: Array
    base: Innovations
    white: Array  # (n, 2), of unit variance
    slopes: Array  # (n, 2, size), by the whole vector of the fit
    # (size + 1, size + 1), products of the rows [J, r] of the rest: priors, other samples and records
    rest: Array
    course: Course
    spread: Mapping[str, float]  # of each channel, SI

    def through(self, columns: Sequence[Column]) -> Array:
        """Return what signals of size one do to the innovations, (2, n_columns, n)."""
        with ThreadPoolExecutor(max_workers=os.cpu_count()) as threads:  # the kernel leaves Python's lock
            moved = list(threads.map(self._through, columns))
        return np.stack(moved, axis=1)

    def _through(self, column: Column) -> Array:
        size = _STEP * min(self.spread[where] / max(float(np.abs(s).max()), 1e-300) for where, s in column)
        return self._slope(_knowing(self.problem, self.vector, [column], np.array([size])), size)

    def _slope(self, changed: BearingProblem, size: float) -> Array:
        after = run(changed, self.vector, 0)
        if after is None:
            return np.zeros((2, len(self.white)))
        return np.nan_to_num((after.e - self.base.e) / (size * np.sqrt(self.base.s))).T

    def ways(self, which: slice) -> dict[str, Complex]:
        """Return how a force, a voltage or an error of a sensor shows at some frequencies, (n_lines, n_outputs): the
        spectrum of an impulse's way from the middle of what is looked at.
        """
        n = len(self.white)
        impulse = np.zeros(n)
        impulse[n // 2] = 1.0
        ways = self.through([((where, impulse),) for where in self.course.channels])
        lines = np.fft.rfft(ways, axis=2)[:, :, 2 : (n + 1) // 2][:, :, which]
        return {where: lines[:, j].T for j, where in enumerate(self.course.channels)}

    def tested(self, groups: Sequence[tuple[str, tuple[Column, ...]]]) -> list[Cause]:
        """Test groups of signals, each together."""
        problem, sums = self.fit.problem, self.sums(self.through([z for _, columns in groups for z in columns]))
        return tested(sums, groups, _kept(problem), problem.chain(self.fit.vector))

    def known(self) -> list[Cause]:
        """Test the rate and each fixed value."""
        problem, whole = self.problem, self.fit.problem
        fixed = {n.name: n.value for n in problem.numbers if not n.estimated and n.value}
        sizes = {"time": 1.0} | {n: fixed[n] for n in ("m", "R", *problem.law.names) if n in fixed}
        ways = list[Array]()
        for name, value in sizes.items():
            error = SensorError(kind="gain" if name == "time" else "fixed", channel=name)
            ways.append(self._slope(with_error(problem, error, _STEP * value), _STEP * value))
        names = ["rate" if name == "time" else "fixed_value" for name in sizes]
        groups = [(cause, (((name, np.zeros(0)),),)) for cause, name in zip(names, sizes, strict=True)]
        found = tested(self.sums(np.stack(ways, axis=1)), groups, _kept(whole), whole.chain(self.fit.vector))
        return [replace(c, far=abs(c.size) > abs(x)) for c, x in zip(found, sizes.values(), strict=True)]

    def sums(self, C: Array) -> Sums:
        """Return the scalar products of slopes, innovations and what signals do to them, (2, n_columns, n)."""
        own, pull = self.rest[:-1, :-1], self.rest[:-1, -1]
        return Sums(
            own=own + np.einsum("noj,nok->jk", self.slopes, self.slopes, optimize=True),
            cross=np.einsum("noj,okn->jk", self.slopes, C, optimize=True),
            pull=pull + np.einsum("noj,no->j", self.slopes, self.white),
            along=np.einsum("okn,no->k", C, self.white), inner=np.einsum("okn,oln->kl", C, C, optimize=True),
            square=float(np.mean(self.white**2)),
        )  # fmt: skip

    def bands(self) -> Array:
        """Return how far numbers move where two octaves of what is looked at are left out, (n_bands, n), SI."""
        problem, kept = self.fit.problem, np.append(_kept(self.fit.problem), True)
        rows = np.concatenate([self.slopes, self.white[:, :, None]], axis=2)[:, :, kept]
        return without_bands(rows, self.rest[np.ix_(kept, kept)], problem.chain(self.fit.vector))


def _knowing(problem: BearingProblem, vector: Array, columns: Sequence[Column], sizes: Array) -> BearingProblem:
    """Return a problem of one record in which signals of some sizes are known."""
    (record,) = problem.records
    whole, m = int(np.floor(problem.delay_at(vector, record.rate_hz))), problem.values(vector)["m"]
    u, y = record.u.copy(), record.y.copy()
    push = np.zeros(u.size) if record.push is None else record.push.copy()
    for column, size in zip(columns, sizes.tolist(), strict=True):
        for where, signal in column:
            if where == "force":
                push += size / m * signal
            elif where == "voltage":
                u[: u.size - whole] += size * signal[whole:]
            else:
                y[:, _OUTPUTS.index(where)] -= size * signal
    return replace(problem, records=(replace(record, u=u, y=y, push=push),))


def _kept(problem: BearingProblem) -> NDArray[np.bool_]:
    """Return which of a vector are no levels of noise."""
    at = np.arange(problem.size)
    return np.asarray((at < problem.noise_slices[0].start) | (at >= problem.noise_slices[-1].stop))


def bearing_look(fit: BearingFit, r: int) -> BearingLook | None:
    """Return the innovations of record number `r`, of a rotor that moves, with their slopes; None without a predictor
    over the part of it that is looked at.
    """
    whole, n_kept = fit.problem, fit.problem.noise_slices[0].start
    at, moving = busiest(whole.records[r].u[:, None], _LONGEST), (k for k, x in enumerate(whole.records) if not x.held)
    record = whole.records[r].part(at)
    record = replace(record, later=at.start > 0 or r != next(moving), zero=None)
    problem = replace(whole, records=(record,), noise_center=whole.noise_center[[r]])
    vector = np.concatenate([fit.vector[:n_kept], fit.vector[whole.noise_slices[r]]])
    base = Innovations.of(record.u.size)
    assert fit.at is not None
    slopes, rows = np.zeros((record.u.size, 2, whole.size)), np.column_stack([fit.at.J, fit.at.r])
    rest = rows.T @ rows
    for part in sweep(problem, vector, 0, base, slopes=True):
        if part is None:
            return None
        of = part.columns < n_kept
        slopes[part.first : part.first + len(part.rows), :, part.columns[of]] = part.rows[:, [0, 2], :-1][:, :, of]
        rows = part.rows[:, :, np.append(of, True)].reshape(-1, int(of.sum()) + 1)
        rest[np.ix_(*(np.append(part.columns[of], whole.size),) * 2)] -= rows.T @ rows
    white = np.nan_to_num(base.e / np.sqrt(base.s))
    course = _course(problem, vector, base)
    spread = {"force": abs(course.theta["k_i"]) * float(course.i.std()), "voltage": float(course.u.std())}
    spread |= {"position": float(course.x.std()), "current": float(course.i.std())}
    return BearingLook(
        fit=fit,
        problem=problem,
        vector=vector,
        base=base,
        white=white,
        slopes=slopes,
        rest=rest,
        course=course,
        spread=spread,
    )


def _course(problem: BearingProblem, vector: Array, base: Innovations) -> Course:
    record, values = problem.records[0], problem.values(vector)
    known = ~np.isnan(base.ahead[:, 0])
    mean = base.ahead[known].mean(axis=0)
    x, v, i = np.where(known[:, None], base.ahead - mean, 0.0).T
    table = problem.law.table(mean[:1], mean[2:], values)[0][0]
    whole, late = (f(problem.delay_at(vector, record.rate_hz)) for f in (lambda d: int(np.floor(d)), lambda d: d % 1.0))
    raw = record.u[np.maximum(np.arange(-whole - 2, record.u.size - whole), 0)] - record.u.mean()
    held = raw[1:] + late * (raw[:-1] - raw[1:])  # mean from each sample to the next, from one before on
    return Course(
        t=np.linspace(-1.0, 1.0, x.size), x=x, v=v, i=i, u=held[1:], u_before=held[:-1],
        before=np.diff(i, prepend=i[0]) * record.rate_hz,
        theta={"k_i": float(table[2]), "L": float(table[3]), "m": values["m"], "R": values["R"]},
        i0=float(mean[2]), rate_hz=record.rate_hz, channels=("force", "voltage", *_OUTPUTS),
    )  # fmt: skip


def bearing_causes(look: BearingLook, *, thorough: bool, delay_given: bool) -> list[Cause]:
    """Return the causes that the innovations may have, the strongest first; see `causes.causes`."""
    found = seen(look, thorough=thorough, delay_given=delay_given)
    return ranked([*(replace(c, name=_LAW) if c.name == "curvature" else c for c in found), *look.known()])


def extended_bearing(
    fit: BearingFit, found: Sequence[Cause], plain: BearingRecord, taken: Sequence[Cause], *, delay_given: bool
) -> tuple[BearingFit, tuple[Cause, ...]] | None:
    """Fit again with the strongest cause of those `found` in the one record, and those about as strong, their sizes
    estimated beside the numbers; see `causes.extended`. `plain`, `taken`: the record without any cause, and those that
    `fit` holds already. None where one cannot be taken in, or the search does not settle.
    """
    if len(fit.problem.records) > 1 or plain.u.size > _LONGEST:
        return None
    new = to_take(found, doubtful=True)  # a fixed value may be what is wrong, and is not asked
    parts = [*taken, *(replace(c, sizes=np.zeros(c.sizes.size)) for c in new)]
    step = [np.zeros(c.sizes.size) for c in taken] + [c.sizes * (k == 0) for k, c in enumerate(new)]
    for _ in range(_TURNS if new else 0):
        parts = [replace(c, sizes=c.sizes + more) for c, more in zip(parts, step, strict=True)]
        columns, sizes = [z for c in parts for z in c.columns], np.concatenate([c.sizes for c in parts])
        known = _knowing(replace(fit.problem, records=(plain,)), fit.vector, columns, sizes)
        fit = search(known, fit.vector, iterations=_STEPS, damping=_CLOSE)
        if fit.status == "stalled" and not delay_given:  # a fraction of a delay that stood for the cause is whole now
            fit = with_fraction(fit)
        look = None if fit.status == "failed" else bearing_look(fit, 0)
        if look is None:
            return None
        parts = [replace(c, columns=again(c, look.course)) for c in parts]
        columns = [z for c in parts for z in c.columns]
        left = look.tested([("", tuple(columns))])[0]
        step = np.split(left.sizes, np.cumsum([c.sizes.size for c in parts])[:-1])
        if left.gain < SETTLED and fit.status == "converged":
            n = len(fit.problem.estimated)
            return replace(fit, beside=beside(look.sums(look.through(columns)), n)), tuple(parts)
    return None
