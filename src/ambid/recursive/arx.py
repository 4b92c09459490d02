"""ARX models estimated as their signals come: by any recursion on regressors, or by instrumental variables.

A(q) y = B(q) u + constant + v, φ(t) = [-y(t-1) ... -y(t-na), u(t-nk) ... u(t-nk-nb+1), 1] (Ljung 1999, eq. 4.7). Least
squares needs white v; instruments leave v free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.recursive.estimator import Copied, RecursiveEstimator, as_blocks, kernels
from ambid.recursive.regression import RecursiveInstrumentalVariables

Instruments = Literal["reference", "auxiliary model"]

_REFRESH = 64  # samples with one auxiliary model
_NO_MODEL = np.zeros(0)


class _OnSignals(Copied):
    """Names, estimate and counts are those of the estimator that is fed with regressors."""

    _estimator: RecursiveEstimator

    @property
    def names(self) -> tuple[str, ...]:
        """The coefficients."""
        return self._estimator.names

    @property
    def estimate(self) -> Array:
        """A copy, shape (p,)."""
        return self._estimator.estimate

    @property
    def covariance(self) -> Array:
        """A copy, shape (p, p)."""
        return self._estimator.covariance

    @property
    def n_used(self) -> int:
        """Samples that were used."""
        return self._estimator.n_used

    @property
    def n_rejected(self) -> int:
        """Samples that were not: not finite, or in need of past signals that are unknown."""
        return self._estimator.n_rejected


class RecursiveArx(_OnSignals):
    """A recursion on regressors, fed with signals: a `RecursiveEstimator` of an ARX model.

    Biased where v is coloured, and under feedback with noise that is not white: see `RecursiveIvArx`.

    Parameters
    ----------
    na : int
        Past outputs.
    nb, nk : int or sequence of int
        Coefficients and delay of each input; a single delay is for all.
    offset : bool
        Whether a constant is estimated.
    estimator : callable
        Makes the recursion from the names of the coefficients, as ``RecursiveLeastSquares`` does.

    Attributes
    ----------
    names : tuple of str
        ``a1``, ...; ``b1``, ... by their lag (``b1.0`` for the first of several inputs); ``offset``.
    estimate : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
    n_used, n_rejected : int

    Raises
    ------
    EstimationError
        If an order is negative.
    """

    def __init__(
        self,
        na: int,
        nb: int | Sequence[int],
        nk: int | Sequence[int] = 1,
        *,
        offset: bool = False,
        estimator: Callable[[tuple[str, ...]], RecursiveEstimator],
    ) -> None:
        orders = [nb] if isinstance(nb, int) else list(nb)
        delays = [nk] * len(orders) if isinstance(nk, int) else list(nk)
        columns, names = columns_of(na, orders, delays, offset=offset)
        self._n_inputs = len(orders)
        self._lines = DelayLines(columns, 1 + self._n_inputs)
        self._estimator = estimator(tuple(names))

    def update(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        u : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
            A number, or (n_samples,), where there is one input.
        y : array_like, shape (), or (n_samples,) or (n_samples, 1) for a block

        Returns
        -------
        ndarray, shape of `y`
            Errors of prediction one sample ahead; NaN where the sample was rejected.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        x, outputs, shape = _signals(u, y, self._n_inputs)
        return self._estimator.update(self._lines.rows(x), outputs).reshape(shape)


class RecursiveIvArx(_OnSignals):
    """An ARX model by recursive instrumental variables, a `RecursiveEstimator`; v may be coloured.

    Instruments:

    - ``"reference"``: past values of an external signal r, the last input column, that enters the loop. Consistent
      under feedback.
    - ``"auxiliary model"``: past inputs and outputs of the model without noise, with the estimate of up to 64 samples
      ago while it is stable. Near the best in **open loop; biased under feedback** with coloured v, because then u
      itself holds v. Before the first stable estimate the model is a delay: the instruments are past inputs.

    Parameters
    ----------
    na, nb, nk : int
        One input: orders and delay.
    instruments : {"reference", "auxiliary model"}
    offset : bool
        Whether a constant is estimated; it is its own instrument.
    open_loop : bool
        Declare the loop open: the auxiliary model needs that, and `warnings` tells it.
    n_instruments : int, optional
        Past values of the reference, na + nb or more; na + nb + 2 if not given.
    **settings : object
        Of `RecursiveInstrumentalVariables`.

    Attributes
    ----------
    names : tuple of str
    estimate : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
    n_used, n_rejected : int
    warnings : tuple of str

    Raises
    ------
    EstimationError
        If a setting is out of its range.
    """

    _estimator: RecursiveInstrumentalVariables

    def __init__(
        self,
        na: int,
        nb: int,
        nk: int = 1,
        *,
        instruments: Instruments,
        offset: bool = False,
        open_loop: bool = False,
        n_instruments: int | None = None,
        **settings: Any,
    ) -> None:
        columns, names = columns_of(na, [nb], [nk], offset=offset)
        p = len(columns)
        n = na + nb + 2 if n_instruments is None else n_instruments
        if instruments == "reference":
            more = [(2, lag, 1) for lag in range(1, 1 + n)]
        elif instruments == "auxiliary model":
            more = [(2, lag, -1) for lag in range(1, na + 1)] + columns[na : na + nb]
        else:
            raise EstimationError(f"instruments is {instruments!r}; it is reference or auxiliary model")
        more += columns[na + nb :]
        self._kind, self._na, self._nb, self._p, self._open_loop = instruments, na, nb, p, open_loop
        self._n_inputs = 2 if instruments == "reference" else 1
        self._lines = DelayLines([*columns, *more], 3)
        self._estimator = RecursiveInstrumentalVariables(names, n_instruments=len(more), **settings)
        self._model, self._count = np.zeros(p), 0
        self._modelled = nb == 0
        if nb:  # a model without output would leave the first a to the prior alone, and never be replaced
            self._model[na + nb - 1] = 1.0
        if instruments == "auxiliary model":
            self._lines.silence(2)

    def update(self, u: ArrayLike, y: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        u : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
            The input, and the reference where it is the instrument; a number, or (n_samples,), for the input alone.
        y : array_like, shape (), or (n_samples,) or (n_samples, 1) for a block

        Returns
        -------
        ndarray, shape of `y`
            Errors of prediction one sample ahead; NaN where the sample was rejected.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        x, outputs, shape = _signals(u, y, self._n_inputs, spare=1 if self._kind == "auxiliary model" else 0)
        if self._kind != "auxiliary model":
            return self._estimator.update(self._lines.rows(x), outputs).reshape(shape)
        errors, start = np.empty(outputs.size), 0
        while start < outputs.size:
            stop = min(outputs.size, start + _REFRESH - self._count % _REFRESH)
            rows = self._lines.rows(x[start:stop], self._model, self._p)
            errors[start:stop] = self._estimator.update(rows, outputs[start:stop])
            self._count += stop - start
            if self._count % _REFRESH == 0:
                self._renew()
            start = stop
        return errors.reshape(shape)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a reader of the estimate has to know."""
        if self._kind == "reference" or self._open_loop:
            return ()
        return (
            f"instruments are made of the input ({self._kind}): biased by feedback. Use the reference of the loop, "
            "or give open_loop if there is no feedback",
        )

    def _renew(self) -> None:
        """Take over the estimate as auxiliary model if it is stable."""
        theta = self._estimator.estimate
        A = np.concatenate([[1.0], theta[: self._na]])
        if np.all(np.abs(np.roots(A)) < 1):
            if not self._modelled:  # the delay was of the input's unit: what it gave has to count as the output's does
                gain = _gain(A, theta[self._na : self._na + self._nb])
                self._estimator.scale_instruments(self._na, gain)
                self._lines.scale(2, gain)
            self._model, self._modelled = theta, True


def _gain(A: Array, B: Array) -> float:
    """Rms of B/A times white noise over that of the noise; 1 where it is nothing."""
    from scipy.signal import lfilter

    impulse = np.zeros(1000)
    impulse[0] = 1.0
    size = float(np.sqrt(np.sum(lfilter(B, A, impulse) ** 2)))
    return size if 0 < size < np.inf else 1.0


class DelayLines:
    """Columns of delayed channels, compiled.

    `columns`: channel -1 is the constant 1.
    """

    def __init__(self, columns: Sequence[tuple[int, int, int]], n_channels: int) -> None:
        self._table = np.array(columns, dtype=np.int64).reshape(-1, 3)
        self._past = np.full((max(1, int(self._table[:, 1].max())), n_channels), np.nan)

    def rows(self, x: Array, theta: Array = _NO_MODEL, first: int = 0) -> Array:
        """Return the columns for the next samples.

        `x`: (n_samples, n_channels), its last channel is filled in where `theta` is given; `theta`: (p,), coefficients
        of a model without noise whose output is the last channel; `first`: column at which the regressor of that model
        begins. Returns (n_samples, n_columns).
        """
        rows = np.empty((x.shape[0], self._table.shape[0]))
        kernels("regression").tapped(self._past, self._table, x, rows, theta, first)
        return rows

    def silence(self, channel: int) -> None:
        """Begin a channel with zeros instead of unknown numbers."""
        self._past[:, channel] = 0.0

    def scale(self, channel: int, factor: float) -> None:
        """Change the unit of what is remembered of a channel."""
        self._past[:, channel] *= factor


def columns_of(
    na: int, nb: Sequence[int], nk: Sequence[int], *, offset: bool
) -> tuple[list[tuple[int, int, int]], list[str]]:
    """Return columns (channel, lag, sign) and their names; channel 0 is the output, then come the inputs."""
    if na < 0 or len(nb) != len(nk) or any(n < 0 for n in (*nb, *nk)) or na + sum(nb) == 0:
        raise EstimationError(
            f"na={na}, nb={list(nb)}, nk={list(nk)}: orders must be at least 0, and not all 0. Correct them"
        )
    columns, names = [(0, lag, -1) for lag in range(1, na + 1)], [f"a{lag}" for lag in range(1, na + 1)]
    for i, (order, delay) in enumerate(zip(nb, nk, strict=True), start=1):
        for lag in range(delay, delay + order):
            columns.append((i, lag, 1))
            names.append(f"b{lag}" if len(nb) == 1 else f"b{lag}.{i - 1}")
    if offset:
        columns.append((-1, 0, 1))
        names.append("offset")
    return columns, names


def _signals(u: ArrayLike, y: ArrayLike, n_inputs: int, spare: int = 0) -> tuple[Array, Array, tuple[int, ...]]:
    """Return channels [y, u] and `spare` columns of zeros, the outputs (n_samples,) and the shape of `y`."""
    if isinstance(y, float) and isinstance(u, float) and n_inputs == 1 and spare == 0:  # one sample, quickly
        return np.array([[y, u]]), np.array([y]), ()
    inputs, outputs, shape = as_blocks("ARX", u, y, n_inputs)
    return np.hstack([outputs, inputs, np.zeros((outputs.shape[0], spare))]), outputs[:, 0], shape
