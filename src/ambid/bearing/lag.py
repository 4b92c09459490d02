"""Whether position and current belong to the same instants: a channel that lags is no plant.

The rotor's equation x'' = -(k_x/m) x + (k_i/m) i + constant is regressed over frequencies (`take_moments`: nothing
measured is differentiated) with the current taken some samples later or earlier: where it explains most is the lag of
one channel behind the other. A delay of the voltage is the model's own, and one of both channels is the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.bearing.multistart import Signals, Spectrum, take_moments
from ambid.estimation.estimate import Check
from ambid.estimation.predictor import busiest
from ambid.physics.linear_model import LinearModel

_LOOKED = 16384  # samples
_FARTHEST = 40  # samples
_BANDS = (0.15, 0.06, 0.025)  # of the Nyquist frequency: above, the noise of the position counts most
_FEWEST = 20  # lines
_SHARE = 0.7  # of the acceleration that has to be explained before a lag is one
_SURE = 4.0  # standard deviations
_LEAST = 0.5  # samples: a smaller lag moves parameters by a percent at most
_ALIKE = 48.0  # over the lines: rise of what is left over that is no more than chance, 4 sd, of lines joined in threes
_STEPS = 3
_REACH = 8  # lines whose products count, less and less: twice the width of the window's main lobe
_JOINED, _HELD = 3, 0.9  # lines that are left out together, and the most that they may be said to hold of themselves


@dataclass(frozen=True, slots=True, kw_only=True)
class Lag:
    """How much later the position is logged than the current; negative: the current lags."""

    samples: float
    sd: float
    share: float  # part of the acceleration that is explained with it

    @property
    def shown(self) -> bool:
        """Whether the record shows a lag that counts."""
        return self.share > _SHARE and abs(self.samples) - _SURE * self.sd > _LEAST

    @property
    def channel(self) -> str:
        """The channel that is late."""
        return "position" if self.samples > 0 else "current"

    def describe(self, rate_hz: float) -> str:
        """Return what is late, by how much, and the remedy."""
        late, other = abs(self.samples), "current" if self.samples > 0 else "position"
        whole = f", or give channels.{self.channel}.delay = {round(late)}" if round(late) else ""
        size = f"{late:.2g} samples ({1e3 * late / rate_hz:.3g} ms)"
        return (
            f"channel {self.channel!r} lags behind {other} by {size}. Sample both at the same instant and filter them "
            f"alike{whole}" + ("; or eddy currents delay the force" if self.samples > 0 else "")
        )


def lag_of(signals: Signals) -> Lag | None:
    """Measure the lag between position and current of a record of model one-axis; None where nothing moves."""
    at = busiest(signals.u, _LOOKED)
    x, i = (signals.y[at] - signals.y[at].mean(axis=0)).T
    m = take_moments({"position": x, "current": i}, (), signals.rate_hz)
    turn = m.omega / signals.rate_hz  # rad per sample
    best: tuple[float, int, slice] = (0.0, 0, slice(0))
    for band in _BANDS:
        lines = slice(3, int(band * m.omega.size))
        if lines.stop - lines.start >= _FEWEST:
            rows = _rows(m.signals["position"], m.signals["current"][0], m.omega, lines)
            best = max(best, (*_coarse(*rows, turn[lines]), lines), key=lambda b: b[0])
    share, whole, lines = best
    if share <= 0.0:
        return None
    target, stiffness, current = _rows(m.signals["position"], m.signals["current"][0], m.omega, lines)
    samples, sd = float(whole), np.inf
    for _ in range(_STEPS):  # Gauss-Newton on the fraction
        moved = current * np.exp(-1j * turn[lines] * samples)
        terms = np.column_stack([_real(stiffness), _real(moved), _real(-1j * turn[lines] * moved)])
        size = np.linalg.norm(terms, axis=0)
        values = np.linalg.lstsq(terms / size, _real(target), rcond=None)[0]
        force = float(values[1] / size[1]) or np.inf
        samples += float(np.clip(values[2] / size[2] / force, -0.5, 0.5))
        sd = _sd(terms / size, _real(target) - terms / size @ values) / size[2] / abs(force)
    return Lag(samples=samples, sd=sd, share=share)


def late(model: LinearModel, signals: Signals) -> bool:
    """Whether position or current of a record lag."""
    found = lag_of(signals) if model.name == "one-axis" else None
    return found is not None and found.shown


def check_lag(signals: Signals) -> Check:
    """Check that position and current are logged at the same instants."""
    found = lag_of(signals)
    if found is None or found.share <= _SHARE:
        return Check(passed=True, detail="the current explains too little of the motion to tell whether a channel lags")
    values = {"samples": found.samples, "sd": found.sd}
    if found.shown:
        return Check(passed=False, values=values, detail=found.describe(signals.rate_hz))
    detail = f"position and current are logged at the same instants (lag {found.samples:.2g} ± {found.sd:.1g} samples)"
    return Check(passed=True, values=values, detail=detail)


def without_lag(signals: Signals, lag: Lag) -> Signals:
    """Return a record whose late channel is taken earlier by whole samples, at the cost of its end."""
    k = round(abs(lag.samples))
    n = len(signals.u) - k
    x, i = signals.y.T
    moved = (x[k:], i[:n]) if lag.samples > 0 else (x[:n], i[k:])
    return replace(signals, u=signals.u[:n], y=np.column_stack(moved))


def _rows(
    position: tuple[Spectrum, Spectrum, Spectrum], current: Spectrum, omega: Array, lines: slice
) -> tuple[Spectrum, Spectrum, Spectrum]:
    """Acceleration, position and current over some lines, weighted so that low and high ones count alike."""
    weight = 1.0 / (omega[lines] + omega[lines][-1] / 3.0) ** 2
    return position[2][lines] * weight, position[0][lines] * weight, current[lines] * weight


def _coarse(target: Spectrum, stiffness: Spectrum, current: Spectrum, turn: Array) -> tuple[float, int]:
    """The whole lag at which most is explained, and how much; of several that explain as much the smallest.

    Where one resonance has most of the motion, half of its period later the current explains as much with the other
    sign.
    """
    if not (np.any(target) and np.any(stiffness) and np.any(current)):
        return 0.0, 0
    power, size = (float(np.vdot(x, x).real) for x in (target, current))
    aside = stiffness / float(np.linalg.norm(stiffness))
    goal = target - aside * float(np.vdot(aside, target).real)
    unexplained = float(np.vdot(goal, goal).real)
    shares = np.empty(2 * _FARTHEST + 1)
    moved, step = current * np.exp(1j * turn * _FARTHEST), np.exp(-1j * turn)
    for k in range(shares.size):
        own = size - float(np.vdot(aside, moved).real) ** 2  # of what position does not explain of the current
        shares[k] = 1.0 - (unexplained - float(np.vdot(moved, goal).real) ** 2 / own) / power
        moved = moved * step
    alike = (1.0 - shares.max()) * (1.0 + _ALIKE / turn.size)
    near = np.flatnonzero(1.0 - shares <= alike) - _FARTHEST
    at = int(near[np.argmin(np.abs(near))])
    return float(shares[at + _FARTHEST]), at


def _sd(terms: Array, left: Array) -> float:
    """Standard deviation of the last coefficient, whatever the spectrum of what is `left` is.

    The window makes neighbouring lines alike, and a few high ones count most. So the products of lines that the window
    joins are summed (Newey and West 1987), and each is judged as if it and its neighbours had been left out (MacKinnon
    and White 1985): over sound records the lag found over this has a root mean square of 1, without it of 2 to 3.
    """
    inverse, n = np.linalg.pinv(terms.T @ terms), left.size // 2  # real parts of the lines, then imaginary ones
    leverage = np.einsum("ij,jk,ik->i", terms, inverse, terms)
    held = np.convolve(leverage[:n] + leverage[n:], np.ones(_JOINED), "same")
    each = terms @ inverse[2] * left
    scores = (each[:n] + each[n:]) / (1.0 - np.minimum(held, _HELD))
    sums = [(1.0 - k / _REACH) * float(scores[k:] @ scores[: n - k]) for k in range(_REACH)]
    return float(np.sqrt(2.0 * sum(sums) - sums[0]))


def _real(x: Spectrum) -> Array:
    return np.concatenate([x.real, x.imag])
