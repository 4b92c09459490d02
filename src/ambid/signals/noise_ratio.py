"""Signal-to-noise ratio σ²_signal/σ²_noise of a channel (thesis fig. 5.7): noise is what nothing predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
) -> Snr:
    """Estimate the signal-to-noise ratio of a channel.

    Noise is what a high-order (auto)regression cannot predict: the variance of its one-step error, fitted by QR.

    Parameters
    ----------
    record : Record
        The record.
    name : str
        Channel.
    inputs : str or sequence of str
        Channels that drive it, for the prediction; without them an unpredictable excitation counts as noise and the
        ratio is a lower bound.
    order : int
        Lags of the channel and of each input in the prediction.

    Returns
    -------
    Snr
        The ratio in dB with the method stated.

    Raises
    ------
    RecordError
        If the channel is among its own inputs.
    EstimationError
        If the record is too short for `order`.
    """
    y = finite(record, name)
    driving = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    if name in driving:
        raise RecordError(f"snr of {name!r} lists the channel among its own inputs. Omit it there")
    noise, spread = 0.0, float(np.std(y))
    if spread > 0.0:
        u = [finite(record, n) for n in driving]
        scaled = [(x - x.mean()) / (x.std() or 1.0) for x in u]
        fit = fit_arx((y - y.mean()) / spread, scaled, order, range(order + 1) if scaled else ())
        noise = fit.variance * spread**2
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
