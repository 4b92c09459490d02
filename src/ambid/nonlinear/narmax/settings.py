"""What a NARMAX estimator may be told, checked and completed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from ambid.errors import EstimationError, nearest
from ambid.estimation.criteria import CRITERIA

CHOICES: Mapping[str, tuple[str, ...]] = {
    "criterion": CRITERIA,
    "pruning": ("none", "prediction", "simulation"),
    "kind": ("polynomial", "rational"),
    "selection": ("auto", "frols", "simulation", "all"),
    "focus": ("prediction", "simulation"),
    "levels": ("auto", "zero", "mean"),
    "output": ("signed", "magnitude", "mean magnitude"),
    "symmetry": ("none", "odd"),
}
_RANGES: Mapping[str, tuple[int, int]] = {
    "ny": (0, 100),
    "nu": (0, 100),
    "nk": (0, 1000),
    "ne": (0, 100),
    "degree": (1, 9),
    "noise_degree": (1, 5),
    "terms": (1, 2000),
    "constant": (0, 1),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class NarmaxSettings:
    """Settings of a NARMAX fit; described in the register of structures."""

    ny: int = 2
    nu: int = 2
    nk: int = 1
    ne: int = 2
    degree: int = 2
    noise_degree: int = 1
    terms: int = 30
    constant: int = 1
    criterion: str = "ebic"
    pruning: str = "prediction"
    kind: str = "polynomial"
    selection: str = "auto"
    focus: str = "prediction"
    levels: str = "auto"
    output: str = "signed"
    symmetry: str = "none"

    @property
    def lag(self) -> int:
        """Samples of the past that a candidate may look at."""
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, self.ne)

    def as_mapping(self) -> dict[str, object]:
        """Return the settings by name."""
        return asdict(self)


def narmax_settings(given: Mapping[str, object], *, n_inputs: int) -> NarmaxSettings:
    """Check settings and complete them.

    `n_inputs`: without inputs there are no lags of them.
    """
    for name, value in given.items():
        if name in CHOICES:
            if value not in CHOICES[name]:
                near = nearest(str(value), list(CHOICES[name]))
                raise EstimationError(
                    f"narmax: {name} is {value!r}; it must be one of {', '.join(CHOICES[name])}.{near}"
                )
        elif name in _RANGES:
            low, high = _RANGES[name]
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise EstimationError(f"narmax: {name} is {value!r}; it must be a whole number from {low} to {high}")
        else:
            known = [*_RANGES, *CHOICES]
            raise EstimationError(
                f"narmax: setting {name!r} is not known; known: {', '.join(known)}.{nearest(name, known)}"
            )
    if given.get("output", "signed") != "signed":
        given = {**_for_magnitude(given)}
    s = NarmaxSettings(**{**given, **({} if n_inputs else {"nu": 0, "nk": 1})})  # type: ignore[arg-type]
    if not s.ny and not s.nu:
        raise EstimationError("narmax: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    return s


_WITH_MAGNITUDE: Mapping[str, object] = {
    "selection": "simulation",
    "focus": "simulation",
    "kind": "polynomial",
    "levels": "zero",
    "pruning": "simulation",
    "ne": 0,
}


def _for_magnitude(given: Mapping[str, object]) -> Mapping[str, object]:
    """A sign that is not measured is found by simulation: what that needs is set, and anything else refused."""
    for name, value in _WITH_MAGNITUDE.items():
        if given.get(name, value) != value:
            raise EstimationError(f"narmax: output = {given['output']} needs {name} = {value}; it is {given[name]!r}")
    return {**_WITH_MAGNITUDE, **given}
