"""Signals: conditioning of records, excitation, spectra, frequency responses, signal-to-noise ratio, delay."""

from ambid.signals._distortion import Distortions
from ambid.signals._periodicity import find_experiments, find_period
from ambid.signals.delay import Delay, find_delay
from ambid.signals.dropouts import Dropouts, find_dropouts
from ambid.signals.excitation import EXCITATIONS, excitation
from ambid.signals.filters import lowpass, resample
from ambid.signals.frf import FrequencyResponse, frequency_response
from ambid.signals.frf_local import frf_local
from ambid.signals.frf_periodic import frf_periodic
from ambid.signals.frf_random import frf_random
from ambid.signals.kalman_bucy import kalman_bucy, kalman_bucy_gain, passive_lowpass
from ambid.signals.multisine import crest_factor, multisine, schroeder_phases
from ambid.signals.outliers import Outliers, find_outliers
from ambid.signals.persistence import PersistentExcitation, persistent_excitation
from ambid.signals.resolution import Resolution, resolution
from ambid.signals.samples import cut, replace_samples, scale
from ambid.signals.saturation import Limit, Saturation, find_saturation
from ambid.signals.snr import Snr, snr
from ambid.signals.spectra import CrossSpectra, PowerSpectrum, coherence, cross_spectra, power_spectrum
from ambid.signals.trend import remove_offset, remove_trend
from ambid.signals.waveforms import chirp, gaussian, prbs, steps

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
