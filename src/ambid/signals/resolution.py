"""Resolution of a channel: the spacing of the levels that its converter gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.record.record import Record
from ambid.signals._channels import finite


@dataclass(frozen=True, slots=True, kw_only=True)
class Resolution:
    """Quantisation of a channel.

    Attributes
    ----------
    channel : str
        Channel looked at.
    unit : str
        Its unit.
    step : float
        Typical smallest spacing of neighbouring levels, in `unit`; 0 for a channel with one level.
    n_levels : int
        Number of different values.
    n_samples : int
        Number of samples.
    uniform : float
        Part of the spacings that are whole multiples of `step` within 5 %; near 1 for a linear converter, less behind
        a calibration curve.
    """

    channel: str
    unit: str
    step: float
    n_levels: int
    n_samples: int
    uniform: float

    @property
    def quantised(self) -> bool:
        """Whether values repeat enough (on average at least twice) for `step` to be a property of the converter."""
        return 2 * self.n_levels <= self.n_samples

    @property
    def noise_sd(self) -> float:
        """Standard deviation of rounding to `step`, step/√12, in `unit`; 0 if not quantised."""
        return self.step / float(np.sqrt(12.0)) if self.quantised else 0.0

    def __str__(self) -> str:
        if self.n_levels == 1:
            return f"{self.channel}: constant"
        if not self.quantised:
            return f"{self.channel}: not quantised ({self.n_levels} values in {self.n_samples} samples)"
        shape = "" if self.uniform > 0.9 else ", unevenly spaced"
        return f"{self.channel}: quantised in steps of {self.step:.3g} {self.unit} ({self.n_levels} levels{shape})"


def resolution(record: Record, name: str) -> Resolution:
    """Find the quantisation step of a channel.

    Parameters
    ----------
    record : Record
        The record to look at.
    name : str
        Channel.

    Returns
    -------
    Resolution
        Spacing and number of levels.

    Raises
    ------
    RecordError
        If the channel cannot be used.
    """
    x = finite(record, name)
    spacings = _spacings(x)
    step = level_spacing(x)
    multiples = spacings / step if step else spacings
    on_grid = float(np.mean(np.abs(multiples - np.round(multiples)) < 0.05)) if spacings.size else 1.0
    return Resolution(
        channel=name,
        unit=record.channel(name).unit,
        step=step,
        n_levels=spacings.size + 1,
        n_samples=x.size,
        uniform=on_grid,
    )


def level_spacing(x: Array) -> float:
    """Return the typical smallest spacing between neighbouring levels.

    The median of the spacings up to 1.5 times their 10 % quantile, which neither a few odd pairs of levels
    (calibration, clipping) nor missing levels move.

    `x`: (n_samples,), any unit, samples. Returns spacing in the unit of `x`; 0 if all samples are equal.
    """
    spacings = _spacings(x)
    if not spacings.size:
        return 0.0
    return float(np.median(spacings[spacings <= 1.5 * np.quantile(spacings, 0.1)]))


def _spacings(x: Array) -> Array:
    """Differences of neighbouring levels, without those that are only round-off of one level."""
    spacings: Array = np.diff(np.unique(x))
    return spacings[spacings > 1e-12 * max(float(np.max(np.abs(x))), 1e-300)]
