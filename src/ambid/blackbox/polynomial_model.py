"""Polynomial models A y = (B/F) u + (C/D) e, one set of polynomials for each output (thesis eq. 1.10-1.12, 3.1).

Polynomials are arrays of the coefficients of q^0, q^-1, ...: A, C, D and F begin with 1, B with nk zeros.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.model import BlackBoxModel, StateSpaceModel
from ambid.blackbox.roots import roots_at
from ambid.errors import ModelError

Complex = NDArray[np.complex128]


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
class PolynomialModel(BlackBoxModel):
    """One set of polynomials for each output; discrete time.

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
        """Return G = B/(A F).

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs), complex
        """
        z = 1.0 / self.points(omega)
        g = [[_at(b, z) / (_at(p.A, z) * _at(f, z)) for b, f in zip(p.B, p.F, strict=True)] for p in self.outputs]
        return np.moveaxis(np.array(g, dtype=np.complex128).reshape(self.n_outputs, self.n_inputs, z.size), 2, 0)

    def noise_response(self, omega: Array) -> Complex:
        """Return H = C/(A D), diagonal.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_outputs), complex
        """
        z = 1.0 / self.points(omega)
        h = np.zeros((z.size, self.n_outputs, self.n_outputs), dtype=np.complex128)
        for o, p in enumerate(self.outputs):
            h[:, o, o] = _at(p.C, z) / (_at(p.A, z) * _at(p.D, z))
        return h

    def frequency_response_derivative(self, omega: Array) -> Complex:
        """Return dG/dtheta.

        Parameters
        ----------
        omega : ndarray, shape (n_frequencies,), rad/s

        Returns
        -------
        ndarray, shape (n_frequencies, n_outputs, n_inputs, n_theta), complex
        """
        z, g = 1.0 / self.points(omega), self.frequency_response(omega)
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
        return self._roots("AF" if self.n_inputs else "AD")

    def _zeros(self) -> tuple[Complex, Complex]:
        return self._roots("B" if self.n_inputs else "C")

    def _roots(self, letters: str) -> tuple[Complex, Complex]:
        return roots_at(self.theta, *[place for _, letter, _, place in self.blocks() if letter in letters])

    def state_space(self) -> StateSpaceModel:
        """Return the innovations form: the outputs side by side, each in observer form."""
        parts = [_observer_form(p) for p in self.outputs]
        from scipy.linalg import block_diag

        A, C, K = (block_diag(*[part[k] for part in parts]) for k in (0, 2, 4))
        B, D = (np.vstack([part[k] for part in parts]) for k in (1, 3))
        return StateSpaceModel(A=A, B=B, C=C, D=D, K=K, dt=self.dt)

    def plant(self) -> StateSpaceModel:
        """Return G alone, without the states of the noise.

        Returns
        -------
        StateSpaceModel
            With K = 0.
        """
        silent = PolynomialModel(
            outputs=tuple(Polynomials(A=p.A, B=p.B, C=[1.0], D=[1.0], F=p.F) for p in self.outputs),  # type: ignore[arg-type]
            dt=self.dt,
        ).state_space()
        return silent.plant()


def _at(p: Array, z: Complex) -> Complex:
    return np.asarray(np.polynomial.polynomial.polyval(z, p), dtype=np.complex128)


def _observer_form(p: Polynomials) -> tuple[Array, Array, Array, Array, Array]:
    """Return A, B, C, D, K of one output.

    A chain of order n carries -a_k y, b_k u of the inputs without F and, without D, c_k e. Every B/F, and C/D, is a
    chain of its own whose output w adds to y: y = first state + sum of w + b0 u + e.
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
