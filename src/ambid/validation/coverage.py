"""Whether intervals hold the truth as often as they say, over many simulated records."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.errors import counted
from ambid.estimation.result import NORMAL_95, Reason, Result
from ambid.settings.caller import setting

SCHEMA = "ambid.coverage/1"
_FEW = 20  # runs below which nothing is judged
_SURE = 0.01  # chance of a false alarm of the whole table
_BIAS = 0.3  # of a standard deviation, below which a bias is not worth telling


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One simulated record: seed, verdict, why there is no result, and value and standard deviation by name, SI."""

    seed: int
    verdict: str = ""
    reason: str = ""
    values: Mapping[str, tuple[float | None, float | None]]  # None: not identifiable


@dataclass(frozen=True, slots=True, kw_only=True)
class Covered:
    """One parameter over all runs.

    Attributes
    ----------
    name : str
    truth : float, SI
    runs, unknown : int
        Runs with a value that may be used, and in which it was not identifiable.
    bias, bias_sd : float, SI
        Mean of the errors and its standard deviation.
    spread, said : float, SI
        Standard deviation of the estimates, and root mean square of those that the estimates have.
    ratio : tuple of float
        95 % interval of said / spread; 1 is honest.
    inside : int
        Runs whose 95 % interval holds the truth.
    coverage : tuple of float
        95 % interval of Wilson of that share.
    rms_z, largest_z : float
        Of error / standard deviation.
    """

    name: str
    truth: float
    runs: int
    unknown: int
    bias: float
    bias_sd: float
    spread: float
    said: float
    ratio: tuple[float, float]
    inside: int
    coverage: tuple[float, float]
    rms_z: float
    largest_z: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False, repr=False)
class Coverage(Result):
    """A job on many simulated records of one rig, beside the truth.

    Attributes
    ----------
    rig, job, settings : str
        Names, and what was asked for, JSON.
    truth, units : Mapping
        By parameter, SI.
    trials : tuple of Trial
        By seed.
    asked : int
        Number of runs that were asked for.
    seconds : float
        Of the whole, s.
    """

    rig: str
    job: str
    settings: str
    truth: Mapping[str, float]
    units: Mapping[str, str]
    trials: tuple[Trial, ...]
    asked: int
    seconds: float

    @property
    def counts(self) -> Mapping[str, int]:
        """Runs by verdict; ``failed``: without a result."""
        counter = Counter("failed" if t.reason else t.verdict for t in self.trials)
        return {word: counter[word] for word in ("usable", "caution", "unusable", "failed")}

    def z(self, name: str) -> Array:
        """Return error / standard deviation of the parameter `name` in each run that may be used, shape (runs,)."""
        value, sd = self._of(name)
        return np.asarray((value - self.truth[name]) / sd, dtype=float)

    def _of(self, name: str) -> tuple[Array, Array]:
        pairs = [
            (value, sd)
            for t in self.trials if t.verdict != "unusable"
            for value, sd in [t.values.get(name, (None, None))] if value is not None and sd
        ]  # fmt: skip
        table = np.array(pairs, dtype=float).reshape(-1, 2)
        return table[:, 0], table[:, 1]

    @property
    def rows(self) -> tuple[Covered, ...]:
        """Each parameter over all runs."""
        return tuple(row for name in self.truth for row in [self._row(name)] if row is not None)

    def _row(self, name: str) -> Covered | None:
        from scipy.stats import chi2

        value, sd = self._of(name)
        n, truth = value.size, self.truth[name]
        unknown = sum(t.values.get(name, (0.0, 0.0))[0] is None for t in self.trials if t.verdict != "unusable")
        if n < 2:
            return None
        z = (value - truth) / sd
        spread, stated = float(np.std(value, ddof=1)), float(np.sqrt(np.mean(sd**2)))
        low, high = (math.sqrt(float(chi2.ppf(p, n - 1)) / (n - 1)) for p in (0.025, 0.975))
        inside = int(np.sum(np.abs(z) < NORMAL_95))
        return Covered(
            name=name, truth=truth, runs=n, unknown=unknown, bias=float(np.mean(value) - truth),
            bias_sd=spread / math.sqrt(n), spread=spread, said=stated,
            ratio=(stated / spread * low, stated / spread * high) if spread else (math.inf, math.inf), inside=inside,
            coverage=wilson(inside, n), rms_z=float(np.sqrt(np.mean(z**2))), largest_z=float(np.max(np.abs(z))),
        )  # fmt: skip

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """Runs without a result, intervals that hold the truth too seldom, bias: beyond what chance makes."""
        from scipy.special import ndtri
        from scipy.stats import binom

        reasons, rows = [], self.rows
        if self.counts["failed"]:
            text = f"{self.counts['failed']} of {counted(len(self.trials), 'run')} failed; the reasons are below"
            reasons.append(Reason(check="failures", text=text, grave=not rows))
        if len(self.trials) < self.asked:
            text = f"{len(self.trials)} of {counted(self.asked, 'run')} were done"
            reasons.append(Reason(check="interrupted", text=text))
        if not rows or max(row.runs for row in rows) < _FEW:
            text = f"fewer than {_FEW} runs say nothing of coverage. Raise {setting('runs')}"
            return (*reasons, Reason(check="runs", text=text))
        alone = _SURE / (2 * len(rows))
        seldom = [r for r in rows if r.runs >= _FEW and binom.cdf(r.inside, r.runs, 0.95) < alone]
        if seldom:
            text = ", ".join(f"{r.name} {100 * r.inside / r.runs:.3g} %" for r in seldom)
            reasons.append(Reason(check="coverage", text=f"95 % intervals hold the truth too seldom: {text}"))
        far = [
            r for r in rows
            if r.runs >= _FEW and abs(r.bias) > max(-float(ndtri(alone / 2)) * r.bias_sd, _BIAS * r.said)
        ]  # fmt: skip
        if far:
            text = ", ".join(f"{r.name} {r.bias / r.said:+.2g} standard deviations" for r in far)
            reasons.append(Reason(check="bias", text=f"estimates are biased: {text}"))
        return tuple(reasons)


def wilson(inside: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, Wilson (1927)."""
    z2 = NORMAL_95**2
    middle, half = inside + z2 / 2, NORMAL_95 * math.sqrt(inside * (n - inside) / n + z2 / 4)
    return max(0.0, (middle - half) / (n + z2)), min(1.0, (middle + half) / (n + z2))
