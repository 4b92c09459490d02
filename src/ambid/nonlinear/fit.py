"""What every nonlinear model is to those who use it, and the result of every nonlinear estimator."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal, Protocol

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.estimation.estimate import FittedModel
from ambid.estimation.search import Found

Settings = Mapping[str, int | float | str | tuple[int, ...]]
"""What a structure is told: lags, degrees, neurons, ..., by name; what is left out the method chooses and reports."""


class NonlinearModel(Protocol):
    """A discrete-time model of inputs and outputs, in SI units of the record; time is axis 0.

    A model that works on scaled or centred signals does so inside. All arrays are read only for it.

    Attributes
    ----------
    kind : str
        Under which `nonlinear.fit_file` writes and finds it.
    dt : float
        Sampling interval in s.
    n_inputs, n_outputs : int
        Channels.
    lag : int
        Samples of the past that a prediction needs.
    names : tuple of str
        Of all parameters, in the order of `theta`.
    theta : ndarray, shape (n_theta,)
        All parameters.
    """

    @property
    def kind(self) -> str: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102
    @property
    def n_inputs(self) -> int: ...  # noqa: D102
    @property
    def n_outputs(self) -> int: ...  # noqa: D102
    @property
    def lag(self) -> int: ...  # noqa: D102
    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def theta(self) -> Array: ...  # noqa: D102

    def predict(self, u: Array, y: Array) -> Array:
        """Return one-step-ahead predictions of the outputs from past outputs and inputs.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are NaN: there is no past to predict them from.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def jacobian(self, u: Array, y: Array) -> Array:
        """Return the exact derivative of `predict` by `theta`.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs, n_theta)
            The first `lag` rows are zero.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def simulate(self, u: Array, y: Array) -> Array:
        """Run freely from the first `lag` measured samples on, without noise.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (at least lag, n_outputs), SI
            Only the first `lag` rows are looked at.

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are those of `y`. NaN from where a run diverges on (here: leaves
            a million times the size of the training data); never clipped.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def novelty(self, u: Array, y: Array) -> Array:
        """Say how far from the training data a prediction is made.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples,)
            0 in the middle of what was trained on, 1 at its edge, above 1 outside: there the model extrapolates. The
            first `lag` rows are NaN.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def as_json(self) -> dict[str, Any]:
        """Return all that `nonlinear.fit_file` needs to read it back; numbers survive bit by bit."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LearningCurve:
    """How a training went."""

    method: str  # what trained, e.g. ``"Levenberg-Marquardt"``.
    seconds: Array  # (n_iterations,), s, since it began
    # (n_iterations,), root mean square errors in multiples of the outputs' standard deviations; `held_out` is empty
    # where nothing was
    training: Array
    held_out: Array = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class NonlinearFit(FittedModel):
    """An identified nonlinear model, file schema ``ambid.fit/1``.

    Attributes
    ----------
    structure : str
        Name in `ambid.nonlinear.structures`.
    settings : Mapping[str, object]
        As used, nothing left open.
    model : NonlinearModel or None
        None where `status` is ``failed``.
    covariance : ndarray, shape (n_theta, n_theta) or None
        Of ``model.theta``; zeros where a parameter was not estimated. None where the method has none to give.
    covariance_from : str
        How it came about: ``"information"``, ``"laplace"``, ``"sandwich"`` (errors not taken as white),
        ``"bootstrap"``; empty without.
    n_estimated : int
        Numbers that were estimated.
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
        Of the one-step errors (of the simulation errors for a model that was fitted to those).
    inputs, outputs : tuple of str
        Channels.
    units : Mapping[str, str]
        SI unit by channel.
    dt : float
        s.
    records : tuple of Mapping
        ``samples``, ``rate_hz``, ``sha256``, ``file`` of each record that it was estimated from.
    seed : int
        Of everything random: equal seeds give equal results.
    status : {"converged", "stalled", "failed"}
        ``failed`` has its reason in `reason`, and no model.
    reason : str
        One line; empty unless failed.
    curves : tuple of LearningCurve
        Of each training that was done.
    fit : Mapping[str, OutputFit]
        By output, over all records.
    criteria : Mapping[str, float]
        ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe``.
    checks : Mapping[str, Check]
        Made by `ambid.validation.fits`.
    validation : Mapping[str, object] or None
        By output, on a second record.
    warnings : tuple of str
        One line each.
    timing_s : Mapping[str, float]
        By stage.
    details : Mapping[str, object]
        Further results of the method as JSON-able values (terms with their error reduction ratios, chosen lags).
    """

    settings: Mapping[str, object]
    model: NonlinearModel | None
    records: tuple[Mapping[str, object], ...]
    seed: int = 0
    covariance_from: str = ""
    status: Literal["converged", "stalled", "failed"] = "converged"
    reason: str = ""
    curves: tuple[LearningCurve, ...] = ()


NO_WEIGHTS = "no finite weights were found: the columns vary too much in size from sample to sample; check them"
"""Why the weights of a network that looks at measured signals alone come to nothing."""


def provenance(records: Sequence[IOData]) -> dict[str, Any]:
    """Return channels, units, rate and records, by the names that `NonlinearFit` has for them."""
    first = {k: getattr(records[0], k) for k in ("inputs", "outputs", "dt")}
    return {**first, "units": dict(records[0].units), "records": tuple(dict(x.record) for x in records)}


def failed_fit(
    structure: str,
    records: Sequence[IOData],
    settings: Mapping[str, object],
    seed: int,
    reason: str,
    timing_s: Mapping[str, float],
) -> NonlinearFit:
    """Return a fit without a model, for a reason of one line."""
    p = records[0].n_outputs
    return NonlinearFit(
        structure=structure,
        settings=dict(settings),
        model=None,
        covariance=None,
        n_estimated=0,
        noise_covariance=np.full((p, p), np.nan),
        seed=seed,
        status="failed",
        reason=reason,
        timing_s=dict(timing_s),
        **provenance(records),
    )


@dataclass(slots=True, kw_only=True)
class Attempt:
    """What a fit has come to, so that an interruption loses nothing."""

    status: Literal["converged", "stalled"] = "converged"
    curves: list[LearningCurve] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    timing_s: dict[str, float] = field(default_factory=dict)
    details: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of what is done inside to a stage."""
        began = perf_counter()
        try:
            yield
        finally:
            self.timed(name, began)

    def timed(self, stage: str, began: float) -> float:
        """Add what a stage took since `began`, and return when the next one begins."""
        now = perf_counter()
        self.timing_s[stage] = self.timing_s.get(stage, 0.0) + now - began
        return now

    def note_curve(self, found: Found, method: str, n: int, size: float) -> None:
        """Add the learning curve of a search over `n` errors of unit variance, `size` in deviations of the outputs."""
        curve = LearningCurve(
            method=method,
            seconds=np.array(found.seconds),
            training=np.sqrt(np.array(found.costs) / max(n, 1)) * size,
            held_out=np.array(found.held_out),
        )
        self.curves.append(curve)

    def interrupt(self) -> None:
        """Say that the search was interrupted."""
        self.status = "stalled"
        self.warnings.insert(0, "interrupted: the best model so far")

    def result(
        self, structure: str, records: Sequence[IOData], settings: Mapping[str, object], seed: int, **found: Any
    ) -> NonlinearFit:
        """Return the fit of a model; `found` are the other fields of `NonlinearFit`."""
        return NonlinearFit(
            structure=structure, settings=dict(settings), seed=seed, status=self.status, curves=tuple(self.curves),
            warnings=tuple(self.warnings), timing_s=dict(self.timing_s), details=dict(self.details),
            **provenance(records), **found,
        )  # fmt: skip
