"""A parameter as estimated, and what every result with named parameters gives of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError, nearest, needs
from ambid.estimation.result import NORMAL_95
from ambid.physics.linear_model import Parameter
from ambid.settings.elsewhere import RESULT, missing
from ambid.units import parse_unit


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EstimatedParameter(NDArrayOperatorsMixin):
    """One parameter as estimated; in arithmetic and to `float` and NumPy it is its value."""

    name: str  # name and SI unit
    unit: str
    value: float  # SI; `sd` is 0 for a fixed parameter
    sd: float
    ci95: tuple[float, float]  # 95 % interval, value -+ 1.96 sd
    role: Literal["free", "fixed", "prior"]
    # whether the data (with the priors) show it: relative sd under 25 %, and the verdict is not "do not use". True for
    # a fixed parameter.
    identifiable: bool
    data_share: float | None = None  # for a prior: part of the information that comes from the data, 0 to 1
    sd_calibrated: float | None = None  # with what the rig says of calibration; None where it says nothing
    ci95_calibrated: tuple[float, float] | None = None

    def __float__(self) -> float:
        return float(self.value)

    def __round__(self, digits: int | None = None) -> float:
        return round(float(self), digits)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.array(self.value, dtype=dtype)

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        plain = [x.value if isinstance(x, EstimatedParameter) else x for x in inputs]
        return getattr(function, method)(*plain, **options)

    def __format__(self, form: str) -> str:
        return format(self.value, form) if form else repr(self)

    def to(self, unit: str) -> float:
        """Return the value in another unit of the same kind, such as ``"g"``."""
        return float(parse_unit(unit).of_si(np.float64(self.value), self.unit))

    def __repr__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        spread = f" ± {self.sd:.2g}{unit}, 95 % interval {self.ci95[0]:.4g} … {self.ci95[1]:.4g}" if self.sd else unit
        return f"<{self.name} = {self.value:.5g}{spread}, {self.role}>"

    @classmethod
    def of(
        cls,
        p: Parameter,
        theta: Mapping[str, float],
        sd: Mapping[str, float],
        identifiable: Mapping[str, bool],
        alone: Mapping[str, float] | None = None,
    ) -> EstimatedParameter:
        """Return a parameter as estimated; `alone`: standard deviations of the data alone, for the share of a prior."""
        value, spread, share = theta[p.name], sd.get(p.name, 0.0), None
        if alone is not None and p.role == "prior" and p.sd:
            share = float(1 / (1 + (alone[p.name] / p.sd) ** 2))
        return cls(
            name=p.name,
            unit=p.unit,
            value=value,
            sd=spread,
            ci95=(value - NORMAL_95 * spread, value + NORMAL_95 * spread),
            role=p.role,
            identifiable=identifiable.get(p.name, True),
            data_share=share,
        )


class Labelled(np.ndarray[Any, np.dtype[np.float64]]):
    """A matrix or vector whose rows and columns have names: ``matrix["k_i", "m"]``, ``matrix["k_i"]["m"]``, and by
    place. What is computed from it is a plain array.
    """

    names: tuple[str, ...] = ()

    @classmethod
    def of(cls, values: Any, names: tuple[str, ...]) -> Labelled:
        """Name the rows, and columns, of an array."""
        named = np.array(values, dtype=np.float64).view(cls)
        named.names = names
        return named

    def __reduce__(self) -> Any:
        return Labelled.of, (np.asarray(self), self.names)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        del context
        return array[()] if return_scalar else np.asarray(array)

    def __getitem__(self, at: Any) -> Any:
        keys = at if isinstance(at, tuple) else (at,)
        if not any(isinstance(k, str) for k in keys):
            return np.asarray(self)[at]
        unknown = [k for k in keys if isinstance(k, str) and k not in self.names]
        if unknown:
            raise KeyError(f"{unknown[0]!r} is not among {', '.join(self.names)}")
        part = np.asarray(self)[tuple(self.names.index(k) if isinstance(k, str) else k for k in keys)]
        return Labelled.of(part, self.names) if isinstance(at, str) and self.ndim > 1 else part

    @property
    def loc(self) -> Labelled:
        """Itself, as people of pandas write."""
        return self

    def to_dataframe(self) -> Any:
        """Return it as a pandas DataFrame, or Series."""
        with needs("pandas", "a DataFrame", "frames"):
            import pandas
        labels = list(self.names)
        if self.ndim == 1:
            return pandas.Series(np.asarray(self), index=labels)
        return pandas.DataFrame(np.asarray(self), index=labels, columns=labels)

    def _repr_html_(self) -> str:
        return str(self.to_dataframe()._repr_html_())


class Parametric:
    """A result that has named parameters."""

    __slots__ = ()
    parameters: tuple[EstimatedParameter, ...]
    covariance: Array | None
    model: Any

    def __post_init__(self) -> None:
        """Name rows and columns of the covariance."""
        own = {n: getattr(self, n) for n in ("covariance", "covariance_names", "model") if hasattr(type(self), n)}
        matrix: Any = own.get("covariance")
        names: Any = own.get("covariance_names") or getattr(own.get("model"), "names", ())
        if matrix is not None and np.shape(matrix) == (len(names), len(names)):
            object.__setattr__(self, "covariance", Labelled.of(matrix, tuple(names)))

    def __getitem__(self, name: str) -> EstimatedParameter:
        return self.parameter(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    if not TYPE_CHECKING:  # an editor and a type checker know the attributes alone

        def __getattr__(self, name: str) -> EstimatedParameter:
            if name.startswith("_") or name in ("parameters", "model"):  # which an object that is being copied lacks
                raise AttributeError(name)
            if name in self.values:
                return self.parameter(name)
            raise missing(f"a {type(self).__name__}", name, dir(self), RESULT)

    def __dir__(self) -> list[str]:
        return sorted({*object.__dir__(self), *(n for n in self.values if n.isidentifier())})

    def _ipython_key_completions_(self) -> list[str]:
        return list(self.values)

    def keys(self) -> list[str]:
        """Names of the parameters, so that ``dict(estimate)`` holds them."""
        return list(self.values)

    def items(self) -> Iterator[tuple[str, EstimatedParameter]]:
        """Names and parameters."""
        return ((p.name, p) for p in self.parameters)

    @property
    def correlation(self) -> Labelled:
        """Correlation of what was estimated, by name; ``to_dataframe()`` for pandas."""
        matrix: Any = getattr(self, "covariance", None)
        if matrix is None:
            raise EstimationError("the method gives no covariance, and without one there is no correlation")
        sd = np.sqrt(np.maximum(np.diag(matrix), 0.0))
        free = sd > 0
        names = tuple(n for n, on in zip(matrix.names, free, strict=True) if on)
        return Labelled.of(np.asarray(matrix)[np.ix_(free, free)] / np.outer(sd[free], sd[free]), names)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles of the plant: of a discrete model in z, else in rad/s."""
        own: Any = getattr(self, "continuous", None)
        if own is not None:
            return np.asarray(own.poles)
        poles = getattr(self.model, "poles", None)
        if poles is None:
            raise EstimationError("a nonlinear model has no poles. Simulate it instead")
        return np.asarray(poles())

    @property
    def values(self) -> dict[str, float]:
        """All parameter values, SI."""
        return {p.name: p.value for p in self.parameters}

    def parameter(self, name: str) -> EstimatedParameter:
        """Return one parameter by name; EstimationError where there is none of that name."""
        for p in self.parameters:
            if p.name == name:
                return p
        names = [p.name for p in self.parameters]
        raise EstimationError(
            f"the estimate has no parameter {name!r}; it has {', '.join(names)}.{nearest(name, names)} Check the name"
        )
