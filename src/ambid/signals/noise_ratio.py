"""Signal-to-noise ratio σ²_signal/σ²_noise of a channel (thesis fig. 5.7), by three methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import RecordError
from ambid.record.record import Record
from ambid.signals.conditioning import finite
from ambid.signals.delay import fit_arx


@dataclass(frozen=True, slots=True, kw_only=True)
class Snr:
    """Signal-to-noise ratio of a channel.

    Attributes
    ----------
    channel, unit : str
        Channel and its unit.
    db : float
        10·log10(σ²_signal/σ²_noise); inf without noise, -inf without signal.
    signal_sd, noise_sd : float
        Standard deviations in `unit`. The mean counts as neither.
    method : str
        How the noise was told from the signal, in words.
    """

    channel: str
    unit: str
    db: float
    signal_sd: float
    noise_sd: float
    method: str

    def __str__(self) -> str:
        return f"{self.channel}: SNR {self.db:.1f} dB, noise {self.noise_sd:.3g} {self.unit} rms ({self.method})"


def snr(
    record: Record,
    name: str,
    *,
    inputs: str | Sequence[str] = (),
    order: int = 20,
    period_s: float | None = None,
    floor: bool = False,
) -> Snr:
    """Estimate the signal-to-noise ratio of a channel.

    By default noise is what a high-order (auto)regression cannot predict. With `period_s`, it is what differs between
    periods of the excitation, which needs no model at all. With `floor`, it is the density at the top of the spectrum,
    taken as white.

    Parameters
    ----------
    record : Record
        The record, with at least two periods where `period_s` is given.
    name : str
        Channel.
    inputs : str or sequence of str
        Channels that drive it, for the prediction; without them an unpredictable excitation counts as noise and the
        ratio is a lower bound.
    order : int
        Lags of the channel and of each input in the prediction.
    period_s : float, optional
        Period of the excitation in s, a whole number of samples.
    floor : bool
        Use the high-frequency floor.

    Returns
    -------
    Snr
        The ratio in dB with the method stated.

    Raises
    ------
    RecordError
        If two methods are asked for, or the period does not fit the record.
    EstimationError
        If the record is too short for `order`.
    """
    y = finite(record, name)
    driving = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    if (period_s is not None) + floor + bool(driving) > 1:
        raise RecordError(
            f"snr of {name!r} got more than one of inputs, period_s and floor; each is a method. Give one"
        )
    if name in driving:
        raise RecordError(f"snr of {name!r} lists the channel among its own inputs. Take it out")
    if period_s is not None:
        samples = _whole_period(record, period_s)
        noise = noise_between_periods(y, samples)
        method = f"deviation from the mean of {y.size // samples} periods of {period_s:g} s"
    elif floor:
        noise = noise_at_floor(y, record.rate_hz)
        method = f"white floor of the spectrum over {0.4 * record.rate_hz:g} to {0.475 * record.rate_hz:g} Hz"
    else:
        noise = noise_of_prediction(y, [finite(record, n) for n in driving], order)
        by = f" and inputs {', '.join(driving)}" if driving else ", no inputs: a lower bound"
        method = f"one-step prediction error, {order} lags of the channel{by}"
    total = float(np.var(y))
    noise = min(noise, total)
    signal = total - noise
    with np.errstate(divide="ignore", invalid="ignore"):
        db = float(10.0 * (np.log10(signal) - np.log10(noise))) if total > 0 else -np.inf
    return Snr(
        channel=name,
        unit=record.channel(name).unit,
        db=db,
        signal_sd=float(np.sqrt(signal)),
        noise_sd=float(np.sqrt(noise)),
        method=method,
    )


def _whole_period(record: Record, period_s: float) -> int:
    exact = period_s * record.rate_hz
    samples = round(exact)
    if samples < 2 or abs(exact - samples) > 1e-6 * samples:
        raise RecordError(
            f"a period of {period_s:g} s is {exact:g} samples at {record.rate_hz:g} Hz; it must be a whole number, "
            f"at least 2. Give the exact period"
        )
    if record.n_samples < 2 * samples:
        raise RecordError(
            f"the record of {record.duration_s:g} s holds less than two periods of {period_s:g} s; noise shows "
            f"between periods. "
            "Use another method"
        )
    return samples


def noise_between_periods(y: Array, period: int) -> float:
    """Return the noise variance as the variance around the mean period, for P periods times P/(P - 1).

    The whole periods at the end of `y` are used; transients of the first one count as noise unless they are cut.

    `y`: (n_samples,), any unit, response to a periodic excitation; `period`: period in samples. Returns noise variance
    in the unit of `y` squared.
    """
    count = y.size // period
    periods = y[y.size - count * period :].reshape(count, period)
    return float(np.sum((periods - periods.mean(axis=0)) ** 2) / ((count - 1) * period))


def noise_of_prediction(y: Array, inputs: Sequence[Array] = (), order: int = 20) -> float:
    """Return the variance of the one-step prediction error of an autoregression with inputs, fitted by QR.

    `y`: (n_samples,), any unit, channel; `inputs`: inputs; lags 0 … `order` are used; `order`: lags. Returns
    innovations variance in the unit of `y` squared.
    """
    spread = float(np.std(y))
    if spread == 0.0:
        return 0.0
    scaled = [(u - u.mean()) / (u.std() or 1.0) for u in inputs]
    fit = fit_arx((y - y.mean()) / spread, scaled, order, range(order + 1) if scaled else ())
    return fit.variance * spread**2


def noise_at_floor(y: Array, rate_hz: float) -> float:
    """Return the variance of white noise with the median density over 0.8 to 0.95 of half the rate.

    `y`: (n_samples,), any unit, channel whose signal lies under 0.8 of half the rate; `rate_hz`: sampling rate in Hz.
    Returns noise variance in the unit of `y` squared.
    """
    from ambid.signals.spectra import power_spectrum

    spectrum = power_spectrum(y, rate_hz)
    top = (spectrum.frequency_hz >= 0.4 * rate_hz) & (spectrum.frequency_hz <= 0.475 * rate_hz)
    return float(np.median(spectrum.density[top])) * rate_hz / 2.0
