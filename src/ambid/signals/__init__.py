"""Signals: conditioning of records, excitation, spectra, frequency responses, signal-to-noise ratio, delay."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.record import cut as cut
    from ambid.signals.conditioning import remove_trend as remove_trend
    from ambid.signals.conditioning import replace_samples as replace_samples
    from ambid.signals.conditioning import resample as resample
    from ambid.signals.delay import find_delay as find_delay
    from ambid.signals.delay import persistent_excitation as persistent_excitation
    from ambid.signals.excitations import AXES_EXCITATIONS as AXES_EXCITATIONS
    from ambid.signals.excitations import EXCITATIONS as EXCITATIONS
    from ambid.signals.excitations import crest_factor as crest_factor
    from ambid.signals.excitations import excitation as excitation
    from ambid.signals.excitations import excitation_of_axes as excitation_of_axes
    from ambid.signals.excitations import multisine as multisine
    from ambid.signals.faults import find_dropouts as find_dropouts
    from ambid.signals.faults import find_outliers as find_outliers
    from ambid.signals.faults import find_saturation as find_saturation
    from ambid.signals.faults import resolution as resolution
    from ambid.signals.frf import frequency_response as frequency_response
    from ambid.signals.periodic_response import find_period as find_period
    from ambid.signals.response import FrequencyResponse as FrequencyResponse
    from ambid.signals.spectra import cross_spectra as cross_spectra
    from ambid.signals.spectra import power_spectrum as power_spectrum
    from ambid.signals.spectra import snr as snr

__getattr__, __dir__, __all__ = exports(__name__)
