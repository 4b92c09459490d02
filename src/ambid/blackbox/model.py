"""What a black-box model is: coefficients, frequency response, poles and zeros, with derivatives by *all* coefficients.

One that was not estimated has a zero row and column in the covariance. Every model can become the innovations form
(thesis eq. 1.1-1.3), x+ = A x + B u + K e, y = C x + D u + e.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import ModelError

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Offsets:
    """What is taken off inputs and outputs before a model is used, SI."""

    u: Array  # (n_inputs,)
    y: Array  # (n_outputs,)


class BlackBoxModel(ABC):
    """A linear model y = G u + H e, discrete (`dt` in s) or continuous (`dt` None)."""

    __slots__ = ()
    dt: float | None

    @property
    @abstractmethod
    def n_inputs(self) -> int:
        """Number of inputs, 0 for a time series."""

    @property
    @abstractmethod
    def n_outputs(self) -> int:
        """Number of outputs."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of all coefficients, in the order of `theta`."""

    @property
    @abstractmethod
    def theta(self) -> Array:
        """All coefficients, shape (n_theta,)."""

    @abstractmethod
    def frequency_response(self, omega: Array) -> Complex:
        """Return G.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs), complex
        """

    @abstractmethod
    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs, n_theta), complex
        """

    @abstractmethod
    def state_space(self) -> StateSpaceModel:
        """Return the model in innovations form."""

    @abstractmethod
    def _poles(self) -> tuple[Complex, Complex]: ...

    @abstractmethod
    def _zeros(self) -> tuple[Complex, Complex]: ...

    def poles(self) -> Complex:
        """Return the poles of G (of H for a time series) in z, or in rad/s for a continuous model, shape (n_poles,)."""
        return self._poles()[0]

    def pole_derivative(self) -> Complex:
        """Return d(pole)/dtheta, shape (n_poles, n_theta)."""
        return self._poles()[1]

    def zeros(self) -> Complex:
        """Return the (transmission) zeros of G (of H for a time series), shape (n_zeros,)."""
        return self._zeros()[0]

    def zero_derivative(self) -> Complex:
        """Return d(zero)/dtheta, shape (n_zeros, n_theta)."""
        return self._zeros()[1]

    def plant(self) -> StateSpaceModel:
        """Return G alone, without the states of the noise, as a state space with K = 0."""
        return self.state_space().plant()

    def _points(self, omega: Array) -> Complex:
        """Return z, or s for a continuous model, at `omega` in rad/s, shape (n_frequencies,)."""
        return np.asarray(1j * omega if self.dt is None else np.exp(1j * omega * self.dt), dtype=np.complex128)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StateSpaceModel(BlackBoxModel):
    """Innovations form; with `dt` None the first line is x' = A x + B u + K e.

    An `ambid.blackbox.model.BlackBoxModel`.

    Attributes
    ----------
    A, B, C, D : ndarray, shapes (n, n), (n, n_inputs), (n_outputs, n), (n_outputs, n_inputs)
    K : ndarray, shape (n, n_outputs)
        Gain of the innovations; zero for an output-error model.
    dt : float or None
        Sampling interval in s; None for continuous time.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    K: Array
    dt: float | None

    def __post_init__(self) -> None:
        for name in "ABCDK":
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64, order="C"))
        n, n_u, n_y = self.A.shape[0], self.B.shape[-1], self.C.shape[0]
        wanted = {"A": (n, n), "B": (n, n_u), "C": (n_y, n), "D": (n_y, n_u), "K": (n, n_y)}
        for name, shape in wanted.items():
            if getattr(self, name).shape != shape:
                raise ModelError(f"state-space matrix {name} has shape {getattr(self, name).shape}; it must be {shape}")

    @property
    def order(self) -> int:
        """Number of states."""
        return int(self.A.shape[0])

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return int(self.C.shape[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient names, ``A[0,1]`` and so on: A, B, C, D, K, each row by row."""
        return tuple(f"{m}[{i},{j}]" for m in "ABCDK" for i, j in np.ndindex(getattr(self, m).shape))

    @property
    def theta(self) -> Array:
        """All coefficients in the order of `names`, shape (n_theta,)."""
        return np.concatenate([getattr(self, m).ravel() for m in "ABCDK"])

    def with_theta(self, theta: Array) -> StateSpaceModel:
        """Return the same structure with other coefficients.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)

        Returns
        -------
        StateSpaceModel
        """
        parts, first = {}, 0
        for m in "ABCDK":
            rows, columns = getattr(self, m).shape
            parts[m] = theta[first : first + rows * columns].reshape(rows, columns)
            first += rows * columns
        return StateSpaceModel(dt=self.dt, **parts)

    def in_states(self, T: Array) -> StateSpaceModel:
        """Return the same model in the state T^-1 x.

        Parameters
        ----------
        T : ndarray, shape (n, n)

        Returns
        -------
        StateSpaceModel
        """
        back = np.linalg.inv(T)
        return StateSpaceModel(
            A=back @ self.A @ T, B=back @ self.B, C=self.C @ T, D=self.D, K=back @ self.K, dt=self.dt
        )

    def state_space(self) -> StateSpaceModel:
        """Return the model itself."""
        return self

    def plant(self) -> StateSpaceModel:
        """Return G alone, with K = 0."""
        return StateSpaceModel(A=self.A, B=self.B, C=self.C, D=self.D, K=np.zeros_like(self.K), dt=self.dt)

    def _poles(self) -> tuple[Complex, Complex]:
        """Eigenvalues of A, and their derivative: w_i* v_j / (w* v) for A[i, j]."""
        values, left, right = self._eigen()
        n = self.order
        scale = np.sum(left.conj() * right, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            by_a = np.einsum("ip,jp->pij", left.conj(), right) / scale[:, None, None]
        out = np.zeros((values.size, self.theta.size), dtype=np.complex128)
        out[:, : n * n] = by_a.reshape(values.size, -1)
        return values, out

    def _zeros(self) -> tuple[Complex, Complex]:
        """Transmission zeros of G, for as many inputs as outputs; none otherwise."""
        zeros, left, right = self._zero_vectors()
        n, n_u = self.order, self.n_inputs
        out = np.zeros((zeros.size, self.theta.size), dtype=np.complex128)
        if not zeros.size:
            return zeros, out
        scale = np.sum(left[:n].conj() * right[:n], axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            full = np.einsum("ip,jp->pij", left.conj(), right) / scale[:, None, None]
        blocks = (full[:, :n, :n], full[:, :n, n:], full[:, n:, :n], full[:, n:, n:])
        flat = np.concatenate([b.reshape(zeros.size, -1) for b in blocks], axis=1)
        out[:, : n * n + n * n_u + self.n_outputs * (n + n_u)] = flat
        return zeros, out

    def frequency_response(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response`."""
        return np.asarray(self.D + self.C @ np.linalg.solve(self._pencil(omega), self._wide(self.B, omega)))

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response_derivative`."""
        pencil = self._pencil(omega)
        right = np.linalg.solve(pencil, self._wide(self.B, omega))  # (f, n, u)
        left = np.swapaxes(np.linalg.solve(np.swapaxes(pencil, 1, 2), self._wide(self.C.T, omega)), 1, 2)  # (f, y, n)
        f, n, n_u, n_y = omega.size, self.order, self.n_inputs, self.n_outputs
        by_a = np.einsum("fyi,fju->fyuij", left, right).reshape(f, n_y, n_u, n * n)
        by_b = np.einsum("fyi,uv->fyuiv", left, np.eye(n_u)).reshape(f, n_y, n_u, n * n_u)
        by_c = np.einsum("yz,fju->fyuzj", np.eye(n_y), right).reshape(f, n_y, n_u, n_y * n)
        by_d = np.broadcast_to(
            np.einsum("yz,uv->yuzv", np.eye(n_y), np.eye(n_u)).reshape(n_y, n_u, n_y * n_u), (f, n_y, n_u, n_y * n_u)
        )
        return np.concatenate([by_a, by_b, by_c, by_d, np.zeros((f, n_y, n_u, n * n_y))], axis=3)

    def _pencil(self, omega: Array) -> Complex:
        return np.asarray(self._points(omega)[:, None, None] * np.eye(self.order) - self.A)

    @staticmethod
    def _wide(matrix: Array, omega: Array) -> Complex:
        return np.broadcast_to(matrix.astype(np.complex128), (omega.size, *matrix.shape))

    def _eigen(self) -> tuple[Complex, Complex, Complex]:
        from scipy.linalg import eig

        if not self.order:
            none = np.empty((0, 0), dtype=np.complex128)
            return np.empty(0, dtype=np.complex128), none, none
        values, left, right = eig(self.A, left=True, right=True)
        order = np.argsort(-(np.abs(values) if self.dt is not None else values.real), kind="stable")
        return values[order].astype(np.complex128), left[:, order], right[:, order]

    def _zero_vectors(self) -> tuple[Complex, Complex, Complex]:
        from scipy.linalg import eig

        none = np.empty(0, dtype=np.complex128)
        if self.n_inputs != self.n_outputs or not self.order:
            return none, none[None, :], none[None, :]
        n = self.order
        system = np.block([[self.A, self.B], [self.C, self.D]])
        mass = np.zeros_like(system)
        mass[:n, :n] = np.eye(n)
        values, left, right = eig(system, mass, left=True, right=True, homogeneous_eigvals=True)
        finite = np.abs(values[1]) > 1e-8 * np.abs(values[0])
        zeros = np.asarray(values[0][finite] / values[1][finite], dtype=np.complex128)
        return zeros, left[:, finite], right[:, finite]


def complex_covariance(derivative: Complex, covariance: Array) -> Array:
    """Propagate `covariance` (n_theta, n_theta) by a complex `derivative` (..., n_theta) to (..., 2, 2), real and
    imaginary.
    """
    parts = np.stack([derivative.real, derivative.imag], axis=-2)
    with np.errstate(over="ignore", invalid="ignore"):  # not finite at multiple roots
        return np.asarray(parts @ covariance @ np.swapaxes(parts, -1, -2))


def pole_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance (n_poles, 2, 2) of real and imaginary part in the order of ``model.poles()``; not finite at
    multiple poles, where no first-order spread exists.
    """
    return complex_covariance(model.pole_derivative(), covariance)


def zero_covariance(model: BlackBoxModel, covariance: Array) -> Array:
    """Return the covariance (n_zeros, 2, 2) of real and imaginary part in the order of ``model.zeros()``."""
    return complex_covariance(model.zero_derivative(), covariance)


def response_covariance(model: BlackBoxModel, covariance: Array, omega: Array) -> Array:
    """Return the covariance of real and imaginary part of the frequency response at `omega` in rad/s, shape
    (n_frequencies, n_outputs, n_inputs, 2, 2).
    """
    return complex_covariance(model.frequency_response_derivative(omega), covariance)


_ROUNDING = 1e-13


def stable(p: Array) -> bool:
    """Return whether all roots in z of `p`, 1 + p_1 q^-1 + ..., are inside the unit circle by more than rounding."""
    c = [float(x) for x in p]
    while len(c) > 1:
        k = c[-1]
        if not abs(k) < 1.0 - _ROUNDING:
            return False
        rest = 1.0 - k * k
        c = [(a - k * b) / rest for a, b in zip(c[:-1], c[:0:-1], strict=True)]
    return True


def reflect(p: Array, radius: float = 0.98) -> Array:
    """Return `p` with roots outside the unit circle reflected, and drawn in to at most `radius`; for a start alone."""
    if p.size < 2 or not np.all(np.isfinite(p)):
        return np.asarray(np.eye(1, p.size)[0])
    if stable(p / radius ** np.arange(p.size)):
        return p
    roots = np.roots(p)
    size = np.abs(roots)
    outside = size > 1.0
    roots[outside] /= size[outside] ** 2
    size = np.abs(roots)
    far = size > radius
    roots[far] *= radius / size[far]
    return np.asarray(np.real(np.poly(roots)))


def roots_of(p: Array) -> Complex:
    """Return the complex roots in z of `p` (first not 0), by the formula for up to two, which are most."""
    if p.size < 2:
        return np.empty(0, dtype=np.complex128)
    if p.size == 2:
        return np.array([-p[1] / p[0]], dtype=np.complex128)
    if p.size == 3:
        half, product = -0.5 * float(p[1] / p[0]), float(p[2] / p[0])
        d = half * half - product
        if d < 0:
            return np.array([complex(half, (-d) ** 0.5), complex(half, -((-d) ** 0.5))])
        far = half + (d**0.5 if half >= 0 else -(d**0.5))
        return np.array([far, product / far if far else 0.0], dtype=np.complex128)
    return np.asarray(np.roots(p), dtype=np.complex128)


def root_derivative(coefficients: Array, roots: Complex) -> Complex:
    """Return the derivative (n_roots, n + 1) of roots by coefficients of z^n ... z^0, from P(r) = 0: dr/dp_k = -r^(n-k)
    / P'(r); infinite at a multiple root.
    """
    n = coefficients.size - 1
    if n < 1:
        return np.zeros((roots.size, n + 1), dtype=np.complex128)
    far = np.abs(roots) > 1.0  # there by powers of 1/r, numerator and slope both over r^(n-1), as r^n may overflow
    x = np.where(far, 1.0 / np.where(far, roots, 1.0), roots)
    falling = np.polynomial.polynomial.polyvander(x, n)  # 1, x ... x^n
    inside, outside = falling[:, ::-1], np.column_stack([np.where(far, roots, 1.0), falling[:, :-1]])
    slope_terms = np.arange(n, 0, -1) * coefficients[:-1]  # of z^(n-1) ... z^0
    slope = np.where(far, falling[:, :-1] @ slope_terms, falling[:, :-1] @ slope_terms[::-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(-np.where(far[:, None], outside, inside) / slope[:, None])


def used_part(theta: Array, place: slice) -> slice:
    """Return where the polynomial at `place` in `theta` begins behind leading zeros: a delay has no roots."""
    nonzero = np.nonzero(theta[place])[0]
    return slice(place.start + int(nonzero[0]) if nonzero.size else place.stop, place.stop)


def roots_at(theta: Array, *places: slice) -> tuple[Complex, Complex]:
    """Return complex `roots` (n_roots,) of the polynomials at `places` in `theta`, leading zeros being a delay, and
    their `derivatives` (n_roots, n_theta).
    """
    roots, rows = [np.empty(0, dtype=np.complex128)], [np.zeros((0, theta.size), dtype=np.complex128)]
    for place in places:
        part = used_part(theta, place)
        roots.append(roots_of(theta[part]))
        rows.append(np.zeros((roots[-1].size, theta.size), dtype=np.complex128))
        if roots[-1].size:
            rows[-1][:, part] = root_derivative(theta[part], roots[-1])
    return np.concatenate(roots), np.vstack(rows)


class RationalModel(BlackBoxModel):
    """A model of polynomials, which stand one after the other in `theta`."""

    __slots__ = ()

    @abstractmethod
    def blocks(self) -> Iterator[tuple[int, str, int | None, slice]]:
        """Yield (output, which, input or None, place in `theta`) of every polynomial."""

    def places(self, which: str) -> list[slice]:
        """Return the places of all polynomials of one of these kinds."""
        return [place for _, kind, _, place in self.blocks() if kind in which]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Polynomials:
    """Polynomials of one output in q^-1, lowest power first.

    Attributes
    ----------
    A, C, D : ndarray, shape (n + 1,)
        Monic.
    B, F : tuple of ndarray, shape (n + 1,) each
        One for each input; F monic.
    """

    A: Array
    B: tuple[Array, ...]
    C: Array
    D: Array
    F: tuple[Array, ...]

    def __post_init__(self) -> None:
        for name in "ACD":
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        for name in "BF":
            object.__setattr__(self, name, tuple(np.array(p, dtype=np.float64) for p in getattr(self, name)))
        if len(self.B) != len(self.F):
            raise ModelError(f"{len(self.B)} polynomials B and {len(self.F)} F; there is one of each for every input")
        for name, p in (("A", self.A), ("C", self.C), ("D", self.D), *(("F", f) for f in self.F)):
            if p.ndim != 1 or not p.size or p[0] != 1.0:
                raise ModelError(f"polynomial {name} = {p}; it must begin with 1")
        if any(p.ndim != 1 or not p.size for p in self.B):
            raise ModelError("polynomial B has no coefficients; give at least [0]")

    def parts(self) -> Iterator[tuple[str, int | None, Array]]:
        """Yield (letter, input or None, coefficients) in the order A, B..., C, D, F...."""
        yield "A", None, self.A
        yield from (("B", i, p) for i, p in enumerate(self.B))
        yield "C", None, self.C
        yield "D", None, self.D
        yield from (("F", i, p) for i, p in enumerate(self.F))

    @property
    def theta(self) -> Array:
        """All coefficients in the order of `parts`, shape (n_theta,)."""
        return np.concatenate([c for _, _, c in self.parts()])

    def with_theta(self, theta: Array) -> Polynomials:
        """Return polynomials of the same degrees with other coefficients.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)

        Returns
        -------
        Polynomials
        """
        parts, n = np.split(theta, np.cumsum([c.size for _, _, c in self.parts()])[:-1]), len(self.B)
        return Polynomials(
            A=parts[0], B=tuple(parts[1 : n + 1]), C=parts[n + 1], D=parts[n + 2], F=tuple(parts[n + 3 :])
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PolynomialModel(RationalModel):
    """One set of polynomials for each output; discrete time.

    An `ambid.blackbox.model.BlackBoxModel`.

    Attributes
    ----------
    outputs : tuple of Polynomials
        All for the same inputs.
    dt : float
        Sampling interval in s.
    """

    outputs: tuple[Polynomials, ...]
    dt: float

    def __post_init__(self) -> None:
        if not self.outputs or len({len(p.B) for p in self.outputs}) != 1:
            raise ModelError("a polynomial model needs an output, and the same inputs for all outputs")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.outputs[0].B)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient names: ``a1``, ``b2``; ``b2.0`` with several inputs, ``y1:a1`` with several outputs."""
        several = self.n_inputs > 1
        return tuple(
            ("" if self.n_outputs == 1 else f"y{o}:")
            + f"{letter.lower()}{k}"
            + (f".{i}" if i is not None and several else "")
            for o, p in enumerate(self.outputs)
            for letter, i, c in p.parts()
            for k in range(c.size)
        )

    @property
    def theta(self) -> Array:
        """All coefficients, leading ones and zeros included, in the order of `names`, shape (n_theta,)."""
        return np.concatenate([p.theta for p in self.outputs])

    def blocks(self) -> Iterator[tuple[int, str, int | None, slice]]:
        """Yield (output, letter, input or None, place in `theta`) of every polynomial."""
        first = 0
        for o, p in enumerate(self.outputs):
            for letter, i, c in p.parts():
                yield o, letter, i, slice(first, first + c.size)
                first += c.size

    def with_theta(self, theta: Array) -> PolynomialModel:
        """Return the same structure with other coefficients.

        Parameters
        ----------
        theta : ndarray, shape (n_theta,)

        Returns
        -------
        PolynomialModel
        """
        ends = np.cumsum([p.theta.size for p in self.outputs])
        split = zip(self.outputs, np.split(theta, ends[:-1]), strict=True)
        return PolynomialModel(outputs=tuple(p.with_theta(part) for p, part in split), dt=self.dt)

    def frequency_response(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response`."""
        z = 1.0 / self._points(omega)
        g = [[_at(b, z) / (_at(p.A, z) * _at(f, z)) for b, f in zip(p.B, p.F, strict=True)] for p in self.outputs]
        return np.moveaxis(np.array(g, dtype=np.complex128).reshape(self.n_outputs, self.n_inputs, z.size), 2, 0)

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response_derivative`."""
        z, g = 1.0 / self._points(omega), self.frequency_response(omega)
        out = np.zeros((*g.shape, self.theta.size), dtype=np.complex128)
        for o, letter, i, place in self.blocks():
            p = self.outputs[o]
            powers = z[:, None] ** np.arange(place.stop - place.start)
            if letter == "A":
                out[:, o, :, place] = -g[:, o, :, None] * (powers / _at(p.A, z)[:, None])[:, None, :]
            elif letter == "B" and i is not None:
                out[:, o, i, place] = powers / (_at(p.A, z) * _at(p.F[i], z))[:, None]
            elif letter == "F" and i is not None:
                out[:, o, i, place] = -g[:, o, i, None] * powers / _at(p.F[i], z)[:, None]
        return out

    def _poles(self) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *self.places("AF" if self.n_inputs else "AD"))

    def _zeros(self) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *self.places("B" if self.n_inputs else "C"))

    def state_space(self) -> StateSpaceModel:
        """Return the innovations form: the outputs side by side, each in observer form."""
        parts = [_observer_form(p) for p in self.outputs]
        from scipy.linalg import block_diag

        A, C, K = (block_diag(*[part[k] for part in parts]) for k in (0, 2, 4))
        B, D = (np.vstack([part[k] for part in parts]) for k in (1, 3))
        return StateSpaceModel(A=A, B=B, C=C, D=D, K=K, dt=self.dt)

    def plant(self) -> StateSpaceModel:
        """Return G alone, without the states of the noise, with K = 0."""
        silent = PolynomialModel(
            outputs=tuple(Polynomials(A=p.A, B=p.B, C=[1.0], D=[1.0], F=p.F) for p in self.outputs),  # type: ignore[arg-type]
            dt=self.dt,
        ).state_space()
        return silent.plant()


def _at(p: Array, z: Complex) -> Complex:
    return np.asarray(np.polynomial.polynomial.polyval(z, p), dtype=np.complex128)


def _observer_form(p: Polynomials) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, B, C, D, K of one output. A chain of order n carries -a_k y, b_k u of inputs without F and, without D,
    c_k e; every B/F, and C/D, is a chain whose output w adds to y: y = first state + sum of w + b0 u + e.
    """
    n_u, fir = len(p.B), [f.size == 1 for f in p.F]
    main = max(p.A.size, p.C.size if p.D.size == 1 else 1, *(b.size for b, x in zip(p.B, fir, strict=True) if x), 1) - 1
    sizes = [0 if x else max(b.size, f.size) - 1 for b, f, x in zip(p.B, p.F, fir, strict=True)]
    noise = 0 if p.D.size == 1 else max(p.C.size, p.D.size) - 1
    n = main + sum(sizes) + noise
    A, B, K, C, D = np.zeros((n, n)), np.zeros((n, n_u)), np.zeros((n, 1)), np.zeros((1, n)), np.zeros((1, n_u))
    first = main
    for i, (b, f, size) in enumerate(zip(p.B, p.F, sizes, strict=True)):
        D[0, i] = b[0]
        if fir[i]:
            B[: b.size - 1, i] += b[1:]
            continue
        _chain(A, slice(first, first + size), f)
        B[first : first + size, i] = _padded(b, size) - _padded(f, size) * b[0]
        C[0, first] = 1.0
        first += size
    if noise:
        _chain(A, slice(first, n), p.D)
        K[first:, 0] = _padded(p.C, noise) - _padded(p.D, noise)
        C[0, first] = 1.0
    elif main:
        K[:main, 0] += _padded(p.C, main)
    if main:
        C[0, 0] = 1.0
        A[: main - 1, 1:main] += np.eye(main - 1)
        a = _padded(p.A, main)
        A[:main] -= np.outer(a, C[0])
        B[:main] -= np.outer(a, D[0])
        K[:main, 0] -= a
    return A, B, C, D, K


def _chain(A: Array, place: slice, p: Array) -> None:
    size = place.stop - place.start
    block = np.eye(size, k=1)
    block[:, 0] -= _padded(p, size)
    A[place, place] = block


def _padded(p: Array, size: int) -> Array:
    """Coefficients 1 to `size`, zeros where there are none."""
    out = np.zeros(size)
    out[: p.size - 1] = p[1:]
    return out


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransferModel(RationalModel):
    """G[o][i] = num[o][i] / den[o][i] * exp(-s delay[i]), output noise white (H = I).

    An `ambid.blackbox.model.BlackBoxModel`.

    Attributes
    ----------
    num, den : tuple of tuple of ndarray, shape (degree + 1,) each
        By output, then input; highest power first, den monic.
    dt : float or None
        Sampling interval in s; None for continuous time.
    delay : tuple of float, s
        One for each input (whole samples times dt for a discrete model).
    delay_estimated : bool
        Whether the delays are real numbers that were estimated: `theta` then ends with them, so that what is open about
        them goes into every spread.
    """

    num: tuple[tuple[Array, ...], ...]
    den: tuple[tuple[Array, ...], ...]
    dt: float | None
    delay: tuple[float, ...] = ()
    delay_estimated: bool = False

    def __post_init__(self) -> None:
        for name in ("num", "den"):
            rows = tuple(
                tuple(np.atleast_1d(np.array(p, dtype=np.float64)) for p in row) for row in getattr(self, name)
            )
            object.__setattr__(self, name, rows)
        if not self.delay:
            object.__setattr__(self, "delay", (0.0,) * len(self.num[0]))
        shapes = {len(row) for row in (*self.num, *self.den)}
        if shapes != {len(self.delay)} or len(self.num) != len(self.den):
            raise ModelError("num, den and delay of a transfer function do not have the same inputs and outputs")
        for n, d in ((n, d) for rn, rd in zip(self.num, self.den, strict=True) for n, d in zip(rn, rd, strict=True)):
            if d[0] != 1.0 or n.size > d.size:
                raise ModelError(f"a transfer function {n}/{d}; its denominator must be monic and of no lower degree")

    @property
    def n_inputs(self) -> int:
        """Number of inputs."""
        return len(self.delay)

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.num)

    @property
    def names(self) -> tuple[str, ...]:
        """Coefficient names ``num[o,i]s2`` and ``den[o,i]s2`` with the power behind, ``delay[i]``, as in `theta`."""
        variable = "s" if self.dt is None else "z"
        coefficients = tuple(
            f"{which}[{o},{i}]{variable}{place.stop - 1 - k}"
            for o, which, i, place in self.blocks()
            for k in range(place.start, place.stop)
        )
        return coefficients + tuple(f"delay[{i}]" for i in range(self.n_inputs) if self.delay_estimated)

    @property
    def theta(self) -> Array:
        """All coefficients, leading ones included, and estimated delays in s, as in `names`, shape (n_theta,)."""
        pairs = [p for o, i in np.ndindex(self.n_outputs, self.n_inputs) for p in (self.num[o][i], self.den[o][i])]
        return np.concatenate([*pairs, self.delay if self.delay_estimated else ()])

    def frequency_response(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response`."""
        s, lag = self._points(omega), np.exp(-1j * np.outer(omega, self.delay))
        g = np.empty((omega.size, self.n_outputs, self.n_inputs), dtype=np.complex128)
        for o, i in np.ndindex(self.n_outputs, self.n_inputs):
            g[:, o, i] = np.polyval(self.num[o][i], s) / np.polyval(self.den[o][i], s) * lag[:, i]
        return g

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """As `BlackBoxModel.frequency_response_derivative`."""
        s, lag = self._points(omega), np.exp(-1j * np.outer(omega, self.delay))
        out = np.zeros((omega.size, self.n_outputs, self.n_inputs, self.theta.size), dtype=np.complex128)
        for o, which, i, place in self.blocks():
            powers = s[:, None] ** np.arange(place.stop - place.start - 1, -1, -1)
            den = np.polyval(self.den[o][i], s)
            factor = lag[:, i] / den if which == "num" else -lag[:, i] * np.polyval(self.num[o][i], s) / den**2
            out[:, o, i, place] = powers * factor[:, None]
        if self.delay_estimated:
            g, first = self.frequency_response(omega), self.theta.size - self.n_inputs
            for i in range(self.n_inputs):
                out[:, :, i, first + i] = -1j * omega[:, None] * g[:, :, i]
        return out

    def _poles(self) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *self.places("den"))

    def _zeros(self) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *self.places("num"))

    def state_space(self) -> StateSpaceModel:
        """Return an innovations form with K = 0; delays of a discrete model become states.

        Raises
        ------
        ModelError
            If a continuous model has a delay, which no finite state holds.
        """
        from scipy.linalg import block_diag
        from scipy.signal import tf2ss

        if self.dt is None and any(self.delay):
            raise ModelError("a continuous model with a delay has no state space. Remove the delay, or discretise")
        blocks, n_u, n_y = [], self.n_inputs, self.n_outputs
        D = np.zeros((n_y, n_u))
        for o, i in np.ndindex(n_y, n_u):
            later = 0 if self.dt is None else round(self.delay[i] / self.dt)
            num, den = self.num[o][i], np.concatenate([self.den[o][i], np.zeros(later)])
            if den.size == 1:
                D[o, i] = num[0]
                continue
            used = int(np.nonzero(num)[0][0]) if np.any(num) else num.size - 1
            a, b, c, d = tf2ss(num[used:], den)
            D[o, i] = d[0, 0]
            wide_b, wide_c = np.zeros((a.shape[0], n_u)), np.zeros((n_y, a.shape[0]))
            wide_b[:, i], wide_c[o] = b[:, 0], c[0]
            blocks.append((a, wide_b, wide_c))
        A = block_diag(*[b[0] for b in blocks]) if blocks else np.zeros((0, 0))
        B = np.vstack([np.zeros((0, n_u)), *[b[1] for b in blocks]])
        C = np.hstack([np.zeros((n_y, 0)), *[b[2] for b in blocks]])
        return StateSpaceModel(A=A, B=B, C=C, D=D, K=np.zeros((A.shape[0], n_y)), dt=self.dt)

    def blocks(self) -> Iterator[tuple[int, str, int, slice]]:
        """Yield (output, "num" or "den", input, place in `theta`) of every polynomial."""
        first = 0
        for o, i in np.ndindex(self.n_outputs, self.n_inputs):
            for which, p in (("num", self.num[o][i]), ("den", self.den[o][i])):
                yield o, which, i, slice(first, first + p.size)
                first += p.size
