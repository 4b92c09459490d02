"""A measured frequency response with its uncertainty: the noun of the frequency domain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

import numpy as np

from ambid.arrays import Array, Complex
from ambid.errors import EstimationError
from ambid.settings.caller import setting

Hold = Literal["zoh", "band-limited"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrequencyResponse:
    """A measured frequency response with its uncertainty.

    Errors are circular complex: E[dG dGᵀ] = 0, so that real and imaginary part each have half the variance.

    Attributes
    ----------
    frequency_hz : ndarray, shape (n_f,), Hz
        Rising, over 0 and under half the rate.
    G : complex ndarray, shape (n_f, n_y, n_u), output unit per input unit
        Best linear approximation where the system is not linear.
    covariance : complex ndarray, shape (n_f, n_y*n_u, n_y*n_u)
        Total: E[vec(dG) vec(dG)ᴴ], vec row by row (all inputs of the first output, then of the second).
    noise_covariance : complex ndarray, shape (n_f, n_y*n_u, n_y*n_u), or None
        The part of it that differs between periods; None where the excitation has none.
    coherence : ndarray, shape (n_f, n_y), or None
        Multiple coherence, 0 to 1: share of each output's power that the inputs (or references) explain linearly.
    method : str
    inputs, outputs : tuple of str
    units : Mapping[str, str]
        SI unit by name.
    rate_hz : float
        Sampling rate in Hz.
    hold : {"zoh", "band-limited"}
        What the input does between the samples: with "zoh", G is the sampled plant with its hold.
    degrees_of_freedom : ndarray, shape (n_f,), or float
        Real degrees of freedom ν of the variance: ν·(estimate/truth) is χ² with ν; inf where it is known.
    lines_per_independent : float
        Neighbouring errors are correlated after windows and local fits: a quantity fitted to many lines as if they were
        independent has this many times the variance that the fit believes. 1 for periodic excitation.
    warnings : tuple of str
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
                    f"{n_u} inputs need {shape}. Correct the arrays"
                )
        if n < 1 or np.any(np.diff(self.frequency_hz) <= 0):
            raise EstimationError("frequency response: at least one frequency is needed, in rising order. Sort them")
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
        """Standard deviation due to noise alone, shape (n_f, n_y, n_u); None where it was not separated."""
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
        finite = np.isfinite(nu)
        quantile[finite] = 0.5 * nu[finite] * np.expm1(-np.log1p(-level) * 2.0 / nu[finite])
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


def feedback_caution() -> str:
    """Warn of the bias by feedback where no reference is given."""
    return (
        "without a reference the response is biased towards -1/controller where feedback carries the noise to the "
        f"input; give the reference r ({setting('reference')}), or {setting('open_loop', True)} if there is no feedback"
    )


def checked(
    u: Array,
    y: Array,
    r: Array | None,
    rate_hz: float,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> tuple[Array, Array, Array | None]:
    """Return u, y and r as columns, refused where their lengths differ or a value is not finite."""
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise EstimationError(f"a sampling rate of {rate_hz} Hz; it must be positive. Give the rate of the record")
    u, y = columns(u, "input", inputs), columns(y, "output", outputs)
    r = None if r is None else columns(r, "reference")
    for what, x in (("outputs", y), ("references", r)):
        if x is not None and x.shape[0] != u.shape[0]:
            raise EstimationError(f"{x.shape[0]} samples of the {what}, {u.shape[0]} of the inputs. Cut one")
    if r is not None and r.shape[1] < u.shape[1]:
        raise EstimationError(
            f"{r.shape[1]} references for {u.shape[1]} inputs; each input needs a reference of its own. Excite the "
            "loop at as many places"
        )
    return u, y, r


def columns(x: Array, what: str, names: Sequence[str] | None = None) -> Array:
    """Return `x` as shape (n_samples, n_columns), float64; messages call its columns by name where they have one."""
    x = np.asarray(x)
    if np.iscomplexobj(x) or x.ndim not in (1, 2) or x.size == 0:
        raise EstimationError(f"the {what} has shape {x.shape}; it must be real, (n_samples, n). Reshape it")
    x = np.asarray(x[:, None] if x.ndim == 1 else x, dtype=np.float64)
    complete = names is not None and len(names) == x.shape[1]
    called = [f"{what} {names[k]!r}" if names and complete else f"{what} {k + 1}" for k in range(x.shape[1])]
    if not np.isfinite(x).all():
        row, column = np.argwhere(~np.isfinite(x))[0]
        raise EstimationError(
            f"{called[column]} is not finite at sample {row}. Repair the record, or cut that part off"
        )
    for k in range(x.shape[1]):
        if np.all(x[:, k] == x[0, k]):
            raise EstimationError(f"{called[k]} is constant; it has no frequency response. Omit it")
    return x


def labels(names: Sequence[str] | None, letter: str, count: int) -> tuple[str, ...]:
    """Return the names given, or u1, u2, ..."""
    if names is None:
        return tuple(f"{letter}{k + 1}" for k in range(count))
    if len(names) != count:
        raise EstimationError(f"{len(names)} names {tuple(names)} for {count} channels. Give one for each")
    return tuple(names)


def ratio(Z: Complex, covariance: Complex, n_y: int, weight: Complex | None = None) -> tuple[Complex, Complex]:
    """Return G and its covariance from joint responses `Z` and the covariance of vec(Z) row by row."""
    G, T = ratio_map(Z, n_y, weight)
    return G, transformed(covariance, T)


def ratio_map(Z: Complex, n_y: int, weight: Complex | None = None) -> tuple[Complex, Complex]:
    """Return G = Y U⁻¹ and T, the derivative of vec(G) by vec(Z), both row by row, from `Z` (n_f, n_z, m).

    dG = [I, -G] dZ U⁻¹ to first order, so T = [I, -G] ⊗ U⁻ᵀ; T C Tᴴ is Pintelon and Schoukens 2012, eq. 2-32 f. With
    more columns than inputs, U⁻¹ is the right inverse W Uᴴ (U W Uᴴ)⁻¹, `weight` W (n_f, m, m).
    """
    Y, U = Z[:, :n_y], Z[:, n_y:]
    inverse = right_inverse(U, weight)
    G = Y @ inverse
    n, _, n_u = G.shape
    left = np.concatenate([np.broadcast_to(np.eye(n_y), (n, n_y, n_y)), -G], axis=2)
    T = left[:, :, None, :, None] * np.swapaxes(inverse, 1, 2)[:, None, :, None, :]
    return G, np.asarray(T.reshape(n, n_y * n_u, -1))


def weak_inputs(Z: Complex, covariance: Complex, n_y: int) -> tuple[str, ...]:
    """Return a warning where the inputs' responses barely stand above their own noise. A ratio is biased by about
    exp(-|U|²/σ_U²) (Pintelon and Schoukens 2012, sec. 2.4.2), its first-order covariance void; under a ratio of 10 the
    bias is over 5e-5 and tails are heavy.
    """
    U = Z[:, n_y:]
    n, n_u, m = U.shape
    diagonal = np.real(np.diagonal(covariance, axis1=1, axis2=2)).reshape(n, -1, m)[:, n_y:]
    noise = np.sum(diagonal, axis=1).max(axis=1)
    weakest = np.linalg.svd(U, compute_uv=False)[:, n_u - 1] ** 2
    bad = int(np.sum(weakest < 10.0 * noise))
    if not bad:
        return ()
    return (
        f"at {bad} of {n} lines the excitation of the inputs is less than 10 dB above their noise: G is biased "
        "there and its standard deviation too small. Average longer, or excite more",
    )


def product_covariance(noise: Complex, parameters: Complex) -> Complex:
    """Return the covariance A ⊗ Bᵀ of vec(V K) row by row, where V has row covariance A and KᴴK = B: (n_f, ab, ab)."""
    n, a, b = noise.shape[0], noise.shape[1], parameters.shape[1]
    both = noise[:, :, None, :, None] * np.swapaxes(parameters, 1, 2)[:, None, :, None, :]
    return both.reshape(n, a * b, a * b)


def transformed(covariance: Complex, T: Complex) -> Complex:
    """Return T C Tᴴ, exactly Hermitian."""
    C = T @ covariance @ _h(T)
    return np.asarray(0.5 * (C + _h(C)))


def scatter(values: Complex) -> Complex:
    """Return the sample covariance over axis 0 of `values` (m, n_f, k): (n_f, k, k)."""
    d = values - values.mean(axis=0)
    C = np.einsum("mfi,mfj->fij", d, d.conj()) / (values.shape[0] - 1)
    return np.asarray(C)


def right_inverse(U: Complex, weight: Complex | None = None) -> Complex:
    """Return W Uᴴ (U W Uᴴ)⁻¹ of `U` (n_f, n_u, m), refused where its rows are dependent."""
    n_u, m = U.shape[1:]
    s = np.linalg.svd(U, compute_uv=False)
    worst = int(np.argmin(s[:, -1] / np.maximum(s[:, 0], np.finfo(float).tiny)))
    if s[worst, -1] <= 1e-10 * s[worst, 0]:
        raise EstimationError(
            f"the {n_u} inputs move together at line {worst + 1} of the estimate; their effects cannot be "
            "distinguished. Use experiments or references that are linearly independent at every line"
        )
    if m == n_u:
        return np.asarray(np.linalg.inv(U))
    WU = _h(U) if weight is None else weight @ _h(U)
    return np.asarray(WU @ np.linalg.inv(U @ WU))


def _h(x: Complex) -> Complex:
    return np.conj(np.swapaxes(x, -1, -2))
