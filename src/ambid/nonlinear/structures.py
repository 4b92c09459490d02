"""The register of nonlinear structures: what each is called, what it is told, what feedback does to it.

An estimator is a function ``estimator(records, settings, *, seed=0, tick=None) -> NonlinearFit``: `records` a sequence
of `IOData` of one bench (same channels, same rate), `tick` (`ambid.estimation.estimate.Tick`) called now and
then with the name of the stage and the share of the whole search that is over; it may raise KeyboardInterrupt, upon
which the estimator gives the best model so far with status ``stalled``. Divergence, or numbers that are not finite, end
in status ``failed`` with the reason, never in an exception; an exception is a request that makes no sense. The
estimator leaves `fit`, `criteria` and `checks` to `ambid.validation.fits`. It is imported only when it is asked for.
`tests/nonlinear/test_conformance.py` runs on every entry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from ambid.errors import EstimationError, nearest
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.settings import rules


@dataclass(frozen=True, slots=True, kw_only=True)
class NonlinearStructure:
    """One nonlinear structure."""

    name: str  # for lists
    summary: str
    options: str  # ``module:class`` of its settings
    home: str  # ``module:function`` of its estimator
    # what feedback does to it: nothing; bias; nothing as long as its noise model holds the true one
    feedback: Literal["consistent", "biased", "with noise model"]

    @property
    def estimator(self) -> Callable[..., NonlinearFit]:
        """The function that fits it."""
        found: Callable[..., NonlinearFit] = _load(self.home)
        return found

    @property
    def settings(self) -> Mapping[str, str]:
        """Settings by name, each with a line that says what it is and what is chosen without it."""
        return {name: rule.says for name, rule in rules(_load(self.options)).items()}


def _load(home: str) -> Any:
    """What ``module:name`` says."""
    module, name = home.split(":")
    return getattr(import_module(module), name)


_ENTRIES: tuple[NonlinearStructure, ...] = (
    NonlinearStructure(
        name="narmax",
        summary="polynomial or rational difference equation; terms by orthogonal least squares; noise model",
        options="ambid.nonlinear.narmax_choice:NarmaxSettings",
        home="ambid.nonlinear.narmax:narmax",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="nn",
        summary="state-space network whose weights are A and B (thesis fig. 5.9), with a network G(x, u)",
        options="ambid.nonlinear.nn:NnSettings",
        home="ambid.nonlinear.nn:nn",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="narx",
        summary="neural NARX: linear part and one hidden layer of tanh units on lagged outputs and inputs",
        options="ambid.nonlinear.narx:NarxSettings",
        home="ambid.nonlinear.narx:narx",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="lpv",
        summary="linear model whose coefficients follow a scheduling signal such as the set point; error model",
        options="ambid.nonlinear.lpv:LpvSettings",
        home="ambid.nonlinear.lpv:lpv",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="hybrid",
        summary="polynomial, network for its residual, noise model C (thesis eqs 3.23-3.24)",
        options="ambid.nonlinear.hybrid:HybridSettings",
        home="ambid.nonlinear.hybrid:hybrid",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="hammerstein",
        summary="static polynomial of each input, then a linear difference equation",
        options="ambid.nonlinear.hammerstein:HammersteinSettings",
        home="ambid.nonlinear.hammerstein:hammerstein",
        feedback="with noise model",
    ),
    NonlinearStructure(
        name="rbf",
        summary="radial basis functions of lagged outputs and inputs, with a linear part (thesis eqs 1.13-1.14)",
        options="ambid.nonlinear.rbf:RbfSettings",
        home="ambid.nonlinear.rbf:rbf",
        feedback="with noise model",
    ),
)

NONLINEAR_STRUCTURES: Mapping[str, NonlinearStructure] = {s.name: s for s in _ENTRIES}


def nonlinear_structure(name: str) -> NonlinearStructure:
    """Return a nonlinear structure of the register by name, such as ``"narmax"``."""
    if name not in NONLINEAR_STRUCTURES:
        known = ", ".join(NONLINEAR_STRUCTURES)
        raise EstimationError(
            f"structure {name!r} is unknown; known: {known}.{nearest(name, list(NONLINEAR_STRUCTURES))}"
        )
    return NONLINEAR_STRUCTURES[name]
