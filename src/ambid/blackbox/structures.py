"""The register of black-box structures: what each is called, which orders it takes, whether feedback disturbs it.

An estimator is a function ``estimator(data, orders, **options) -> BlackBoxFit`` that leaves `fit`, `criteria` and
`checks` to `ambid.validate.fits`; it imports only when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from ambid.errors import EstimationError, nearest

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
        return bool({"nb", "nf", "n"} & set(self.orders))

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
        ("cliv", "na nb nk", "consistent", "A y = B u + noise of any colour, in a loop with its reference"),
    ),
    **_register(
        "transfer function",
        "instrumental_continuous",
        ("srivc", "nb nf nk", "biased", "y = B(s)/F(s) u + noise, continuous time"),
        ("clsrivc", "nb nf nk", "consistent", "y = B(s)/F(s) u + noise, in a loop with its reference"),
    ),
    **_register(
        "polynomial",
        "instrumental",
        ("two-stage", "nb nf nk", "consistent", "y = B/F u in a loop: reference to input, then oe"),
    ),
    **_register(
        "state space",
        "subspace",
        ("n4sid", "n", "biased", "x+ = A x + B u + K e, subspace by oblique projection"),
        ("moesp", "n", "biased", "x+ = A x + B u + K e, subspace, past without future inputs"),
        ("cva", "n", "biased", "x+ = A x + B u + K e, subspace by canonical variates"),
        ("pbsid", "n", "consistent", "x+ = A x + B u + K e, subspace from a long autoregression; stands feedback"),
    ),
    **_register(
        "state space",
        "state_space_search",
        ("sspem", "n", "with noise model", "x+ = A x + B u + K e by prediction error: the sharpest"),
    ),
    **_register("polynomial", "impulse", ("rfir", "nb nk", "biased", "y = B u + e, many taps with a fading prior")),
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
        "frequency_rational",
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
        raise EstimationError(f"structure {name!r} is not known; known: {known}.{nearest(name, list(STRUCTURES))}")
    return STRUCTURES[name]


def any_structure(name: str) -> Structure:
    """Return a structure by name, whatever it is fitted to: for those who read a finished fit."""
    return RESPONSE_STRUCTURES[name] if name in RESPONSE_STRUCTURES else structure(name)
