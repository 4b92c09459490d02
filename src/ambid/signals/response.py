"""A measured frequency response with its uncertainty: the noun of the frequency domain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError

Hold = Literal["zoh", "band-limited"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrequencyResponse:
    """A measured frequency response with its uncertainty.

    Errors are circular complex: E[dG dGᵀ] = 0, so that real and imaginary part each have half the variance.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n_f,), Hz
        Frequencies, rising, over 0 and under half the rate.
    G : complex ndarray, shape (n_f, n_y, n_u), output unit per input unit
        The response, best linear approximation where the system is not linear.
    covariance : complex ndarray, shape (n_f, n_y*n_u, n_y*n_u)
        Total: E[vec(dG) vec(dG)ᴴ], vec row by row (all inputs of the first output, then of the second).
    noise_covariance : complex ndarray, shape (n_f, n_y*n_u, n_y*n_u), or None
        The part of it that differs between periods; None where the excitation has none.
    coherence : ndarray, shape (n_f, n_y), or None
        Multiple coherence, 0 to 1: share of each output's power that the inputs (or references) explain linearly.
    method : str
        How it was measured.
    inputs, outputs : tuple of str
        Names.
    units : Mapping[str, str]
        SI unit by name.
    rate_hz : float
        Sampling rate in Hz.
    hold : {"zoh", "band-limited"}
        What the input does between the samples: with "zoh", G is the sampled plant with its hold.
    degrees_of_freedom : ndarray, shape (n_f,), or float
        Real degrees of freedom ν of the variance: ν·(estimate/truth) is χ² with ν; inf where it is known.
    lines_per_independent : float
        Neighbouring errors are correlated after windows and local fits: a quantity fitted to many lines as if they
        were independent has this many times the variance that the fit believes. 1 for periodic excitation.
    warnings : tuple of str
        What should be known before it is used.
    details : Mapping[str, object]
        Numbers of the method: periods, segments, lines, levels.
    """

    frequency_hz: Array
    G: Complex
    covariance: Complex
    noise_covariance: Complex | None = None
    coherence: Array | None = None
    method: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    units: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    rate_hz: float
    hold: Hold = "zoh"
    degrees_of_freedom: Array | float
    lines_per_independent: float = 1.0
    warnings: tuple[str, ...] = ()
    details: Mapping[str, object] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        n, n_y, n_u = self.frequency_hz.size, len(self.outputs), len(self.inputs)
        square = (n, n_y * n_u, n_y * n_u)
        for what, values, shape in (
            ("G", self.G, (n, n_y, n_u)),
            ("covariance", self.covariance, square),
            ("noise_covariance", self.noise_covariance, square),
            ("coherence", self.coherence, (n, n_y)),
        ):
            if values is not None and np.shape(values) != shape:
                raise EstimationError(
                    f"frequency response: {what} has shape {np.shape(values)}; {n} frequencies, {n_y} outputs and "
                    f"{n_u} inputs want {shape}. Correct the arrays"
                )
        if n < 1 or np.any(np.diff(self.frequency_hz) <= 0):
            raise EstimationError("frequency response: frequencies must be at least one, and rise. Sort them")
        if self.hold not in ("zoh", "band-limited"):
            raise EstimationError(f"frequency response: hold {self.hold!r}; it must be 'zoh' or 'band-limited'")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def sd(self) -> Array:
        """Standard deviation √E|dG|² of each entry, shape (n_f, n_y, n_u)."""
        return self._sd(self.covariance)

    @property
    def noise_sd(self) -> Array | None:
        """Standard deviation due to noise alone, shape (n_f, n_y, n_u); None where it was not told apart."""
        return None if self.noise_covariance is None else self._sd(self.noise_covariance)

    @property
    def distortion_variance(self) -> Array | None:
        """Variance of G due to distortion, total - noise, shape (n_f, n_y, n_u); scatters around 0 without it."""
        noise = self.noise_sd
        return None if noise is None else self.sd**2 - noise**2

    @property
    def distortion_sd(self) -> Array | None:
        """Root of `distortion_variance`, shape (n_f, n_y, n_u); 0 where that is negative."""
        variance = self.distortion_variance
        return None if variance is None else np.sqrt(np.maximum(variance, 0.0))

    @property
    def magnitude(self) -> Array:
        """|G|, shape (n_f, n_y, n_u)."""
        return np.asarray(np.abs(self.G))

    @property
    def magnitude_sd(self) -> Array:
        """Standard deviation of |G|, shape (n_f, n_y, n_u): sd/√2, for errors well under |G|."""
        return np.asarray(self.sd / np.sqrt(2.0))

    @property
    def phase_rad(self) -> Array:
        """Phase of G in rad, unwrapped along frequency, shape (n_f, n_y, n_u)."""
        return np.asarray(np.unwrap(np.angle(self.G), axis=0))

    @property
    def phase_sd_rad(self) -> Array:
        """Standard deviation of the phase in rad, shape (n_f, n_y, n_u): sd/(√2 |G|), for errors well under |G|."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.sd / np.sqrt(2.0) / np.abs(self.G))

    def confidence_radius(self, level: float = 0.95) -> Array:
        """Return the radius of the circle around each entry of G that holds the truth with the given probability.

        |dG|²/σ̂² is F-distributed with 2 and ν degrees of freedom (Pintelon and Schoukens 2012, sec. 2.4 and 4.3).

        Parameters
        ----------
        level : float
            Probability, 0 to 1.

        Returns
        -------
        ndarray, shape (n_f, n_y, n_u), unit of G
            Radii.

        Raises
        ------
        EstimationError
            If the level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise EstimationError(f"a confidence level of {level}; it must lie between 0 and 1. Give e.g. 0.95")
        # The F distribution with 2 and ν degrees of freedom has this closed quantile; -ln(1 - level) is its limit.
        nu = np.broadcast_to(np.asarray(self.degrees_of_freedom, dtype=np.float64), self.frequency_hz.shape)
        quantile = np.full(nu.shape, -np.log1p(-level))
        known = np.isfinite(nu)
        quantile[known] = 0.5 * nu[known] * np.expm1(-np.log1p(-level) * 2.0 / nu[known])
        return np.asarray(self.sd * np.sqrt(quantile)[:, None, None])

    def between(self, low_hz: float, high_hz: float) -> FrequencyResponse:
        """Return the response at the frequencies from `low_hz` to `high_hz`, both included.

        Parameters
        ----------
        low_hz, high_hz : float
            Band in Hz.

        Returns
        -------
        FrequencyResponse
            The same estimate at fewer frequencies.

        Raises
        ------
        EstimationError
            If none is left.
        """
        keep = (self.frequency_hz >= low_hz) & (self.frequency_hz <= high_hz)
        if not keep.any():
            raise EstimationError(
                f"no line of the frequency response between {low_hz:g} and {high_hz:g} Hz; there are "
                f"{self.frequency_hz[0]:g} to {self.frequency_hz[-1]:g} Hz. Give another band"
            )
        nu = self.degrees_of_freedom
        return replace(
            self,
            frequency_hz=self.frequency_hz[keep],
            G=self.G[keep],
            covariance=self.covariance[keep],
            noise_covariance=None if self.noise_covariance is None else self.noise_covariance[keep],
            coherence=None if self.coherence is None else self.coherence[keep],
            degrees_of_freedom=nu[keep] if isinstance(nu, np.ndarray) and nu.ndim else nu,
        )

    def _sd(self, covariance: Complex) -> Array:
        variance = np.real(np.diagonal(covariance, axis1=1, axis2=2))
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)).reshape(self.G.shape))
