"""What every result of every verb is: a verdict, a text, a figure, a page, a file and a table, under the same names.
Only `_shown` and `_predicted`, through which methods ask for texts and figures, reach upward (ARCHITECTURE.md).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ambid.settings.elsewhere import RESULT, missing

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from ambid.arrays import Array

NORMAL_95 = 1.959963984540054  # sd on either side of the mean that hold 95 % of a normal distribution


def interval_95(value: float, sd: float) -> tuple[float, float]:
    """Return the interval that holds 95 % of a normal distribution."""
    return value - NORMAL_95 * sd, value + NORMAL_95 * sd


def _shown(name: str) -> Any:
    """Return a function that shows results."""
    return getattr(import_module("ambid.job.presentation"), name)


def _predicted(name: str) -> Any:
    """Return a function that runs models."""
    return getattr(import_module("ambid.job.prediction"), name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Reason:
    """Why a result is not simply usable."""

    check: str  # its name; ``"status"`` for the search itself
    text: str  # what was found, and what to do
    grave: bool = False  # whether nothing of the result is to be used
    cause: str = ""  # what explains it best, where that is known: its size, and what explains it about as well
    size: float | None = None
    alternatives: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Whether a result may be used, and what stands against it."""

    word: Literal["usable", "caution", "unusable"]
    reasons: tuple[Reason, ...]

    @classmethod
    def of(cls, reasons: tuple[Reason, ...]) -> Verdict:
        """Judge by what stands against a result; grave reasons first."""
        ordered = tuple(sorted(reasons, key=lambda r: not r.grave))
        grave = any(r.grave for r in ordered)
        return cls(word="unusable" if grave else "caution" if ordered else "usable", reasons=ordered)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordEntry:
    """What a result remembers of a record, as its document has it by name."""

    file: str = ""
    sha256: str = ""
    samples: int = 0
    rate_hz: float = math.nan
    start_s: float = 0.0
    speed: float = 0.0  # rad/s
    periods: int = 0
    period_s: float = math.nan
    history: tuple[str, ...] = ()  # what was done to it

    @classmethod
    def of(cls, record: Mapping[str, object]) -> RecordEntry:
        """Read an entry; what it does not have is left at its default."""
        return cls(**{f.name: _ENTRIES[str(f.type)](record[f.name]) for f in fields(cls) if record.get(f.name)})

    @property
    def name(self) -> str:
        """Its file, or "record"."""
        return self.file or "record"

    @property
    def seconds(self) -> float:
        """Its length, s."""
        return self.samples / self.rate_hz


_ENTRIES: Mapping[str, Callable[[Any], Any]] = {
    "str": str, "int": int, "float": float, "tuple[str, ...]": lambda steps: tuple(map(str, steps)),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Result:
    """What a verb gives.

    Attributes
    ----------
    used : object
        What it was made from, for its figures; None after reading it from a file. Not written, not compared.
    """

    used: Any = field(default=None, compare=False, metadata={"written": False})

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """What stands against the result."""
        return ()

    @property
    def verdict(self) -> Verdict:
        """Whether the result may be used, with reasons."""
        return Verdict.of(self.reasons)

    @property
    def passed(self) -> bool:
        """Whether the verdict is "usable"."""
        return self.verdict.word == "usable"

    def summary(self, *, width: int = 80) -> str:
        """Return the result as the command prints it: the verdict first; no colour.

        Parameters
        ----------
        width : int, optional
            Columns of the terminal.

        Returns
        -------
        str
        """
        return str(_shown("text")(self, width=width))

    def plot(self, record: object = None, *, ax: Any = None) -> Figure:
        """Draw the result, with the verdict above.

        Parameters
        ----------
        record : object, optional
            Record to draw beside it, as the function of the verb takes it. Default: the one that it was made from;
            without any (a result that was read from a file) what needs none is drawn.
        ax : matplotlib axes or several, optional
            To draw into: as many panels, the first ones, as there are axes; nothing else of their figure is touched.

        Returns
        -------
        matplotlib.figure.Figure
            Nothing opens a window: a notebook displays the last line of a cell.
        """
        figure: Figure = _shown("figure")(self, record, ax)
        return figure

    def report(self, path: str | Path, record: object = None) -> None:
        """Write a page with the result and its figures, all in one file.

        Parameters
        ----------
        path : str or Path
            Ends in ``.html`` or ``.pdf``; a page that exists is replaced.
        record : object, optional
            As `plot`.
        """
        _shown("write_page")(self, path, record)

    def save(self, path: str | Path) -> None:
        """Write the result as the command's option ``json`` does; `ambid.load` reads it back.

        Parameters
        ----------
        path : str or Path
            A result that exists is replaced, anything else is refused.
        """
        _shown("write_document")(self, path)

    def to_dict(self) -> dict[str, Any]:
        """Return what `save` writes, as plain values that `json` takes.

        Returns
        -------
        dict
        """
        document: dict[str, Any] = json.loads(_shown("document")(self))
        return document

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the result as a table; needs pandas.

        Returns
        -------
        pandas.DataFrame
            A row for each parameter, coefficient, reporting interval, frequency or channel.
        """
        table: pandas.DataFrame = _shown("dataframe")(self)
        return table

    if not TYPE_CHECKING:  # an editor and a type checker know the attributes alone

        def __getattr__(self, name: str) -> object:
            if name.startswith("_"):
                raise AttributeError(name)
            raise missing(f"a {type(self).__name__}", name, dir(self), RESULT)

    def __repr__(self) -> str:
        return str(_shown("line")(self))

    def _repr_html_(self) -> str:
        """Return the table that a notebook shows."""
        return str(_shown("notebook")(self))


class Predicting:
    """A result whose model runs on records."""

    __slots__ = ()

    @property
    def residuals(self) -> pandas.DataFrame:
        """Innovations on the record that it was made from: ``name [unit]`` by output, over time in s, SI."""
        table: pandas.DataFrame = _predicted("residuals")(self)
        return table

    def predict(
        self, record: Any, ahead: int = 1, *, rate_hz: float | None = None, units: Mapping[str, str] | None = None
    ) -> dict[str, Array]:
        """Predict the outputs of a record some samples ahead; nothing but offsets and initial state is fitted.

        Parameters
        ----------
        record : Record, file or table
            Of the same bench and rate, as the verb's function takes it.
        ahead : int, optional
            Samples; 1: each sample from all before it.
        rate_hz, units : optional
            As the verb's function.

        Returns
        -------
        dict of str to ndarray, shape (n_samples,), SI
            By output; NaN where nothing precedes.
        """
        outputs: dict[str, Array] = _predicted("predict")(self, record, ahead, rate_hz=rate_hz, units=units)
        return outputs

    def validate(self, record: Any, *, rate_hz: float | None = None, units: Mapping[str, str] | None = None) -> Any:
        """Judge the model on a further record, as ``ambid validate`` does.

        Parameters
        ----------
        record : Record, file or table
            Of the same bench and rate.
        rate_hz, units : optional
            As the verb's function.

        Returns
        -------
        Validation
        """
        return _predicted("validated")(self, record, rate_hz=rate_hz, units=units)


class Simulating:
    """A result whose model runs on inputs alone."""

    __slots__ = ()

    def simulate(self, u: Any) -> dict[str, Array]:
        """Run the model on inputs alone, from rest at the operating point, without noise.

        Parameters
        ----------
        u : ndarray, shape (n_samples,) or (n_samples, n_inputs), SI; or Record, file or table
            Inputs, at the rate of the record that the model came from, or a record that has them. Where the plant is
            unstable and the rig has a [loop], what is added to the controller's output: of a record its ``reference``.

        Returns
        -------
        dict of str to ndarray, shape (n_samples,), SI
            By output.

        Raises
        ------
        EstimationError
            If the plant is unstable and no loop is known.
        """
        outputs: dict[str, Array] = _predicted("simulate")(self, u)
        return outputs


class Linear:
    """A result that is a linear plant."""

    __slots__ = ()

    def to_control(self) -> Any:
        """Return the plant for python-control; needs the extra ``ambid[control]``.

        Returns
        -------
        control.StateSpace or control.TransferFunction
            SI units, about the operating point; without the delay of the input where the plant is continuous.
        """
        return _predicted("to_control")(self)

    def export(self, path: str | Path, to: str | None = None, *, anyway: bool = False) -> None:
        """Write the plant for another program.

        Parameters
        ----------
        path : str or Path
            Ending in ``.mat``: matrices, names, parameters with covariance. In ``.py``: a script for python-control, or
            of a rotor one that builds it for ROSS, 2.x and 3. Of an estimate also ``.c`` or ``.h``: C source, or its
            declarations. ``.fmu``: FMI 2.0 for co-simulation. An export that exists is replaced, anything else is
            refused.
        to : {"control", "ross"}, optional
            For which library a script is.
        anyway : bool, optional
            Also where the result is unusable or its record does not show a parameter; the file then says so.

        Raises
        ------
        EstimationError
            If the result should not be relied on, or there is no such file of it.
        """
        _predicted("exported")(self, path, to, anyway=anyway)
