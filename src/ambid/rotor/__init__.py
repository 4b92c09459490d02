"""Physical parameters of rotors on many axes: period spectra, bending modes, speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.rotor.balance import balance_by_trials as balance_by_trials
    from ambid.rotor.estimate import RotorEstimate as RotorEstimate

__getattr__, __dir__, __all__ = exports(__name__)
