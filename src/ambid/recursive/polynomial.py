"""Recursive prediction error method for A y = (B/F) u + (C/D) e + constant (Ljung & Söderström 1983, ch. 3):
Gauss-Newton steps theta += P psi e in U-D form, psi exact (thesis eq. 3.12 ff.), begun by a window that is fitted
off-line.
"""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.blackbox.data import IOData, Orders
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.fit import structure as structure_named
from ambid.blackbox.model import PolynomialModel
from ambid.blackbox.polynomial import polynomial_fit
from ambid.blackbox.polynomial_predictor import (
    coefficient_units,
    compact_orders,
    predictor,
    read_orders,
    scale_data,
)
from ambid.blackbox.polynomial_search import search
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, as_blocks, kernels
from ambid.recursive.polynomial_state import (
    COUNTED,
    Identity,
    State,
    covariance_of_state,
    identity_of,
    noise_variance_of,
    state_from_fit,
)

_USED, _REJECTED, _WAITED, _PROJECTED, _HELD = COUNTED
_REFITTED = 16  # first windows
_MOST = 20  # evaluations of a fit that begins near its end
_WORSE = 1.5  # growth, or fall to one over it, of the innovations' standard deviation that is told
_FEW = 20  # samples of memory for each coefficient, below which gradients of C, D and F mislead
_NUMBERS = (float, np.float64)


class RecursivePolynomial(Copied):
    """Recursive prediction error estimator of one output, an `ambid.recursive.RecursiveEstimator`: any structure of
    thesis table 3.1, any number of inputs.

    The covariance is that of the error of the estimate if the coefficients stand still and the structure holds the
    noise, whatever is forgotten; the lag behind coefficients that move is not in it. `fir` and `oe` have no noise
    model: they are biased under feedback, and `warnings` says so unless `open_loop` is given. ARMAX, BJ and the others
    are consistent under feedback as long as their noise model holds the true one. An unstable plant needs A (arx,
    armax, ararmax): C and F have to be stable, and are kept so; A and D need not be.

    A root of C or F near the border means a long memory: after a start without `prime`, and after every gap, nothing is
    learnt until the unknown states of the filters have died away (`counts`). Where no search of the largest first
    window converged, `fit` says "stalled" and standard deviations are as large as the coefficients, until a later one
    does.

    Parameters
    ----------
    structure : str
        ``fir arx armax arma ararx ararmax oe bj``.
    orders : Mapping[str, int or tuple of int]
        na, nb, nc, nd, nf as the structure takes them, and nk, which has to be given; nb, nf and nk one number, or one
        for each input.
    dt : float
        Sampling interval, s.
    n_inputs : int or None, optional
        One, or none for a time series, unless said otherwise.
    forgetting : float, optional
        Weight of the last sample beside the present one; 1 forgets nothing. Below 20 samples of memory for each
        coefficient `warnings` tells of C, D and F.
    burn_in : int or None, optional
        Samples of the first window; None: 100 for each coefficient, at least 500. Up to 16 times as many, or up to the
        memory, are stored and fitted again at every doubling: then one `update` takes some ms.
    open_loop : bool, optional
        Say that no feedback is at work.

    Raises
    ------
    EstimationError
        If the structure is not known, or an order is missing, not known or out of range.
    """

    _window: _Window | None
    _arrays: tuple[Any, ...]

    def __init__(
        self,
        structure: str,
        orders: Orders,
        *,
        dt: float = 1.0,
        n_inputs: int | None = None,
        forgetting: float = 1.0,
        burn_in: int | None = None,
        open_loop: bool = False,
    ) -> None:
        found = structure_named(structure)
        if not found.prediction_error:
            raise EstimationError(f"{structure} is not a polynomial structure. Use armax, oe or bj")
        n_u = int(found.inputs) if n_inputs is None else n_inputs
        u, y = np.zeros((1, n_u)), np.zeros((1, 1))
        inputs = tuple(f"u{i}" for i in range(n_u)) if n_u != 1 else ("u",)
        units = dict.fromkeys((*inputs, "y"), "1")
        data = IOData(u=u, y=y, dt=dt, inputs=inputs, outputs=("y",), units=units)
        layout, free_delay = read_orders(structure, data, orders)
        if free_delay:
            raise EstimationError(
                f"{structure}: nk is missing; a delay is not searched on-line. Give nk=1, for example"
            )
        who = Identity(structure=structure, layout=layout, dt=dt, inputs=inputs, outputs=("y",), units=units)
        self._prepare(who, forgetting, open_loop=open_loop)
        need = 10 * (layout.n_theta + layout.first_row)
        first = max(500, 100 * layout.free.size) if burn_in is None else burn_in
        if first < need:
            raise EstimationError(f"{structure}: burn_in = {first} samples; at least {need} are needed. Raise it")
        self._window = _Window(first=first, last=first * _REFITTED, n_inputs=n_u)

    @classmethod
    def from_fit(
        cls,
        fit: BlackBoxFit,
        *,
        forgetting: float = 1.0,
        samples: int | None = None,
        open_loop: bool = False,
    ) -> Self:
        """Begin with what an off-line fit knows: its coefficients, weighed by its covariance, and its noise.

        Parameters
        ----------
        fit : BlackBoxFit
            Of a polynomial structure, one output. Its record and the samples to come must not overlap.
        forgetting : float, optional
        samples : int or None, optional
            How many samples `fit` saw, where those to come stand at the same operating point: its offsets and noise
            then count so much. None: both are learnt again.
        open_loop : bool, optional
            Say that no feedback is at work.

        Returns
        -------
        RecursivePolynomial

        Raises
        ------
        EstimationError
            If the fit is none of one output, or has no covariance.
        """
        made = cls.__new__(cls)
        made._prepare(identity_of(fit), forgetting, open_loop=open_loop)
        made._begin(fit, samples)
        return made

    def _prepare(self, who: Identity, forgetting: float, *, open_loop: bool) -> None:
        if not 0.0 < forgetting <= 1.0:
            raise EstimationError(f"forgetting is {forgetting}; it must be above 0 and at most 1. Correct it")
        self._who, self._open_loop, self._forgetting = who, open_loop, float(forgetting)
        self._memory = 1.0 / (1.0 - forgetting) if forgetting < 1.0 else float("inf")
        model = PolynomialModel(outputs=(who.layout.polynomials(who.layout.start()),), dt=who.dt)
        self._names = tuple(model.names[k] for k in who.layout.free)
        self._n_u = who.layout.n_inputs
        self._window = None
        self._state: State | None = None
        self._arrays = ()
        self._one = (np.zeros((1, self._n_u)), np.zeros(1), np.zeros(1))
        self._start: Array = who.layout.start()
        self._doubtful = False
        self._rejected_before = self._used_before = self._failed_starts = 0

    def _begin(self, fit: BlackBoxFit, samples: int | None) -> State:
        self._start, self._doubtful = fit.model.theta, fit.status != "converged"
        state = state_from_fit(fit, self._who.layout, self._forgetting, samples=samples)
        self._state, self._arrays = state, state.arrays()
        return state

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the estimated coefficients, as `PolynomialModel.names` has them."""
        return self._names

    @property
    def estimate(self) -> Array:
        """Coefficients in the units of the signals, shape (p,); zeros until the first window is full."""
        n = len(self._names)
        return np.zeros(n) if self._state is None else self._state.at[:n].copy()

    @property
    def covariance(self) -> Array:
        """Of the error of `estimate`, shape (p, p); huge until the first window is full, large where it stalled."""
        n = len(self._names)
        state = self._state
        return 1e12 * np.eye(n) if state is None else covariance_of_state(state, doubtful=self._doubtful)[:n, :n].copy()

    @property
    def sd(self) -> Array:
        """Standard deviations of `estimate`, shape (p,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def noise_variance(self) -> float:
        """Variance of the innovations e; NaN until the first window is full."""
        return float("nan") if self._state is None else noise_variance_of(self._state)

    @property
    def started(self) -> bool:
        """Whether there is an estimate."""
        return self._state is not None

    @property
    def n_used(self) -> int:
        """Samples that were taken in, as information or as history."""
        stored = self._window.filled if self._window is not None and self._state is None else 0
        return self._used_before + self._count(_USED) + stored

    @property
    def n_rejected(self) -> int:
        """Samples that held a number that is not finite."""
        return self._rejected_before + self._count(_REJECTED)

    @property
    def counts(self) -> dict[str, int]:
        """How often something happened, in samples.

        ``waited``: they were history alone, while the states of the filters were not known; ``projected``: the filters
        stopped short of the estimate to keep C and F stable; ``held``: nothing was forgotten, because a coefficient
        would have become as vague as it is large; ``failed_starts``: first windows without an estimate.
        """
        kept = {"waited": _WAITED, "projected": _PROJECTED, "held": _HELD}
        return {**{name: self._count(k) for name, k in kept.items()}, "failed_starts": self._failed_starts}

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader of the estimate has to know."""
        name, state, notes = self._who.structure, self._state, list[str]()
        if state is None:
            notes.append(f"{name}: the first window is not full: there is no estimate yet")
        if self._doubtful:
            notes.append(
                f"{name}: the search for the first estimate did not converge: coefficients may be wrong by their own "
                "size, which the standard deviations include. Lower the orders, or start from a fit that converged"
            )
        x = self._who.layout
        least = _FEW * (x.free.size + 1)
        if self._memory < least and (x.nc or x.nd or any(x.nf)):
            notes.append(
                f"{name}: a memory of {self._memory:.3g} samples is short for {x.free.size} coefficients and a "
                "constant: the estimate may stick at the stability limit after a standstill, and standard deviations "
                f"are too small. Use a memory of {least} samples or more, or arx"
            )
        if structure_named(name).feedback == "biased" and not self._open_loop:
            notes.append(f"{name} is biased by feedback: use bj or armax, or give open_loop if there is no feedback")
        if state is None:
            return tuple(notes)
        if state.at_border:
            notes.append(
                f"{name}: the data often require an unstable C or F; stable coefficients are shown, and their standard "
                "deviations are unreliable. If the plant integrates or is unstable, use armax or arx"
            )
        if state.worse > _WORSE:
            notes.append(
                f"{name}: prediction errors are {state.worse:.2g} times those at the start: the noise has grown, or "
                "the structure no longer fits. Raise the orders, or forget faster"
            )
        if state.worse < 1.0 / _WORSE:
            notes.append(
                f"{name}: prediction errors are {state.worse:.2g} times those at the start: the noise has fallen, or "
                "the signals are constant; without forgetting, standard deviations are then too small. Check the "
                "signals"
            )
        if state.waits:
            notes.append(f"{name}: learning is suspended: the filters need history after the start or a gap")
        return tuple(notes)

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """As `RecursiveEstimator.update`, of one output; inputs of a time series are ignored, errors NaN during
        history.
        """
        if type(outputs) in _NUMBERS and type(inputs) in _NUMBERS and self._window is None and self._n_u == 1:
            u, y, e = self._one  # the way of a loop that lives: no checks, no new arrays
            u[0, 0], y[0] = inputs, outputs
            self._run(u, y, e)
            return np.array(e[0])
        return self._take(inputs, outputs, learn=True)

    def prime(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Let samples that were used before fill the memory of the filters, and learn nothing from them.

        A fit that goes on where its record ended so loses no sample to the start of the filters.

        Parameters
        ----------
        inputs : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
        outputs : array_like, shape () or (n_samples,) or (n_samples, 1)

        Returns
        -------
        ndarray, shape of `outputs`
            Errors of prediction with the present coefficients.

        Raises
        ------
        EstimationError
            If the shapes do not fit, or there is no estimate yet.
        """
        if self._state is None:
            raise EstimationError(f"{self._who.structure}: no estimate yet; only one can be primed. Use from_fit")
        return self._take(inputs, outputs, learn=False)

    def _take(self, inputs: ArrayLike, outputs: ArrayLike, *, learn: bool) -> Array:
        given = np.zeros((np.size(outputs), 0)) if not self._n_u and inputs is None else inputs
        u, v, shape = as_blocks(self._who.structure, given, outputs, self._n_u)
        y = v[:, 0]
        errors, first = np.full(y.size, np.nan), 0
        if self._window is not None:
            first = self._with_window(self._window, u, y, errors)
        if first < y.size:
            self._run(u[first:], y[first:], errors[first:], learn=learn)
        return errors.reshape(shape)

    def _run(self, u: Array, y: Array, errors: Array, *, learn: bool = True) -> None:
        kernels("polynomial").run(u, y, errors, learn, self._arrays)

    def _with_window(self, window: _Window, u: Array, y: Array, errors: Array) -> int:
        """Store samples and fit them at fixed counts; return how many of the block were dealt with."""
        at = 0
        while self._window is not None and at < y.size:
            n, gap = window.take(u[at:], y[at:])
            if self._state is not None and n:
                self._run(u[at : at + n], y[at : at + n], errors[at : at + n])
            at += n
            if gap and self._state is not None and not self._doubtful:
                self._window = None  # the recursion goes on alone
            elif gap:
                n = window.clear()
                if self._state is None:
                    self._used_before, self._rejected_before = self._used_before + n, self._rejected_before + 1
                else:
                    self._run(u[at : at + 1], y[at : at + 1], errors[at : at + 1])
                at += 1
            elif window.filled == window.target:
                self._fit_window(window)
        return at

    def _fit_window(self, window: _Window) -> None:
        """Begin, or go on, from an off-line fit of all samples so far."""
        before, n = self._state, window.filled
        lost = before is None or self._doubtful
        fit = window.fit(self._who, None if lost else self.model.theta, stalled=before is None)
        if fit is not None:
            now = self._begin(fit, n)
            self._run(window.u[:n], window.y[:n], np.empty(n), learn=False)
            now.count[list(COUNTED)] = [n, 0, 0, 0, 0] if before is None else before.count[list(COUNTED)]
        self._failed_starts += fit is None and before is None
        grown, none = window.grow(), self._state is None
        if none or self._doubtful:  # a later window may do better
            self._used_before += (0 if grown else window.drop_half()) * none
        elif not (grown and window.target <= self._memory):
            self._window = None  # later samples would count more than these

    def _count(self, k: int) -> int:
        return 0 if self._state is None else int(self._state.count[k])

    @property
    def model(self) -> PolynomialModel:
        """The estimate as a model: poles, frequency response and the rest."""
        full = self._start.copy()
        full[self._who.layout.free] = self.estimate
        return PolynomialModel(outputs=(self._who.layout.polynomials(full),), dt=self._who.dt)


class _Window:
    """Samples `u` (last, n_inputs), `y` (last,) without a gap, `filled` of them, and the counts at which they are
    fitted: at `first`, at most at `last`, next at `target`.
    """

    def __init__(self, *, first: int, last: int, n_inputs: int) -> None:
        self.u, self.y = np.zeros((last, n_inputs)), np.zeros(last)
        self.first, self.filled, self.target = first, 0, first

    def take(self, u: Array, y: Array) -> tuple[int, bool]:
        """Take samples until the next fit, or up to and without one that is not finite; return how many, and whether
        the next is not finite.
        """
        n = min(y.size, self.target - self.filled)
        bad = np.flatnonzero(~(np.isfinite(y[:n]) & np.all(np.isfinite(u[:n]), axis=1)))
        gap = bad.size > 0
        n = int(bad[0]) if gap else n
        at = slice(self.filled, self.filled + n)
        self.u[at], self.y[at] = u[:n], y[:n]
        self.filled += n
        return n, gap

    def clear(self) -> int:
        """Begin again; return how many samples were stored."""
        n, self.filled, self.target = self.filled, 0, self.first
        return n

    def grow(self) -> bool:
        """Move the next fit to twice as many samples; False where the window is at its largest."""
        at_end = self.target >= self.y.size
        self.target = min(2 * self.target, self.y.size)
        return not at_end

    def drop_half(self) -> int:
        """Make room for as many samples as half of those stored. Returns how many were dropped."""
        n = (self.filled + 1) // 2
        keep = self.filled - n
        self.u[:keep], self.y[:keep] = self.u[n : self.filled].copy(), self.y[n : self.filled].copy()
        self.filled = keep
        return n

    def fit(self, who: Identity, near: Array | None, *, stalled: bool) -> BlackBoxFit | None:
        """Return the off-line fit of the window, from coefficients `near` (n_theta,) or its own start; None where it
        does not hold what it needs, or the search did not converge and more samples may help.
        """
        try:
            data = IOData(
                u=self.u[: self.filled],
                y=self.y[: self.filled, None],
                dt=who.dt,
                inputs=who.inputs,
                outputs=who.outputs,
                units=who.units,
                open_loop=True,  # whether it is, is no question of the coefficients
            )
            if near is None:
                fit = structure_named(who.structure).estimator(data, compact_orders(who.structure, who.layout))
            else:
                scaled = scale_data(who.structure, data)
                start = near / coefficient_units(who.layout, scaled, 0)
                path = search(predictor(who.layout), scaled.y[0], scaled.u, start, most=_MOST)
                fit = polynomial_fit(who.structure, data, scaled, [who.layout], [path], estimated_delay=False)
        except EstimationError:
            return None
        last_resort = stalled and self.filled == self.y.size
        usable = fit.status == "converged" or last_resort
        return fit if usable and float(fit.noise_covariance[0, 0]) > 0.0 else None
