"""What stands around a plant on a bench: the control loop, the limits and the noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ambid.errors import ModelError
from ambid.physics.law import StateLaw

Interval = tuple[float, float]
UNLIMITED: Interval = (-math.inf, math.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """Discrete-time PID on the position, with current feedback, or a `StateLaw`; and the delay of its output.

    u[k] = u0 + kp e[k] + I[k] + D[k] - kc (i[k] - i0) + excitation[k], with e = setpoint - x, I[k+1] = I[k] + ki T
    e[k], D[k] = (tau D[k-1] - kd (x[k] - x[k-1])) / (tau + T), tau = 1/(2 pi cutoff). While u is limited, I may only
    move back (anti-windup). All gains zero: open loop. x and i are the logged values (with noise and quantisation);
    u[k] acts from t_k + delay on, held for a sample.
    """

    kp: float = 0.0  # in V/m, V/(m s) and V s/m
    ki: float = 0.0
    kd: float = 0.0
    # in V/A; it acts as a resistance and makes the coil fast, as a transconductance amplifier does (thesis eq. 1.5).
    kc: float = 0.0
    derivative_cutoff_hz: float = math.inf  # cut-off of the derivative filter in Hz; infinite for none
    # delay between the logged voltage and the coil in samples; fractions allowed. It acts in open loop too.
    delay: float = 0.0
    law: StateLaw | None = None  # in place of the gains, which are then zero

    def __post_init__(self) -> None:
        if self.law is not None and any((self.kp, self.ki, self.kd, self.kc)):
            raise ModelError("the loop has gains and a state-space law; one of them orders. Give the one or the other")
        for name in ("kp", "ki", "kd", "kc"):
            if not math.isfinite(getattr(self, name)):
                raise ModelError(f"loop.{name} is {getattr(self, name)}; a gain must be a finite number. Correct it")
        if not self.derivative_cutoff_hz > 0.0:
            raise ModelError(
                f"loop.derivative_cutoff_hz is {self.derivative_cutoff_hz} Hz; it must be positive."
                " Give inf for no filter"
            )
        if not (math.isfinite(self.delay) and self.delay >= 0.0):
            raise ModelError(f"loop.delay is {self.delay} samples; it must be zero or positive. Correct it")

    @property
    def closed(self) -> bool:
        """True where any gain acts."""
        return self.law is not None or any((self.kp, self.ki, self.kd, self.kc))

    @property
    def filter_s(self) -> float:
        """Time constant tau of the derivative filter in s; 0 for none."""
        return 0.0 if math.isinf(self.derivative_cutoff_hz) else 1.0 / (2.0 * math.pi * self.derivative_cutoff_hz)

    def scaled(self, position: float, current: float) -> Loop:
        """Return the loop that sees position and current multiplied by these factors."""
        if self.law is not None:
            each = [position, current] if self.law.D.shape[1] > self.law.D.shape[0] else [position]
            return replace(self, law=self.law.scaled(each * self.law.D.shape[0]))
        p = position
        return replace(self, kp=p * self.kp, ki=p * self.ki, kd=p * self.kd, kc=current * self.kc)

    @property
    def pull(self) -> float:
        """What the command answers to a slow motion of the first axis, with the sign of kp: V/m, of a law at a
        hundredth of its rate."""
        if self.law is None:
            return self.kp
        return -float(self.law.response(np.array([0.01 * self.law.rate_hz]))[0, 0, 0].real)

    def as_law(self, rate_hz: float, *, current: bool = True) -> StateLaw:
        """Return the law of one axis, of the gains with the states I and tau D + kd x; `current`: whether the axis
        feeds it back. Where the command is limited its integral is tracked back with time constant kp/ki, which a PID
        stops.
        """
        if self.law is not None:
            return self.law
        period, tau = 1.0 / rate_hz, self.filter_s
        pole = tau / (tau + period)
        fast = self.kd / (tau + period)
        back = min(abs(self.ki * period / self.kp), 1.0) if self.kp else float(bool(self.ki))
        n_y = 1 + current
        return StateLaw(
            A=np.diag([1.0, pole]),
            B=np.array([[-self.ki * period, 0.0], [self.kd * (1.0 - pole), 0.0]])[:, :n_y],
            C=np.array([[1.0, 1.0 / (tau + period)]]),
            D=np.array([[-self.kp - fast, -self.kc]])[:, :n_y],
            G=np.array([[back], [0.0]]),
            rate_hz=rate_hz,
        )

    def opened(self) -> Loop:
        """Return the open loop with the same delay."""
        return Loop(delay=self.delay)


@dataclass(frozen=True, slots=True, kw_only=True)
class Limits:
    """Intervals in which a bench works.

    Attributes
    ----------
    voltage : (float, float), V
        What the amplifier can give: the command is limited to it, and that is counted.
    current : (float, float), A
        What the coil may carry: going beyond is counted, not prevented.
    position : (float, float), m
        Where the rotor touches: it is stopped there without rebound, and the first contact is reported.
    """

    voltage: Interval = UNLIMITED
    current: Interval = UNLIMITED
    position: Interval = UNLIMITED

    def __post_init__(self) -> None:
        for name in ("voltage", "current", "position"):
            low, high = getattr(self, name)
            if not low < high:
                raise ModelError(
                    f"limits.{name} is ({low}, {high}); the lower must be below the upper. Swap or correct them"
                )


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Process noise, sensor noise and resolutions.

    A white force of one-sided density s (N/sqrt(Hz)), held over a sample, has the rms s sqrt(rate/2).

    Attributes
    ----------
    position, current : float
        White sensor noise in m rms and A rms.
    force, voltage : float
        One-sided densities of the process noise in N/sqrt(Hz) and V/sqrt(Hz).
    position_resolution, current_resolution, voltage_resolution : float
        Steps of the logged values in m, A and V; 0 for none. The voltage's is that of the command itself.
    """

    position: float = 0.0
    current: float = 0.0
    force: float = 0.0
    voltage: float = 0.0
    position_resolution: float = 0.0
    current_resolution: float = 0.0
    voltage_resolution: float = 0.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise ModelError(f"noise.{name} is {value}; it must be zero or positive. Correct it")

    @classmethod
    def held(
        cls, *, rate_hz: float, force: float = 0.0, voltage: float = 0.0, position: float = 0.0, current: float = 0.0
    ) -> Noise:
        """Return the noise whose process part, held over a sample, has the given rms.

        Parameters
        ----------
        rate_hz : float
            Sampling rate in Hz at which the rms hold.
        force, voltage, position, current : float
            In N, V, m and A rms.

        Returns
        -------
        Noise
            With densities rms / sqrt(rate/2).
        """
        root = math.sqrt(rate_hz / 2.0)
        return cls(force=force / root, voltage=voltage / root, position=position, current=current)

    def held_rms(self, rate_hz: float) -> tuple[float, float]:
        """Return the rms of force in N and voltage in V, held over a sample at `rate_hz` in Hz."""
        root = math.sqrt(rate_hz / 2.0)
        return self.force * root, self.voltage * root

    def sensor_rms(self, kind: str) -> float:
        """Return the rms of a sensor's noise with that of rounding to its steps.

        Parameters
        ----------
        kind : {"position", "current"}

        Returns
        -------
        float
            m, or A.
        """
        return math.hypot(getattr(self, kind), getattr(self, f"{kind}_resolution") / math.sqrt(12.0))


def placed_loop(
    parameters: Mapping[str, float],
    poles: Sequence[complex],
    *,
    derivative_cutoff_hz: float = math.inf,
    delay: float = 0.0,
) -> Loop:
    """Return the PID with current feedback that places the four poles of the continuous ``one-axis`` loop.

    Equates m L s^4 + (m r + c L) s^3 + (k_x L + c r + k_i^2 + k_i kd) s^2 + (k_x r + k_i kp) s + k_i ki, r = R + kc,
    with m L prod(s - p). Filter, sampling and delay are left out: check with `ambid.simulation.closed_loop_poles`.

    Parameters
    ----------
    parameters : Mapping[str, float]
        m, k_x, k_i, R, L, c in SI units.
    poles : Sequence of complex
        Four, in rad/s, complex ones in conjugate pairs.
    derivative_cutoff_hz, delay : float
        Passed on to the loop, in Hz and samples.

    Returns
    -------
    Loop

    Raises
    ------
    ModelError
        If the poles are not four in conjugate pairs, or k_i is zero.
    """
    m, k_x, k_i, r, ell, c = (parameters[k] for k in ("m", "k_x", "k_i", "R", "L", "c"))
    wanted = np.poly(np.asarray(poles, dtype=np.complex128))
    if wanted.size != 5 or np.abs(wanted.imag).max() > 1e-9 * np.abs(wanted).max():
        raise ModelError(
            f"{len(poles)} poles were given; a placed loop needs four, in conjugate pairs. Correct the poles"
        )
    if k_i == 0.0:
        raise ModelError("k_i is 0 N/A; no loop can act without a force–current factor. Give k_i")
    a3, a2, a1, a0 = (m * ell * wanted.real[1:]).tolist()
    total = (a3 - c * ell) / m
    return Loop(
        kp=(a1 - k_x * total) / k_i,
        ki=a0 / k_i,
        kd=(a2 - k_x * ell - c * total - k_i**2) / k_i,
        kc=total - r,
        derivative_cutoff_hz=derivative_cutoff_hz,
        delay=delay,
    )
