"""Which weights of a state-space network are free, and what they are in matrices (thesis eq. 5.1, fig. 5.9).

x+ = A x + B u + c + K e + G f(x, u), y = x[heads]. In the form ``one-axis`` the weights are entries of the continuous
A and B of thesis eq. 4.8 (position, velocity, current); A, B, G of a sample follow by the matrix exponential. In the
form ``free`` they are those of the sampled A and B; a state that is not measured is the scaled difference of the state
before it, x_j+ = x_j + step x_(j+1) + .., which makes the weights unique.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array

Table = NDArray[np.int64]

STATES = ("position", "velocity", "current")
_FIVE = ((1, 0), (1, 2), (2, 1), (2, 2), (2, 3))  # thesis eq. 4.8: a21, a23, a32, a33, b3
_ALL = ((1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (1, 3), (2, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matrices:
    """What the recursions want, in scaled signals; d* are derivatives by the first weights, first axis n_directions."""

    A: Array  # the last column of B is the constant
    B: Array
    K: Array
    G: Array
    W1: Array
    b1: Array
    W2: Array
    dA: Array  # (n_directions, ...)
    dB: Array
    dK: Array
    dG: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Which weights are free."""

    form: str
    dt: float  # s
    n_inputs: int
    heads: tuple[int, ...]  # state that each output is
    # by state, form ``free``: what the next state enters with; 0 for the last of a chain. Empty for ``one-axis``.
    steps: tuple[float, ...]
    entries: tuple[tuple[int, int], ...]  # free weights in [A | B | c]
    scale: tuple[float, ...]  # of states, then of inputs, in SI
    rates: tuple[float, ...]  # size of G's output of 1, by row that it acts on
    rows: tuple[int, ...]  # states that G acts on
    gain: bool = False  # whether K is estimated; else it is 0
    neurons: int = 0
    anchored: bool = True  # whether hidden units have neither value nor slope at the operating point

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.scale) - self.n_inputs

    @property
    def p(self) -> int:
        """Number of outputs."""
        return len(self.heads)

    @property
    def n_directions(self) -> int:
        """Weights that are entries of the matrices."""
        return len(self.entries) + self.gain * self.n * self.p

    @property
    def n_hidden(self) -> int:
        """Weights of the hidden layer."""
        return self.neurons * (self.n + self.n_inputs + 1 + len(self.rows))

    @property
    def n_theta(self) -> int:
        """All weights."""
        return self.n_directions + self.n_hidden

    @cached_property
    def head_table(self) -> Table:
        """`heads` as the recursions want them, shape (n_outputs,)."""
        return np.array(self.heads, dtype=np.int64)

    @cached_property
    def unit(self) -> Array:
        """What a scaled weight of 1 is in SI, shape (n_theta,); 1 for gains and hidden layer."""
        size = np.array((*self.scale, 1.0))
        out = np.ones(self.n_theta)
        out[: len(self.entries)] = [size[r] / size[c] for r, c in self.entries]
        return out

    @property
    def names(self) -> tuple[str, ...]:
        """Of all weights."""
        n, m = self.n, self.n_inputs
        out = []
        for r, c in self.entries:
            out.append(f"a{r + 1}{c + 1}" if c < n else f"c{r + 1}" if c == n + m else self._input_name(r, c - n))
        if self.gain:
            out += [f"k{i + 1}{j + 1}" for i in range(n) for j in range(self.p)]
        z = [f"x{j + 1}" for j in range(n)] + [f"u{j + 1}" for j in range(m)]
        out += [f"unit {k + 1}: {x}" for k in range(self.neurons) for x in z]
        out += [f"unit {k + 1}: 1" for k in range(self.neurons)]
        return (*out, *(f"x{r + 1}: unit {k + 1}" for r in self.rows for k in range(self.neurons)))

    def _input_name(self, row: int, column: int) -> str:
        return f"b{row + 1}" if self.n_inputs == 1 else f"b{row + 1}{column + 1}"

    def matrices(self, theta: Array) -> Matrices:
        """Return the matrices of a sample and their derivatives.

        `theta`: (n_theta,), scaled.
        """
        n, m, h, k = self.n, self.n_inputs + 1, self.neurons, len(self.entries)
        q, P1 = len(self.rows), self.n_directions
        A, B, G, dA, dB, dG = self._continuous(theta) if self.form == "one-axis" else self._sampled(theta)
        K, dK = np.zeros((n, self.p)), np.zeros((P1, n, self.p))
        if self.gain:
            K = theta[k:P1].reshape(n, self.p).copy()
            dK[np.arange(k, P1), np.repeat(np.arange(n), self.p), np.tile(np.arange(self.p), n)] = 1.0
        W1, b1, W2 = np.split(theta[P1:], [h * (n + m - 1), h * (n + m)])
        return Matrices(
            A=A, B=B, K=K, G=G, W1=W1.reshape(h, n + m - 1).copy(), b1=b1.copy(), W2=W2.reshape(q, h).copy(),
            dA=dA, dB=dB, dK=dK, dG=dG,
        )  # fmt: skip

    def weights(self, theta: Array) -> Array:
        """Return [A | B | c] with all weights in, continuous in the form ``one-axis``.

        `theta`: (n_theta,), scaled. Returns (n, n + n_inputs + 1), scaled.
        """
        n = self.n
        M = np.zeros((n, n + self.n_inputs + 1))
        if self.form == "one-axis":
            M[0, 1] = self.scale[1] / self.scale[0]
        else:
            for j, step in enumerate(self.steps):
                if step:
                    M[j, j], M[j, j + 1] = 1.0, step
        for value, (r, c) in zip(theta, self.entries, strict=False):
            M[r, c] = value
        return M

    def _sampled(self, theta: Array) -> tuple[Array, ...]:
        n, q = self.n, len(self.rows)
        M = self.weights(theta)
        D = np.zeros((self.n_directions, *M.shape))
        for j, (r, c) in enumerate(self.entries):
            D[j, r, c] = 1.0
        G = np.zeros((n, q))
        G[list(self.rows), range(q)] = self.rates
        return (
            np.ascontiguousarray(M[:, :n]), np.ascontiguousarray(M[:, n:]), G,
            np.ascontiguousarray(D[:, :, :n]), np.ascontiguousarray(D[:, :, n:]), np.zeros((D.shape[0], n, q)),
        )  # fmt: skip

    def _continuous(self, theta: Array) -> tuple[Array, ...]:
        """Exponential of [[A, B, G], [0, 0, 0]] dt; derivatives from the doubled matrix (Mathias 1996)."""
        from scipy.linalg import expm

        n, m, q, k = self.n, self.n_inputs + 1, len(self.rows), len(self.entries)
        size = n + m + q
        block = np.zeros((k, 2 * size, 2 * size))
        block[:, :n, : n + m] = self.weights(theta)
        block[:, list(self.rows), range(n + m, size)] = self.rates
        block[:, size:, size:] = block[:, :size, :size]
        for j, (r, c) in enumerate(self.entries):
            block[j, r, size + c] = 1.0
        full = expm(block * self.dt)
        M = full[0, :n, :size]
        D = np.zeros((self.n_directions, n, size))
        D[:k] = full[:, :n, size:]
        cut = (slice(0, n), slice(n, n + m), slice(n + m, size))
        return (
            *(np.ascontiguousarray(M[:, c]) for c in cut),
            *(np.ascontiguousarray(D[:, :, c]) for c in cut),
        )  # fmt: skip


def one_axis_entries(connections: str) -> tuple[tuple[int, int], ...]:
    """Return the free weights of the form ``one-axis``, constants of force and voltage included."""
    of = {"thesis": _FIVE, "damped": ((1, 1), *_FIVE), "all": _ALL}[connections]
    return (*sorted(of), (1, 4), (2, 4))


def free_entries(chains: tuple[int, ...], n_inputs: int) -> tuple[tuple[int, int], ...]:
    """Return the free weights of the form ``free``.

    `chains`: states of each output.
    """
    n = sum(chains)
    ends = np.cumsum(chains) - 1
    heads = np.cumsum((0, *chains))[:-1]
    out = [(int(r), c) for r in ends for c in range(n)]
    out += [(r, n + c) for r in range(n) for c in range(n_inputs)]
    return (*out, *((int(r), n + n_inputs) for r in heads))
