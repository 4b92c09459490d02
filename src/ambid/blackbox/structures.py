"""The register of black-box structures: what each is called, which orders it takes, whether feedback disturbs it.

An estimator is a function ``estimator(data, orders, **options) -> BlackBoxFit`` that leaves `fit`, `criteria` and
`checks` to `ambid.validate.blackbox`; it imports only when it is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

from ambid.blackbox.fit import BlackBoxFit
from ambid.errors import EstimationError, nearest


@dataclass(frozen=True, slots=True, kw_only=True)
class Structure:
    """One black-box structure."""

    name: str
    summary: str
    orders: tuple[str, ...]  # orders it takes; all but nk are at least 0 (n: at least 1)
    home: str  # ``module:function`` of its estimator
    inputs: bool  # whether it takes inputs
    # what feedback does to it: nothing; bias; nothing as long as its noise model holds the true one
    feedback: Literal["consistent", "biased", "with noise model"]
    kind: Literal["polynomial", "state space", "transfer function"]

    @property
    def takes_at_rest(self) -> bool:
        """Whether its estimator can be told that the record begins at rest at zero."""
        return self.home.startswith("ambid.blackbox.polynomial:")

    @property
    def estimator(self) -> Callable[..., BlackBoxFit]:
        """The function that fits it."""
        module, function = self.home.split(":")
        found: Callable[..., BlackBoxFit] = getattr(import_module(module), function)
        return found


def _polynomial(name: str, orders: str, feedback: Literal["biased", "with noise model"], summary: str) -> Structure:
    return Structure(
        name=name,
        summary=summary,
        orders=tuple(orders.split()),
        home=f"ambid.blackbox.polynomial:{name}",
        inputs="nb" in orders,
        feedback=feedback,
        kind="polynomial",
    )


def _instrumental(
    name: str, orders: str, feedback: Literal["biased", "consistent"], kind: str, summary: str
) -> Structure:
    return Structure(
        name=name,
        summary=summary,
        orders=tuple(orders.split()),
        home=f"ambid.blackbox.instrumental:{name.replace('-', '_')}",
        inputs=True,
        feedback=feedback,
        kind="transfer function" if kind == "s" else "polynomial",
    )


def _subspace(name: str, feedback: Literal["biased", "consistent", "with noise model"], summary: str) -> Structure:
    return Structure(
        name=name,
        summary=summary,
        orders=("n",),
        home=f"ambid.blackbox.subspace:{name}",
        inputs=True,
        feedback=feedback,
        kind="state space",
    )


STRUCTURES: Mapping[str, Structure] = {
    s.name: s
    for s in (
        _polynomial("fir", "nb nk", "biased", "y = B u + e"),
        _polynomial("arx", "na nb nk", "with noise model", "A y = B u + e"),
        _polynomial("armax", "na nb nc nk", "with noise model", "A y = B u + C e"),
        _polynomial("arma", "na nc", "with noise model", "A y = C e"),
        _polynomial("ararx", "na nb nd nk", "with noise model", "A y = B u + 1/D e"),
        _polynomial("ararmax", "na nb nc nd nk", "with noise model", "A y = B u + C/D e"),
        _polynomial("oe", "nb nf nk", "biased", "y = B/F u + e"),
        _polynomial("bj", "nb nc nd nf nk", "with noise model", "y = B/F u + C/D e"),
        _instrumental("iv4", "na nb nk", "biased", "q", "A y = B u + noise of any colour"),
        _instrumental(
            "cliv", "na nb nk", "consistent", "q", "A y = B u + noise of any colour, in a loop with its reference"
        ),
        _instrumental("srivc", "nb nf nk", "biased", "s", "y = B(s)/F(s) u + noise, continuous time"),
        _instrumental(
            "clsrivc", "nb nf nk", "consistent", "s", "y = B(s)/F(s) u + noise, in a loop with its reference"
        ),
        _instrumental("two-stage", "nb nf nk", "consistent", "q", "y = B/F u in a loop: reference to input, then oe"),
        _subspace("n4sid", "biased", "x+ = A x + B u + K e, subspace by oblique projection"),
        _subspace("moesp", "biased", "x+ = A x + B u + K e, subspace, past without future inputs"),
        _subspace("cva", "biased", "x+ = A x + B u + K e, subspace by canonical variates"),
        _subspace("pbsid", "consistent", "x+ = A x + B u + K e, subspace from a long autoregression; stands feedback"),
        _subspace("sspem", "with noise model", "x+ = A x + B u + K e by prediction error: the sharpest"),
        Structure(
            name="rfir",
            summary="y = B u + e, many taps with a fading prior",
            orders=("nb", "nk"),
            home="ambid.blackbox.nonparametric:rfir",
            inputs=True,
            feedback="biased",
            kind="polynomial",
        ),
        Structure(
            name="weakform",
            summary="y = B(s)/F(s) u + white noise, continuous time, by test functions",
            orders=("nb", "nf", "nk"),
            home="ambid.blackbox.weakform:weakform",
            inputs=True,
            feedback="biased",
            kind="transfer function",
        ),
    )
}

# Fitted to a measured frequency response (`FrequencyResponse`) instead of to inputs and outputs: their estimators take
# one in the place of the data, so they are kept apart from those that `fit` and `compare` can call.
RESPONSE_STRUCTURES: Mapping[str, Structure] = {
    s.name: s
    for s in (
        Structure(
            name="frf-ml",
            summary="G = N/D exp(-s delay), in s or z, by maximum likelihood",
            orders=("nb", "nf"),
            home="ambid.blackbox.frequency.rational:frf_ml",
            inputs=True,
            feedback="consistent",  # as far as the response is; that says itself where it is not
            kind="transfer function",
        ),
        Structure(
            name="frf-subspace",
            summary="x' = A x + B u by subspace with the Laguerre operator, then maximum likelihood",
            orders=("n",),
            home="ambid.blackbox.frequency.subspace:frf_subspace",
            inputs=True,
            feedback="consistent",
            kind="state space",
        ),
    )
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
