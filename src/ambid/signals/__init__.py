"""Signals: conditioning of records, excitation, spectra, frequency responses, signal-to-noise ratio, delay."""

from ambid.signals.conditioning import cut, lowpass, remove_offset, remove_trend, replace_samples, resample, scale
from ambid.signals.delay import Delay, PersistentExcitation, find_delay, persistent_excitation
from ambid.signals.excitation import (
    EXCITATIONS,
    chirp,
    crest_factor,
    excitation,
    gaussian,
    multisine,
    prbs,
    schroeder_phases,
    steps,
)
from ambid.signals.faults import (
    Dropouts,
    Limit,
    Outliers,
    Resolution,
    Saturation,
    find_dropouts,
    find_outliers,
    find_saturation,
    resolution,
)
from ambid.signals.frf import frequency_response
from ambid.signals.frf_local import frf_local
from ambid.signals.frf_periodic import Distortions, find_experiments, find_period, frf_periodic
from ambid.signals.frf_random import frf_random
from ambid.signals.kalman_bucy import kalman_bucy, kalman_bucy_gain, passive_lowpass
from ambid.signals.response import FrequencyResponse
from ambid.signals.snr import Snr, snr
from ambid.signals.spectra import CrossSpectra, PowerSpectrum, coherence, cross_spectra, power_spectrum

__all__ = [
    "EXCITATIONS",
    "CrossSpectra",
    "Delay",
    "Distortions",
    "Dropouts",
    "FrequencyResponse",
    "Limit",
    "Outliers",
    "PersistentExcitation",
    "PowerSpectrum",
    "Resolution",
    "Saturation",
    "Snr",
    "chirp",
    "coherence",
    "crest_factor",
    "cross_spectra",
    "cut",
    "excitation",
    "find_delay",
    "find_dropouts",
    "find_experiments",
    "find_outliers",
    "find_period",
    "find_saturation",
    "frequency_response",
    "frf_local",
    "frf_periodic",
    "frf_random",
    "gaussian",
    "kalman_bucy",
    "kalman_bucy_gain",
    "lowpass",
    "multisine",
    "passive_lowpass",
    "persistent_excitation",
    "power_spectrum",
    "prbs",
    "remove_offset",
    "remove_trend",
    "replace_samples",
    "resample",
    "resolution",
    "scale",
    "schroeder_phases",
    "snr",
    "steps",
]
