"""Signals: conditioning of records, excitation, spectra, signal-to-noise ratio, delay."""

from ambid.signals.delay import Delay, find_delay
from ambid.signals.dropouts import Dropouts, find_dropouts
from ambid.signals.excitation import EXCITATIONS, excitation
from ambid.signals.filters import lowpass, resample
from ambid.signals.kalman_bucy import kalman_bucy, kalman_bucy_gain, passive_lowpass
from ambid.signals.multisine import crest_factor, multisine, schroeder_phases
from ambid.signals.outliers import Outliers, find_outliers
from ambid.signals.persistence import PersistentExcitation, persistent_excitation
from ambid.signals.resolution import Resolution, resolution
from ambid.signals.samples import cut, replace_samples, scale
from ambid.signals.saturation import Limit, Saturation, find_saturation
from ambid.signals.snr import Snr, snr
from ambid.signals.spectra import PowerSpectrum, coherence, power_spectrum
from ambid.signals.trend import remove_offset, remove_trend
from ambid.signals.waveforms import chirp, gaussian, prbs, steps

__all__ = [
    "EXCITATIONS",
    "Delay",
    "Dropouts",
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
    "cut",
    "excitation",
    "find_delay",
    "find_dropouts",
    "find_outliers",
    "find_saturation",
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
