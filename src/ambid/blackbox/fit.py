"""The result of every black-box estimator, and how an estimator builds it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData, UsedOrders
from ambid.blackbox.model import BlackBoxModel, Offsets
from ambid.errors import EstimationError, nearest
from ambid.estimation.estimate import FittedModel
from ambid.estimation.result import Linear, Reason
from ambid.settings.caller import setting

Feedback = Literal["consistent", "biased", "with noise model"]
Kind = Literal["polynomial", "state space", "transfer function"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """One black-box structure."""

    name: str
    summary: str
    orders: tuple[str, ...]  # orders it takes; all but nk are at least 0 (n: at least 1)
    module: str  # of `ambid.blackbox`, where its estimator stands under its own name
    # what feedback does to it: nothing; bias; nothing as long as its noise model holds the true one
    feedback: Feedback
    kind: Kind

    @property
    def inputs(self) -> bool:
        """Whether it takes inputs."""
        return bool({"nb", "nf", "n", "nk"} & set(self.orders))

    @property
    def prediction_error(self) -> bool:
        """Whether it is a polynomial structure fitted by prediction error: it takes `at_rest`, and can be tracked."""
        return self.module == "polynomial"

    @property
    def instrumental(self) -> bool:
        """Whether it is fitted by instrumental variables."""
        return self.module.startswith("instrumental")

    @property
    def estimator(self) -> Callable[..., Any]:
        """The function that fits it."""
        found: Callable[..., Any] = getattr(import_module(f"ambid.blackbox.{self.module}"), self.name.replace("-", "_"))
        return found


def _register(kind: Kind, module: str, *rows: tuple[str, str, Feedback, str]) -> dict[str, Structure]:
    """Enter structures of one module: name, orders, what feedback does, summary."""
    return {
        name: Structure(
            name=name, summary=summary, orders=tuple(orders.split()), module=module, feedback=feedback, kind=kind
        )
        for name, orders, feedback, summary in rows
    }


STRUCTURES: Mapping[str, Structure] = {
    **_register(
        "polynomial",
        "polynomial",
        ("fir", "nb nk", "biased", "y = B u + e"),
        ("arx", "na nb nk", "with noise model", "A y = B u + e"),
        ("armax", "na nb nc nk", "with noise model", "A y = B u + C e"),
        ("arma", "na nc", "with noise model", "A y = C e"),
        ("ararx", "na nb nd nk", "with noise model", "A y = B u + 1/D e"),
        ("ararmax", "na nb nc nd nk", "with noise model", "A y = B u + C/D e"),
        ("oe", "nb nf nk", "biased", "y = B/F u + e"),
        ("bj", "nb nc nd nf nk", "with noise model", "y = B/F u + C/D e"),
    ),
    **_register(
        "polynomial",
        "instrumental",
        ("iv4", "na nb nk", "biased", "A y = B u + noise of any colour"),
        ("cliv", "na nb nk", "consistent", "A y = B u + noise of any colour, in closed loop with its reference"),
    ),
    **_register(
        "transfer function",
        "instrumental_continuous",
        ("srivc", "nb nf nk", "biased", "y = B(s)/F(s) u + noise, continuous time"),
        ("clsrivc", "nb nf nk", "consistent", "y = B(s)/F(s) u + noise, in closed loop with its reference"),
    ),
    **_register(
        "state space",
        "subspace",
        ("n4sid", "n", "biased", "x+ = A x + B u + K e, subspace by oblique projection"),
        ("moesp", "n", "biased", "x+ = A x + B u + K e, subspace, past without future inputs"),
        ("cva", "n", "biased", "x+ = A x + B u + K e, subspace by canonical variates"),
        (
            "pbsid",
            "n",
            "consistent",
            "x+ = A x + B u + K e, subspace from a long autoregression; consistent in closed loop",
        ),
    ),
    **_register(
        "state space",
        "state_space_search",
        ("sspem", "n", "with noise model", "x+ = A x + B u + K e by prediction error: statistically efficient"),
    ),
    **_register(
        "polynomial",
        "impulse",
        ("rfir", "nb nk", "biased", "y = B u + e, many taps with a decaying prior"),
        ("correlation", "nb nk", "biased", "y = B u + e, taps by correlation with the whitened input"),
    ),
    **_register(
        "transfer function",
        "blocks",
        (
            "blocks",
            "nk",
            "consistent",
            "i = K_a/(s+a) u + K_b/(s+b) x, x = K_c/(s+c) i, continuous time (mass 1, no inertia)",
        ),
    ),
    **_register(
        "transfer function",
        "weak_form",
        ("weakform", "nb nf nk", "biased", "y = B(s)/F(s) u + white noise, continuous time, by test functions"),
    ),
}

# Fitted to a measured frequency response (`FrequencyResponse`) instead of to inputs and outputs: their estimators take
# one in the place of the data, so they are kept apart from those that `fit` and `compare` can call. They are consistent
# under feedback as far as the response is; that says itself where it is not.
RESPONSE_STRUCTURES: Mapping[str, Structure] = {
    **_register(
        "transfer function",
        "frequency",
        ("frf-ml", "nb nf", "consistent", "G = N/D exp(-s delay), in s or z, by maximum likelihood"),
    ),
    **_register(
        "state space",
        "frequency_subspace",
        (
            "frf-subspace",
            "n",
            "consistent",
            "x' = A x + B u by subspace with the Laguerre operator, then maximum likelihood",
        ),
    ),
}


def structure(name: str) -> Structure:
    """Return a structure that is fitted to inputs and outputs, by name."""
    if name in RESPONSE_STRUCTURES:
        raise EstimationError(
            f"structure {name} is fitted to a frequency response, not to inputs and outputs. Use 'ambid frf'"
        )
    if name not in STRUCTURES:
        known = ", ".join(STRUCTURES)
        raise EstimationError(f"structure {name!r} is unknown; known: {known}.{nearest(name, list(STRUCTURES))}")
    return STRUCTURES[name]


def any_structure(name: str) -> Structure:
    """Return a structure by name, whatever it is fitted to: for those who read a finished fit."""
    return RESPONSE_STRUCTURES[name] if name in RESPONSE_STRUCTURES else structure(name)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class BlackBoxFit(FittedModel, Linear):
    """An identified black-box model, file schema ``ambid.fit/1``.

    Attributes
    ----------
    structure : str
        Name in `ambid.blackbox.fit`.
    orders : Mapping[str, int or tuple of int]
        ``na``, ``nb`` ..., or ``n``; a tuple where inputs differ.
    model : BlackBoxModel
        PolynomialModel, StateSpaceModel or TransferModel, for deviations from `offsets`.
    covariance : ndarray, shape (n_theta, n_theta) or None
        Of ``model.theta``; zeros where a coefficient was not estimated. None where the method has none to give.
    n_estimated : int
        Numbers that were estimated, offsets and initial states not counted.
    offsets : Offsets
        Operating point, SI.
    noise_covariance : ndarray, shape (n_outputs, n_outputs), SI
        Of the innovations.
    inputs, outputs : tuple of str
    units : Mapping[str, str]
    dt : float, s
    record : Mapping[str, object]
    status : {"converged", "stalled"}
    fit : Mapping[str, OutputFit]
        By output.
    criteria : Mapping[str, float]
        ``aic``, ``aicc``, ``bic``, ``mdl``, ``fpe``.
    checks : Mapping[str, Check]
    validation : Mapping[str, object] or None
        By output, on a second record.
    warnings : tuple of str
    timing_s : Mapping[str, float]
    details : Mapping[str, object]
        Further results of the method as JSON-able values (singular values, condition numbers, chosen horizons).
    derived : Mapping[str, object]
        What was worked out from it, by name: ``physical`` parameters of a rig, ``sensitivity`` of the coefficients.
        Written, but not read back.
    """

    orders: UsedOrders
    model: BlackBoxModel
    offsets: Offsets
    record: Mapping[str, object]
    status: Literal["converged", "stalled"] = "converged"
    derived: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}), metadata={"written": False})

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Those of the fit, and of the physical parameters that were derived from it."""
        physical = getattr(self.derived.get("physical"), "reasons", ())
        return (*super(BlackBoxFit, self).reasons, *(replace(r, check=f"physical.{r.check}") for r in physical))


def build_fit(
    name: str,
    data: IOData,
    *,
    orders: UsedOrders,
    model: BlackBoxModel,
    covariance: Array | None,
    n_estimated: int,
    offsets: Offsets,
    noise_covariance: Array,
    status: Literal["converged", "stalled"] = "converged",
    warnings: Sequence[str] = (),
    details: Mapping[str, object] | None = None,
) -> BlackBoxFit:
    """Put the result of an estimator together.

    `name`: structure, as in the register; `data`: what it was estimated from; `orders`: as used, delays included;
    `noise_covariance`: (n_outputs, n_outputs), SI. Returns with a warning where the structure is biased under feedback
    and the data are not declared open loop.
    """
    if not np.all(np.isfinite(model.theta)) or not np.all(np.isfinite(noise_covariance)):
        raise EstimationError(f"{name}: no finite coefficients fit this record. Lower the orders, or check the columns")
    found = list(warnings)
    if status != "converged":
        found.insert(0, "the search did not converge: treat the values as a first guess")
    if structure(name).feedback == "biased" and data.n_inputs and not data.open_loop:
        found.append(
            f"{name} is biased by feedback. Use bj, armax or pbsid, or give {setting('open_loop', True)} if the "
            "record is open loop"
        )
    return BlackBoxFit(
        structure=name,
        orders=dict(orders),
        model=model,
        covariance=covariance,
        n_estimated=n_estimated,
        offsets=offsets,
        noise_covariance=np.asarray(noise_covariance, dtype=np.float64),
        inputs=data.inputs,
        outputs=data.outputs,
        units=dict(data.units),
        dt=data.dt,
        record=dict(data.record),
        status=status,
        warnings=tuple(found),
        details={} if details is None else dict(details),
    )
