"""Settings of NARMAX models, and what the stages of a fit take, so that its progress can be shown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import comb

from ambid.errors import EstimationError
from ambid.estimation.criteria import CRITERIA
from ambid.nonlinear.settings import choice, read_settings, whole

_CHOSEN = 12  # terms of one output that a choice usually ends with
_ITERATIONS = 12  # of a search
_ROUNDS = 5  # of extended least squares
_PASSES = 2  # of a choice of terms over the data
_DEEP = 10  # scalar products per sample take so much less in a choice of terms: large matrices, short of the cache
_STEPS = 60  # of a recursion per coefficient, in the same unit


@dataclass(frozen=True, slots=True, kw_only=True)
class NarmaxSettings:
    """Settings of a NARMAX fit."""

    ny: int = whole("largest lag of the outputs; 2", 0, 100, 2)
    nu: int = whole("number of lags of each input; 2", 0, 100, 2)
    nk: int = whole("smallest lag of the inputs; 1", 0, 1000, 1)
    ne: int = whole("largest lag of the innovations, 0 for NARX; 2", 0, 100, 2)
    degree: int = whole("of the polynomial; 2", 1, 9, 2)
    noise_degree: int = whole("of the terms with innovations; 1, a linear noise model", 1, 5, 1)
    terms: int = whole(
        "process terms that are looked at for each output, at most; 30, fewer on a short record", 1, 2000, 30
    )
    constant: int = whole("1 to let a constant be chosen, 0 for none; 1", 0, 1, 1)
    criterion: str = choice("what ends the choice of terms: ebic, bic, mdl, aic, aicc, fpe, lilc; ebic", *CRITERIA)
    pruning: str = choice(
        "what decides on terms to leave out again: prediction, simulation, none; prediction",
        *("prediction", "simulation", "none"),
    )
    kind: str = choice("polynomial or rational; polynomial", "polynomial", "rational")
    selection: str = choice(
        "frols (by ratios), simulation (by the free run), all (every candidate), auto (frols; all if a"
        " plant is sampled so fast that the ratios say little, and all predict better); auto",
        *("auto", "frols", "simulation", "all"),
    )
    focus: str = choice(
        "prediction or simulation: which errors the coefficients make small at last; prediction",
        *("prediction", "simulation"),
    )
    levels: str = choice(
        "what signals are deviations from: zero, mean, auto (mean where it is over two deviations); auto",
        *("auto", "zero", "mean"),
    )
    output: str = choice(
        "magnitude, or mean magnitude (over a sample), where the sensor sees no sign; signed",
        *("signed", "magnitude", "mean magnitude"),
    )
    symmetry: str = choice(
        "odd where the plant is the same the other way round: terms of odd degree alone; none", "none", "odd"
    )

    @property
    def lag(self) -> int:
        """Samples of the past that a candidate may look at."""
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, self.ne)

    def as_mapping(self) -> dict[str, object]:
        """Return the settings by name."""
        return asdict(self)


_WITH_MAGNITUDE: Mapping[str, object] = {
    "selection": "simulation",
    "focus": "simulation",
    "kind": "polynomial",
    "levels": "zero",
    "pruning": "simulation",
    "ne": 0,
}


def narmax_settings(given: Mapping[str, object], *, n_inputs: int) -> NarmaxSettings:
    """Check settings and complete them; without inputs there are no lags of them."""
    s = read_settings(NarmaxSettings, "narmax", given)
    if s.output != "signed":  # a sign that is not measured is found by simulation
        for name, value in _WITH_MAGNITUDE.items():
            if given.get(name, value) != value:
                raise EstimationError(f"narmax: output = {s.output} needs {name} = {value}; it is {given[name]!r}")
        given = {**_WITH_MAGNITUDE, **given}
    s = NarmaxSettings(**{**given, **({} if n_inputs else {"nu": 0, "nk": 1})})  # type: ignore[arg-type]
    if not s.ny and not s.nu:
        raise EstimationError("narmax: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    return s


def stage_costs(s: NarmaxSettings, n_outputs: int, n_inputs: int) -> tuple[float, float, float, float, float]:
    """Guess what each stage takes, per sample, right within a factor of some.

    Returns choice of terms, denominators, noise terms, pruning, simulation errors; in one unit, 0 for what is left out.
    """
    lagged = n_outputs * s.ny + n_inputs * s.nu
    candidates = comb(lagged + s.degree, s.degree)
    size = n_outputs * (candidates if s.selection == "all" else min(_CHOSEN, candidates, s.terms))
    choice = _PASSES * n_outputs * candidates**2 / _DEEP
    search = _ITERATIONS * size * (size + _STEPS)
    only_free = s.selection == s.focus == "simulation"
    terms = 2 * _CHOSEN * search if s.selection == "simulation" else choice
    below = 4 * 4 * choice + search if s.kind == "rational" else 0.0
    noise = _ROUNDS * n_outputs * size**2 + search if s.ne and not only_free else 0.0
    pruning = {"none": 0.0, "prediction": 1.5 if s.ne else 0.0, "simulation": 2.0}[s.pruning] * search
    free = search if s.focus == "simulation" else 0.0
    return max(terms, 1.0), below, noise, 0.0 if only_free else pruning, free
