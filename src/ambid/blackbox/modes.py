"""Modes from a record: common poles of all outputs by maximum likelihood on its Fourier transform, leakage included.

About a mode each output's spectrum is Y = (sum_r a_r/(jw - p_r) + P(w)) U + sum_r b_r/(jw - p_r) + Q(w) + V: poles p
are common; residues a, transients b (first and last state) and polynomials P, Q for all that is farther away are linear
(Pintelon and Schoukens 2012, sec. 6.3.2; McKelvey and Guerin 2012). A hold, a delay or a sensor changes a, P and Q, not
p. Each mode is fitted in a window of its own, with its neighbours, by variable projection (Golub and Pereyra 1973); the
noise V is what the fit leaves about each line, model errors included. `mode_starts` says where the search begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array, Complex
from ambid.blackbox.data import IOData
from ambid.blackbox.mode_starts import (
    DEGREE,
    MOST_DAMPED,
    Spectra,
    averaged_responses,
    conjugate,
    principal,
    spectra,
    starting_poles,
)
from ambid.estimation.estimate import Check
from ambid.estimation.linear import one_thread
from ambid.estimation.modes import Modal, OfPole, TrialPole, assurance, mode_of, modes_checks, student
from ambid.estimation.result import NORMAL_95
from ambid.estimation.search import Rows, search
from ambid.settings.caller import setting

_REACH = 10.0  # of a window to either side, in half bandwidths of its mode
_FEWEST = 24  # lines of a window to either side, at least
_SMOOTH = 10  # lines to either side over which what the fit leaves is averaged
_LEVERAGE = 0.9  # most that a line's own share in its fit counts
_PASSES = 8  # at most
_WHITE = 0.2  # correlation of what is left from line to line, up to which it is noise
_ALIKE, _WEAK = 0.9, 0.1  # likeness of two shapes, and size of one beside the other, that make them one mode
_SHARE, _LEAST_SHARE = 0.01, 0.001  # part of an output's energy at a mode's frequency that must be the mode's ...
_CLEAR = 10.0  # ... the less where it stands so many times out of what is left
_MISFIT, _COLOURED = 0.1, 0.5  # energy left at a mode, and its correlation from line to line, that speak of model error
_DIES = 0.5  # half bandwidth, in lines, from which a vibration dies away within the record
_DOUBLE = 0.3  # second singular value of a mode's residues over the first, from which it is two
_LOST = 0.5  # energy left from which a mode's numbers are not shown


# --- the likelihood about one mode ----------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Projected:
    """What variable projection leaves at some poles."""

    inverse: Complex  # (n_lines, n_poles + n_fixed), step/(jw - p)
    Q: Complex  # (n_outputs, n_lines, n_columns), of the weighted columns
    root: Complex  # (n_outputs, n_columns, n_columns), from the coefficients' own unit covariance
    c: Complex  # (n_outputs, n_columns)
    e: Complex  # (n_outputs, n_lines), weighted

    @property
    def leverage(self) -> Array:
        """Share of each line in its own fit, (n_outputs, n_lines)."""
        return np.asarray(np.minimum(np.sum(np.abs(self.Q) ** 2, axis=2), _LEVERAGE))

    @property
    def cost(self) -> float:
        """Sum of squares: minus the logarithm of the likelihood."""
        return float(np.sum(np.abs(self.e) ** 2))


class _Window:
    """Lines about a mode: poles that are searched, poles beside them that are known, polynomials."""

    def __init__(self, lines: Spectra, fixed: Complex) -> None:
        self.lines, self.fixed = lines, fixed
        self.variance = lines.variance
        omega = lines.omega
        x = (omega - omega.mean()) / max(np.ptp(omega) / 2, 1e-300)
        powers = x[:, None] ** np.arange(DEGREE + 1)
        self.smooth = (lines.U[:, :, None] * powers[:, None, :]).reshape(omega.size, -1)
        self._at: tuple[bytes, _Projected] | None = None

    def project(self, poles: Complex, omit: range = range(0)) -> _Projected:
        """Fit what is linear; `omit`: columns that are left out, with coefficients of zero."""
        key = poles.tobytes()
        if not omit and self._at is not None and self._at[0] == key:
            return self._at[1]
        lines = self.lines
        inverse = lines.step / (1j * lines.omega[:, None] - np.r_[poles, self.fixed])
        of_poles = (inverse[:, :, None] * lines.U[:, None, :]).reshape(lines.omega.size, -1)
        columns = np.concatenate([of_poles, self.smooth], axis=1)
        kept = np.delete(np.arange(columns.shape[1]), omit)
        columns = columns[:, kept]
        weight = 1.0 / np.sqrt(self.variance.T)
        weighted = weight[:, :, None] * columns
        size = np.maximum(np.linalg.norm(weighted, axis=1, keepdims=True), 1e-300)
        Q, R = np.linalg.qr(weighted / size)
        diagonal = np.abs(np.einsum("jaa->ja", R))
        R[np.any(diagonal < 1e-13, axis=1)] += 1e-13 * np.eye(R.shape[1])  # two poles in one place
        root = np.linalg.inv(R) / np.swapaxes(size, 1, 2)
        y = (weight * lines.Y.T)[:, :, None]
        along = conjugate(Q) @ y
        whole = np.zeros((root.shape[0], kept.size + len(omit), kept.size), dtype=np.complex128)
        whole[:, kept] = root
        projected = _Projected(inverse=inverse, Q=Q, root=whole, c=(whole @ along)[:, :, 0], e=(y - Q @ along)[:, :, 0])
        if not omit:
            self._at = key, projected
        return projected

    def slopes(self, poles: Complex) -> Complex:
        """Derivatives of the residuals by the real and the imaginary part of each pole, in steps: (2n, n_outputs,
        n_lines); the change of the projection itself has no part in the gradient (Kaufman 1975).
        """
        at, m = self.project(poles), self.lines.U.shape[1]
        weight, out = 1.0 / np.sqrt(self.variance.T), []
        for r in range(poles.size):
            d = weight * (at.c[:, r * m : (r + 1) * m] @ self.lines.U.T) * at.inverse[:, r] ** 2
            d = d - (at.Q @ (conjugate(at.Q) @ d[:, :, None]))[:, :, 0]
            out += [-d, -1j * d]
        return np.array(out)

    def search(self, poles: Complex) -> Complex:
        """Most likely poles from these on, the noise as it is."""
        start = np.ascontiguousarray(poles / self.lines.step).view(np.float64).copy()

        def residual(v: Array) -> Array:
            e = self.project(v.view(np.complex128) * self.lines.step).e.ravel()
            return np.concatenate([e.real, e.imag])

        def slope(v: Array) -> Array:
            J = self.slopes(v.view(np.complex128) * self.lines.step).reshape(v.size, -1)
            return np.concatenate([J.real, J.imag], axis=1).T

        end = search(Rows(residual, slope), start, most=25, tolerance=1e-7)
        return np.asarray(end.theta.view(np.complex128) * self.lines.step)

    def fit(self, poles: Complex, rounds: int = 2) -> Complex:
        """Most likely poles, the noise from what the fit leaves."""
        for _ in range(rounds):
            poles = self.search(poles)
            # the noise about each line is what is left there, model errors included.
            at = self.project(poles)
            power = np.abs(at.e) ** 2 * self.variance.T / (1 - at.leverage)
            self.variance = np.maximum(_averaged(power.T), 1e-14 * np.mean(np.abs(self.lines.Y) ** 2, axis=0))
            self._at = None
        return self.search(poles)

    def covariance(self, poles: Complex) -> tuple[Array, Array]:
        """Covariances (2n, 2n) of real and imaginary parts in (rad/s)²: of the likelihood, outputs whose errors go
        together counted so (sandwich), and of the (one-step) jackknife over outputs, zero with one output.
        """
        at, J = self.project(poles), self.slopes(poles)
        apart = np.real(np.einsum("ajk,bjk->jab", J.conj(), J))
        H = np.sum(apart, axis=0)
        inverse = np.linalg.pinv(H, hermitian=True)
        e = at.e / np.sqrt(1 - at.leverage)
        together = _averaged(np.einsum("jk,ik->kji", e, e.conj()))
        middle = np.real(np.einsum("ajk,kji,bik->ab", J.conj(), together, J, optimize=True)) / 2
        n_y, square = e.shape[0], self.lines.step**2
        if n_y == 1:
            return inverse @ middle @ inverse * square, np.zeros_like(H)
        score = np.real(np.einsum("ajk,jk->ja", J.conj(), at.e))
        moved = np.array([np.linalg.pinv(H - h, hermitian=True) @ g for h, g in zip(apart, score, strict=True)])
        moved -= moved.mean(axis=0)
        return inverse @ middle @ inverse * square, moved.T @ moved * ((n_y - 1) / n_y) * square


def _averaged(values: NDArray[np.inexact]) -> NDArray[np.inexact]:
    """Averages over neighbouring lines (axis 0), fewer at the ends."""
    n = values.shape[0]
    total = np.concatenate([np.zeros((1, *values.shape[1:]), dtype=values.dtype), np.cumsum(values, axis=0)])
    low, high = np.maximum(np.arange(n) - _SMOOTH, 0), np.minimum(np.arange(n) + _SMOOTH + 1, n)
    width = (high - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray((total[high] - total[low]) / width)


# --- which modes there are ------------------------------------------------------------------------------------------


@dataclass(slots=True, eq=False)
class _Candidate(OfPole):
    """A pole in its window, with what speaks for it."""

    pole: complex
    gain: float = 0.0  # of -2 log likelihood over what its numbers cost (BIC), the lesser of pole and input
    share: float = 0.0  # most of an output's energy at its frequency
    clear: float = 0.0  # its energy over what is left there, in the same output
    misfit: float = 0.0  # energy left there
    correlation: float = 0.0  # of what is left, from line to line
    shape: Complex = field(default_factory=lambda: np.zeros(0, dtype=np.complex128))
    settled: bool = False  # whether it and what is about it are as they were when it was fitted
    second: float = 0.0  # of the residues over all inputs: second singular value over the first
    shape_variance: Array = field(default_factory=lambda: np.zeros(0))
    likelihood: Array = field(default_factory=lambda: np.zeros((2, 2)))
    jackknife: Array = field(default_factory=lambda: np.zeros((2, 2)))


def _half_width(pole: complex, step: float) -> float:
    """Of a mode's window, rad/s: enough half bandwidths and lines, no more than a quarter of its frequency."""
    return max(min(_REACH * abs(pole.real), 0.25 * pole.imag), _FEWEST * step)


def _window(lines: Spectra, k: int, poles: Complex) -> tuple[_Window, Complex, int]:
    """Window of pole k: lines, the poles that are searched (pole k and those inside), and where pole k stands."""
    own, width = poles[k], _half_width(complex(poles[k]), lines.step)
    distance = np.abs(poles.imag - own.imag)
    part = lines.between((own.imag - width) / (2 * np.pi), (own.imag + width) / (2 * np.pi))
    most = max(int(part.omega.size / (2.5 * lines.U.shape[1])) - DEGREE - 1, 1)  # columns that its lines tell apart
    near = [j for j in np.argsort(distance) if distance[j] < 3 * width][:most]
    inside = [j for j in near if distance[j] < width][:5]
    outside = [j for j in near if j not in inside]
    return _Window(part, poles[outside]), poles[inside], inside.index(k)


def _refine(lines: Spectra, candidates: list[_Candidate], say: Callable[[float], None]) -> list[_Candidate]:
    """Fit each candidate that is not settled in its window, drop what is no mode, and again with what is left."""
    for turn in range(_PASSES):
        poles = np.array([c.pole for c in candidates])
        for k, c in enumerate(candidates):
            if not c.settled:
                _fit(lines, k, poles, c, judge=turn > 0)
            say((turn + (k + 1) / len(candidates)) / _PASSES)
        modes = _kept(candidates, lines, judged=turn > 0, last=turn == _PASSES - 1)
        before, candidates = len(candidates), modes
        if turn == 1:
            poles = np.array([c.pole for c in modes])
            candidates = [x for k, c in enumerate(modes) for x in _split(lines, k, poles, c)]
        if not candidates or (turn > 0 and len(candidates) == before == len(modes)):
            break
    for c in candidates:
        c.settled = True
    return candidates


def _joined(
    lines: Spectra, found: list[_Candidate], starts: Sequence[complex], step: float, say: Callable[[float], None]
) -> list[_Candidate]:
    """Modes with those that more starts lead to; `step`: rad/s up to which these cannot be told from a mode's."""
    apart = [p for p in starts if all(abs(p - c.pole) > abs(p.real) + abs(c.pole.real) + step for c in found)]
    new = _kept([_Candidate(pole=p) for p in apart], lines, judged=False)
    if not new:
        return found
    for c in found:
        c.settled = not any(_near(c, x, lines.step, 3.0) for x in new)
    return _refine(lines, sorted([*found, *new], key=lambda c: c.pole.imag), say)


def _near(one: _Candidate, other: _Candidate, step: float, widths: float = 1.0) -> bool:
    """Whether one of two poles is in the other's window."""
    reach = max(_half_width(one.pole, step), _half_width(other.pole, step))
    return abs(one.pole.imag - other.pole.imag) < widths * reach


def _split(lines: Spectra, k: int, poles: Complex, c: _Candidate) -> list[_Candidate]:
    """Two modes of different shape where one pole stands for both, else the one."""
    if c.settled or c.correlation < _WHITE:  # what one pole leaves of two is no noise
        return [c]
    window, inside, at = _window(lines, k, poles)
    n, m = lines.Y.shape[1], lines.U.shape[1]
    if n < 2 or window.lines.omega.size < 2 * (window.smooth.shape[1] + m * (inside.size + 1)):
        return [c]
    apart = 0.4j * abs(c.pole.real)
    pair = window.fit(np.r_[c.pole - apart, c.pole + apart, np.delete(inside, at)])
    two = window.project(pair)
    one = window.project(window.search(inside))
    gain = 2 * (one.cost - two.cost) - (2 + 2 * n * m) * np.log(2 * two.e.size)
    damped = np.all((pair[:2].real < 0) & (-pair[:2].real < MOST_DAMPED * np.abs(pair[:2])))
    near = np.all(np.abs(pair[:2] - c.pole) < 2 * abs(c.pole.real))
    shapes = principal(np.array([two.c[:, r * m + 1 : (r + 1) * m] for r in (0, 1)]))
    strength = np.linalg.norm(shapes, axis=1)
    alike = assurance(shapes[0].tolist(), shapes[1].tolist()) > _ALIKE or strength.min() < _WEAK * strength.max()
    if gain < 0 or alike or not (damped and near):
        return [c]
    return [_Candidate(pole=complex(p)) for p in pair[:2]]


def _fit(lines: Spectra, k: int, poles: Complex, c: _Candidate, *, judge: bool) -> None:
    """Fit pole k in its window and, where asked, see what speaks for it; `poles` is brought up to date."""
    window, inside, at = _window(lines, k, poles)
    if window.lines.omega.size < 2 * window.smooth.shape[1]:
        c.pole = complex(abs(c.pole))  # at the border of the band, too few lines: dropped as undamped
        return
    fitted = window.fit(inside)
    moved = abs(fitted[at].imag - c.pole.imag)
    c.pole = complex(fitted[at]) if moved < _half_width(c.pole, lines.step) / 2 else complex(abs(c.pole))
    poles[k] = c.pole
    if not judge or c.pole.real >= 0:
        return
    own, m = window.project(fitted), lines.U.shape[1]
    rest = np.delete(fitted, at)
    without = window.project(window.search(rest)) if rest.size else window.project(rest)
    deaf = window.project(fitted, range(at * m + 1, (at + 1) * m))
    numbers, n = own.e.size * 2, lines.Y.shape[1]
    price = np.log(numbers)
    of_input = 2 * (deaf.cost - own.cost) - 2 * n * (m - 1) * price
    # Over a few lines a sweep's spectrum can be as smooth as leakage is, which then explains as much as the input does:
    # a mode is also what the input explains alone and what dies away within the record, as no line of the mains does.
    quiet = window.project(fitted, range(at * m, at * m + 1))
    alone = 2 * (quiet.cost - own.cost) < 2 * n * price and (of_input > 0 or -c.pole.real > _DIES * lines.step)
    if alone:
        c.gain = 2 * (without.cost - quiet.cost) - (2 + 2 * n * (m - 1)) * price
        _describe(window, quiet, at, c, window.project(fitted, range(at * m, (at + 1) * m)))
    if not alone or (of_input <= 0 and c.misfit > _MISFIT):
        c.gain = min(2 * (without.cost - own.cost) - (2 + 2 * n * m) * price, of_input)
        _describe(window, own, at, c, deaf)
    likelihood, jackknife = window.covariance(fitted)
    own_two = slice(2 * at, 2 * at + 2)
    c.likelihood, c.jackknife = likelihood[own_two, own_two], jackknife[own_two, own_two]


def _describe(window: _Window, fitted: _Projected, at: int, c: _Candidate, deaf: _Projected) -> None:
    """Shape, share of the energy and what is left at the mode's frequency; `deaf`: the fit where inputs do not excite
    the mode, or it is not there, which leaves what nothing else explains.
    """
    lines, m = window.lines, window.lines.U.shape[1]
    residues = fitted.c[:, at * m : (at + 1) * m]
    near = np.abs(lines.omega - c.pole.imag) <= max(1.5 * abs(c.pole.real), 1.5 * lines.step)
    energy = np.maximum(np.sum(np.abs(lines.Y[near]) ** 2, axis=0), 1e-300)
    left, deprived = (np.sum((np.abs(x.e) ** 2 * window.variance.T)[:, near], axis=1) for x in (fitted, deaf))
    shares = np.maximum(deprived - left, 0.0) / energy
    best = int(np.argmax(shares))
    c.share, c.clear = float(shares[best]), float(shares[best] * energy[best] / max(left[best], 1e-300))
    c.misfit = float(np.sum(left / energy * shares) / max(np.sum(shares), 1e-300))
    wide = np.abs(lines.omega - c.pole.imag) <= max(4 * abs(c.pole.real), 8 * lines.step)
    e = fitted.e[:, wide]
    c.correlation = float(abs(np.sum(e[:, 1:] * e[:, :-1].conj())) / max(np.sum(np.abs(e) ** 2), 1e-300))
    c.shape = principal(residues[None, :, 1:])[0]
    strength = np.linalg.svd(residues[:, 1:], compute_uv=False)
    c.second = float(strength[1] / strength[0]) if strength.size > 1 else 0.0
    covariance = np.sum(np.abs(fitted.root) ** 2, axis=2)[:, at * m + 1 : (at + 1) * m]
    c.shape_variance = np.mean(covariance, axis=1)


def _kept(candidates: list[_Candidate], lines: Spectra, *, judged: bool, last: bool = False) -> list[_Candidate]:
    """Candidates that are modes: damped, in the band, not twice, and where judged worth their numbers and energy.

    Two that stand for one mode make each other worthless: of those in a window only the least goes, until the `last`.
    """
    low, high = lines.omega[0], lines.omega[-1]
    modes, poor = list[_Candidate](), list[_Candidate]()
    for c in sorted(candidates, key=lambda c: -c.gain if judged else abs(c.pole.real)):
        damped = c.pole.real < 0 and c.damping <= (MOST_DAMPED if judged else 2 * MOST_DAMPED)
        if damped and low <= c.pole.imag <= high and not any(_same(c, d, lines.step) for d in modes):
            modes.append(c)
    for c in reversed(modes if judged else []):
        worth = c.gain > 0 and c.share >= (_LEAST_SHARE if c.clear >= _CLEAR else _SHARE)
        if not worth and (last or not any(_near(c, d, lines.step) for d in poor)):
            poor.append(c)
    return sorted((c for c in modes if c not in poor), key=lambda c: c.pole.imag)


def _same(one: _Candidate, other: _Candidate, step: float) -> bool:
    """Whether two poles are one resonance: nearer than they are wide, and alike in shape where that is known."""
    width = abs(one.pole.real) + abs(other.pole.real)
    apart = abs(one.pole - other.pole)
    if apart < max(0.1 * width, 0.2 * step):
        return True
    if one.shape.size < 2 or other.shape.size < 2:
        return apart < (0.1 if not one.shape.size else 0.5) * width
    return apart < width and assurance(one.shape.tolist(), other.shape.tolist()) > _ALIKE


# --- the result -----------------------------------------------------------------------------------------------------


def find_modes(
    data: IOData,
    count: int | Literal["auto"] = "auto",
    *,
    band: tuple[float, float] | None = None,
    tick: Callable[[str, float], object] | None = None,
) -> Modal:
    """Estimate `count` modes ("auto", or the most significant) that inputs excite and outputs show, in a `band` in Hz,
    default where inputs have power; EstimationError where it has too few lines.
    """

    def say(stage: str, share: float) -> None:
        if tick is not None:
            tick(stage, share)

    with one_thread():
        lines = spectra(data, band)
        candidates, tried = list[_Candidate](), list[TrialPole]()
        for view in (lines, *averaged_responses(lines)):
            starts, poles = starting_poles(view, lambda x: say("modes: starts", x))
            tried += poles
            blur = 2 * (view.step - lines.step)
            candidates = _joined(lines, candidates, starts, blur, lambda x: say("modes: likelihood", x))
    if count != "auto":
        candidates = sorted(sorted(candidates, key=lambda c: -c.gain)[:count], key=lambda c: c.pole.imag)
    limits = float(lines.omega[0] / (2 * np.pi)), float(lines.omega[-1] / (2 * np.pi))
    modes = []
    for c in candidates:  # the larger of the likelihood's interval and the jackknife's over outputs
        spreads = [(c.likelihood, NORMAL_95)]
        spreads += [(c.jackknife, student(data.n_outputs - 1))] if data.n_outputs > 1 else []
        modes.append(mode_of(c.pole, spreads, data.outputs, c.shape, c.shape_variance, visible=c.misfit < _LOST))
    checks = modes_checks(tuple(modes), count, limits, f"Excite more, longer, or give {setting('band')}")
    return Modal(
        status="converged" if candidates else "failed",
        method="maximum likelihood on the record's spectrum, transients included",
        modes=tuple(modes),
        checks={**checks, "modes_fit": _fit_check(candidates), **_rank_check(candidates, data.inputs)},
        inputs=data.inputs,
        outputs=data.outputs,
        units={x: data.units[x] for x in (*data.inputs, *data.outputs)},
        band_hz=limits,
        poles=tuple(tried),
        record=data.record,
        details={
            "energy_share": [c.share for c in candidates],
            "misfit": [c.misfit for c in candidates],
            "residual_correlation": [c.correlation for c in candidates],
            "gain": [c.gain for c in candidates],
        },
    )


def _fit_check(candidates: list[_Candidate]) -> Check:
    """Whether linear modes fit the lines about them."""
    poor = [c for c in candidates if c.misfit > _LOST or (c.misfit > _MISFIT and c.correlation > _COLOURED)]
    names = ", ".join(f"{c.frequency_hz:.4g} Hz ({100 * c.misfit:.0f} %)" for c in poor)
    if not poor:
        most = 100 * max((c.misfit for c in candidates), default=0.0)
        return Check(passed=True, detail=f"at most {most:.2g} % of the energy at a mode is left")
    return Check(
        passed=False,
        detail=f"what linear modes leave of the energy at {names} is not noise: a nonlinear or drifting resonance, or "
        "two modes in one place. Excite less, or record more outputs",
    )


def _rank_check(candidates: list[_Candidate], inputs: Sequence[str]) -> dict[str, Check]:
    """Whether each mode moves in one shape whichever input excites it: two modes in one place do not."""
    if len(inputs) < 2:
        return {}
    double = ", ".join(f"{c.frequency_hz:.4g} Hz" for c in candidates if c.second > _DOUBLE)
    detail = f"two modes in one place at {double}: frequency and damping are means, the shape is the stronger one's"
    remedy = ". Excite one plane at a time"
    return {"modes_single": Check(passed=not double, detail=detail + remedy if double else "each mode has one shape")}
