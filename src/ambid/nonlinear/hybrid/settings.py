"""What the hybrid estimator may be told, checked and completed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from ambid.errors import EstimationError
from ambid.estimation.criteria import CRITERIA
from ambid.nonlinear.settings import checked

MOST_NOISE = 4  # largest order of C that is tried where it is left open

_RANGES: Mapping[str, tuple[float, float]] = {
    "ny": (0, 50),
    "nu": (0, 50),
    "nk": (0, 1000),
    "ne": (0, 20),
    "degree": (1, 9),
    "terms": (1, 2000),
    "constant": (0, 1),
    "neurons": (0, 60),
    "starts": (1, 50),
    "held_out": (0.05, 0.5),
    "prior": (0.01, 1e6),
    "iterations": (1, 2000),
}
_CHOICES: Mapping[str, tuple[str, ...]] = {
    "criterion": CRITERIA,
    "pruning": ("none", "prediction"),
    "selection": ("frols", "all"),
    "levels": ("auto", "zero", "mean"),
    "innovations": ("linear", "network"),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class HybridSettings:
    """Settings of a hybrid fit; described in the register of structures."""

    ny: int = 2
    nu: int = 2
    nk: int = 1
    ne: int | None = None  # none where left open
    degree: int = 2
    terms: int = 30
    constant: int = 1
    neurons: int | None = None
    starts: int = 3
    held_out: float = 0.2
    prior: float = 3.0
    iterations: int = 60
    criterion: str = "ebic"
    pruning: str = "prediction"
    selection: str = "frols"
    levels: str = "auto"
    innovations: str = "linear"

    @property
    def lag(self) -> int:
        """Samples of the past that a model may look at."""
        ne = MOST_NOISE if self.ne is None else self.ne
        return max(self.ny, self.nk + self.nu - 1 if self.nu else 0, ne, 1)

    @property
    def polynomial(self) -> dict[str, int | float | str | tuple[int, ...]]:
        """What the polynomial's estimator is told."""
        same = ("ny", "nu", "nk", "degree", "terms", "constant", "criterion", "pruning", "selection", "levels")
        return {k: getattr(self, k) for k in same} | {"ne": 2 if self.ne is None else self.ne}

    def as_mapping(self) -> dict[str, object]:
        """Return the settings by name."""
        return asdict(self)


def hybrid_settings(given: Mapping[str, object], *, n_inputs: int) -> HybridSettings:
    """Check settings and complete them.

    `n_inputs`: without inputs there are no lags of them.
    """
    told = checked("hybrid", given, _RANGES, _CHOICES)
    s = HybridSettings(**{**told, **({} if n_inputs else {"nu": 0, "nk": 1})})  # type: ignore[arg-type]
    if not s.ny and not s.nu:
        raise EstimationError("hybrid: ny and nu are both 0; nothing is left to predict from. Raise one of them")
    if s.innovations == "network" and 0 in (s.ne, s.neurons):
        raise EstimationError(
            "hybrid: innovations = network puts past innovations into the units, and ne or neurons is 0. Raise it, or "
            "say innovations = linear"
        )
    return s
