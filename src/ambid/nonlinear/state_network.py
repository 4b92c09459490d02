"""A state-space network whose weights are A and B: layout of its weights, errors over records, model.

x+ = A x + B u + c + K e + G f(x, u), y = x[heads] + e (thesis eq. 5.1, fig. 5.9). ``one-axis``: weights are entries of
the continuous A and B of thesis eq. 4.8 (position, velocity, current), sampled by the matrix exponential. ``free``:
those sampled; an unmeasured state is the scaled difference before it, x_j+ = x_j + step x_(j+1) + .., which makes them
unique.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.estimation.estimate import fields_json, read_as
from ambid.estimation.linear import triangle_of
from ambid.nonlinear.records import Parts, ScaledModel, read_numbers, scaled, with_head

Table = NDArray[np.int64]

ONE_AXIS = ((1, 0), (1, 2), (2, 1), (2, 2), (2, 3), (1, 4), (2, 4))
"""Free weights of thesis eq. 4.8 in [A | B | c]: a21, a23, a32, a33, b3, and constants of force and voltage."""

_ROWS = 2048  # that are joined and reduced at once: they stay in the cache

# --- weights and matrices --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Matrices:
    """What the recursions want, in scaled signals: M = [A | B | c | G | K] and its slopes D, the hidden layer."""

    heads: Table  # (n_outputs,), state that each output is
    M: Array  # (n, n + n_inputs + 1 + n_rows + n_outputs)
    D: Array  # (*M.shape, n_directions), by the first weights
    W1: Array
    b1: Array
    W2: Array

    @property
    def A(self) -> Array:
        """Of the sampled linear part."""
        return self.M[:, : self.M.shape[0]]

    @property
    def B(self) -> Array:
        """Of the sampled linear part, without the constant."""
        n, width = self.M.shape[0], self.W1.shape[1]
        return self.M[:, n:width]

    @property
    def K(self) -> Array:
        """Predictor gain."""
        return self.M[:, -self.heads.size :]

    def without_gain(self, *, hidden: bool = True) -> Matrices:
        """Return the matrices without gain, and without slopes by it; `hidden` false leaves out the units as well."""
        M, D, first = self.M.copy(), self.D.copy(), -self.heads.size if hidden else self.W1.shape[1] + 1
        M[:, first:], D[:, first:] = 0.0, 0.0
        return replace(self, M=M, D=D)

    def run(self, y: Array, u: Array, x0: Array) -> tuple[Array, Array]:
        """Return states (n_samples + 1, n) from `x0` and innovations (n_samples, p), NaN from a divergence on;
        `u`'s last column is ones.
        """
        from ambid.nonlinear.kernels import run_states

        X, E = np.empty((u.shape[0] + 1, x0.size)), np.empty((u.shape[0], self.heads.size))
        X[0] = x0
        run_states(self.M, self.heads, self.W1, self.b1, self.W2, u, y, X, E)
        return X, E

    def slopes(self, u: Array, X: Array, E: Array, s: Array) -> Array:
        """Return the predictions' slopes (n_samples, p, n_columns) along `run`; `s` (n, n_columns) goes from the
        first state's to the last's.
        """
        from ambid.nonlinear.kernels import slope_states

        out = np.empty((u.shape[0], self.heads.size, s.shape[1]))
        changed = np.any(self.D != 0.0, axis=2).astype(np.int64)
        slope_states(self.M, self.heads, self.W1, self.b1, self.W2, self.D, changed, u, X, E, s, out)
        return out


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Which weights are free, and what they are in matrices."""

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

    @classmethod
    def free(
        cls, dt: float, chains: tuple[int, ...], steps: Sequence[float], scale: Sequence[float], **more: Any
    ) -> Layout:
        """Return the form ``free``, of which `chains` counts the states of each output."""
        n = sum(chains)
        m, heads, ends = len(scale) - n, np.cumsum((0, *chains))[:-1].tolist(), (np.cumsum(chains) - 1).tolist()
        entries = [(r, c) for r in ends for c in range(n)] + [(r, n + c) for r in range(n) for c in range(m)]
        entries += [(r, n + m) for r in heads]
        return cls(
            form="free", dt=dt, n_inputs=m, heads=tuple(heads), steps=tuple(steps), entries=tuple(entries),
            scale=tuple(scale), rates=(1.0,) * n, rows=tuple(range(n)), **more,
        )  # fmt: skip

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
    def hidden_sizes(self) -> tuple[int, int, int]:
        """Numbers of weights in W1, b1, W2."""
        return self.neurons * (self.n + self.n_inputs), self.neurons, self.neurons * len(self.rows)

    @property
    def n_theta(self) -> int:
        """All weights."""
        return self.n_directions + sum(self.hidden_sizes)

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
        n, m, units = self.n, self.n_inputs, range(self.neurons)
        out = []
        for r, c in self.entries:
            of_input = f"b{r + 1}" if m == 1 else f"b{r + 1}{c - n + 1}"
            out.append(f"a{r + 1}{c + 1}" if c < n else f"c{r + 1}" if c == n + m else of_input)
        if self.gain:
            out += [f"k{i + 1}{j + 1}" for i in range(n) for j in range(self.p)]
        z = [f"x{j + 1}" for j in range(n)] + [f"u{j + 1}" for j in range(m)]
        out += [f"unit {k + 1}: {x}" for k in units for x in z]
        out += [f"unit {k + 1}: 1" for k in units]
        return (*out, *(f"x{r + 1}: unit {k + 1}" for r in self.rows for k in units))

    def widen(self, theta: Array, **changes: Any) -> tuple[Layout, Array]:
        """Return the layout with another ``gain`` or number of ``neurons``, and its weights; new ones are zero."""
        new = replace(self, **changes)
        out = np.zeros(new.n_theta)
        k = len(self.entries)
        out[:k] = theta[:k]
        if self.gain == new.gain:
            out[k : new.n_directions] = theta[k : self.n_directions]
        if self.neurons == new.neurons:
            out[new.n_directions :] = theta[self.n_directions :]
        return new, out

    def matrices(self, theta: Array) -> Matrices:
        """Return the matrices of a sample and their derivatives; `theta` is scaled."""
        n, h, k, P1, q = self.n, self.neurons, len(self.entries), self.n_directions, len(self.rows)
        F, dF = np.zeros((n, n + self.n_inputs + 1 + q)), np.zeros((k, n, n + self.n_inputs + 1 + q))
        F[:, : F.shape[1] - q] = self.weights(theta)
        F[list(self.rows), range(F.shape[1] - q, F.shape[1])] = self.rates
        for j, (r, c) in enumerate(self.entries):
            dF[j, r, c] = 1.0
        if self.form == "one-axis":
            F, dF = _sampled(F, dF, self.dt)
        M, D = np.hstack([F, np.zeros((n, self.p))]), np.zeros((n, F.shape[1] + self.p, P1))
        D[:, : F.shape[1], :k] = np.moveaxis(dF, 0, 2)
        if self.gain:
            M[:, F.shape[1] :] = theta[k:P1].reshape(n, self.p)
            D[:, F.shape[1] :, k:] = np.eye(n * self.p).reshape(n, self.p, -1)
        W1, b1, W2 = np.split(theta[P1:], np.cumsum(self.hidden_sizes)[:2])
        return Matrices(
            heads=np.array(self.heads, dtype=np.int64), M=M, D=D, W1=W1.reshape(h, n + self.n_inputs).copy(),
            b1=b1.copy(), W2=W2.reshape(q, h).copy(),
        )  # fmt: skip

    def weights(self, theta: Array) -> Array:
        """Return [A | B | c], scaled, (n, n + n_inputs + 1), all weights in, continuous for ``one-axis``."""
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


def _sampled(F: Array, dF: Array, dt: float) -> tuple[Array, Array]:
    """Upper rows of the exponential of [[F], [0]] dt, and their slopes from the doubled matrix (Mathias 1996)."""
    from scipy.linalg import expm

    (n, size), k = F.shape, dF.shape[0]
    block = np.zeros((k, 2 * size, 2 * size))
    block[:, :n, :size] = F
    block[:, size : size + n, size:] = F
    block[:, :n, size:] = dF
    full = expm(block * dt)
    return full[0, :n, :size], full[:, :n, size:]


# --- runs and errors -------------------------------------------------------------------------------------------------


def largest_pole(layout: Layout, theta: Array) -> float:
    """Return the largest modulus of the poles of the linear predictor, A - K C; infinite where it is not finite."""
    m = layout.matrices(theta)
    F = m.A.copy()
    if layout.gain:
        F[:, layout.heads] -= m.K
    return float(np.max(np.abs(np.linalg.eigvals(F)))) if np.all(np.isfinite(F)) else np.inf


@dataclass(frozen=True, kw_only=True, eq=False)
class StateProblem:
    """Weighted errors of a state-space network over records; unknown are (weights, first state of every record)."""

    layout: Layout
    parts: Parts  # inputs with a last column of ones
    weight: Array  # (n_outputs, n_outputs), errors times it have unit covariance
    prior: float | None = None  # deviation of the hidden layer's weights before the data
    # modulus that no pole of the linear predictor A - K C may reach. Without it the search creeps towards a predictor
    # that runs away from its first state on: on a plant without process noise that fits the sample a little better.
    farthest: float = np.inf

    def split(self, v: Array) -> tuple[Array, Array]:
        """Return weights (n_theta,) and first states (n_records, n)."""
        return v[: self.layout.n_theta], v[self.layout.n_theta :].reshape(len(self.parts), self.layout.n)

    def errors(self, v: Array) -> tuple[list[Array], list[Array]]:
        """Return states and errors of every record."""
        theta, x0 = self.split(v)
        m = self.layout.matrices(theta)
        runs = [m.run(y, u, x) for (y, u), x in zip(self.parts, x0, strict=True)]
        return [X for X, _ in runs], [E for _, E in runs]

    def prior_rows(self, v: Array) -> Array:
        """Return rows -w / prior for each weight w of the hidden layer, with their slopes before them."""
        hidden = np.arange(self.layout.n_directions, self.layout.n_theta) if self.prior else np.arange(0)
        rows = np.zeros((hidden.size, v.size + 1))
        rows[np.arange(hidden.size), hidden] = 1.0 / (self.prior or 1.0)
        rows[:, -1] = -v[hidden] / (self.prior or 1.0)
        return rows

    def cost(self, theta: Array) -> float:
        """Return the sum of squares of all rows; infinite where the model diverges."""
        weights = self.split(theta)[0]
        if not np.all(np.isfinite(theta)) or np.max(np.abs(weights)) > 1e12:
            return np.inf
        with np.errstate(over="ignore", invalid="ignore"):
            if np.isfinite(self.farthest) and not largest_pole(self.layout, weights) < self.farthest:
                return np.inf
            total = sum(float(np.sum((e @ self.weight) ** 2)) for e in self.errors(theta)[1])
            total += float(np.sum(self.prior_rows(theta)[:, -1] ** 2))
        return total if np.isfinite(total) else np.inf

    def triangle(self, theta: Array) -> Array:
        """Return the triangle of [J | r] of all rows."""
        rows = [self.prior_rows(theta)]
        with np.errstate(over="ignore", invalid="ignore"):
            for k, both in enumerate(self._own_rows(theta)):
                width, some = both.shape[2], range(0, both.shape[1], _ROWS)
                rows.append(
                    self._widen(triangle_of([both[:, a : a + _ROWS].reshape(-1, width) for a in some]), k, theta.size)
                )
        return triangle_of([np.concatenate(rows)])

    def sample_rows(self, v: Array) -> list[Array]:
        """Return slopes and errors of every sample, joined to ones of unit variance: (n_samples, p, v.size + 1)."""
        return [np.moveaxis(self._widen(both, k, v.size), 0, 1) for k, both in enumerate(self._own_rows(v))]

    def _own_rows(self, v: Array) -> Iterator[Array]:
        """Weighted slopes by (weights, own first state) and errors of each record, outputs along the first axis."""
        theta, x0 = self.split(v)
        layout, m = self.layout, self.layout.matrices(theta)
        for (y, u), x in zip(self.parts, x0, strict=True):
            X, E = m.run(y, u, x)
            s = np.hstack([np.zeros((layout.n, theta.size)), np.eye(layout.n)])
            both = np.concatenate([m.slopes(u, X, E, s), E[:, :, None]], axis=2)
            yield np.tensordot(self.weight, both, axes=(0, 1))

    def _widen(self, rows: Array, k: int, size: int) -> Array:
        """Rows of record `k` over all unknown: other records' first states do not enter."""
        P, n = self.layout.n_theta, self.layout.n
        wide = np.zeros((*rows.shape[:-1], size + 1))
        wide[..., :P], wide[..., P + k * n : P + (k + 1) * n] = rows[..., :P], rows[..., P:-1]
        wide[..., -1] = rows[..., -1]
        return wide


# --- model -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, eq=False)
class StateNetwork(ScaledModel):
    """A trained network (implements `NonlinearModel`), entries of A and B in SI, else scaled; cloud of states and
    inputs. The first state fits the first `lag` samples best, without G and K.
    """

    kind: ClassVar[str] = "nn"
    layout: Layout
    delay: int = 0  # samples by which inputs act late

    @property
    def dt(self) -> float:
        """Sampling interval in s."""
        return self.layout.dt

    @property
    def lag(self) -> int:
        """Samples from which the first state is found."""
        return self.delay + self._head

    @property
    def _head(self) -> int:
        """Samples that the first state is fitted to."""
        return max(3 * self.layout.n, 5)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the weights."""
        return self.layout.names

    @property
    def A(self) -> Array:
        """Weights of the states, shape (n, n), SI; continuous in the form ``one-axis``, else of a sample."""
        size = np.array(self.layout.scale)[: self.layout.n]
        matrix: Array = self._weights[:, : self.layout.n] * size[:, None] / size
        return matrix

    @property
    def B(self) -> Array:
        """Weights of the inputs, shape (n, n_inputs), SI; continuous in the form ``one-axis``, else of a sample."""
        n, size = self.layout.n, np.array(self.layout.scale)
        matrix: Array = self._weights[:, n:-1] * size[:n, None] / size[n:]
        return matrix

    @property
    def unit(self) -> Array | float:
        """As `ScaledModel.unit`."""
        return self.layout.unit

    @property
    def _weights(self) -> Array:
        return self.layout.weights(self.scaled_theta)

    def predict(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.predict`; NaN from where the predictor diverges on."""
        X = self.states(u, y)
        out: Array = self.y_level + self.y_scale * X[:, self.layout.heads]
        out[: self.lag] = np.nan
        return out

    def states(self, u: Array, y: Array) -> Array:
        """Return predicted scaled states (n_samples, n): NaN in the first `delay` rows, from a divergence on."""
        ys, us = self._late(u, y)
        x0, _ = self._first_state(ys, us, derive=False)
        out = np.full((np.asarray(u).shape[0], self.layout.n), np.nan)
        out[self.delay :] = self.layout.matrices(self.scaled_theta).run(ys, us, x0)[0][:-1]
        return out

    def jacobian(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.jacobian`, that of the first state included."""
        layout, m, (ys, us) = self.layout, self.layout.matrices(self.scaled_theta), self._late(u, y)
        x0, s = self._first_state(ys, us, derive=True)
        X, E = m.run(ys, us, x0)
        out = np.zeros((np.asarray(u).shape[0], self.n_outputs, self.theta.size))
        out[self.delay :] = m.slopes(us, X, E, s) * (self.y_scale[:, None] / layout.unit)
        out[: self.lag] = 0.0
        return out

    def simulate(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.simulate`, from the state that these samples show."""
        whole, head = with_head(self, u, y)
        m, (ys, us) = self.layout.matrices(self.scaled_theta), self._late(u, whole)
        x0, _ = self._first_state(ys, us, derive=False)
        k = min(self._head, us.shape[0])
        x = m.run(ys[:k], us[:k], x0)[0][-1]
        rest = m.without_gain().run(ys[k:], us[k:], x)[0][:-1]
        whole[head:] = self.y_level + self.y_scale * rest[:, self.layout.heads]
        return whole

    def novelty(self, u: Array, y: Array) -> Array:
        """As `NonlinearModel.novelty`, of predicted states and inputs (see `nonlinear.records`)."""
        out = np.full(np.asarray(u).shape[0], np.nan)
        out[self.lag :] = self.cloud.novelty(self.regressors(u, y))
        return out

    def regressors(self, u: Array, y: Array) -> Array:
        """Return state and input one sample before each prediction, scaled: (n_samples - lag, n + n_inputs)."""
        X, k = self.states(u, y), self.lag
        us = (np.asarray(u, dtype=np.float64) - self.u_level) / self.u_scale
        return np.hstack([X[k - 1 : -1], us[k - 1 - self.delay : us.shape[0] - 1 - self.delay]])

    def _late(self, u: Array, y: Array) -> tuple[Array, Array]:
        """Scaled outputs from `delay` on, each with the input that acts at its time and a one."""
        ys, us = scaled(self, u, y)
        us = us[: max(us.shape[0] - self.delay, 0)]
        return np.ascontiguousarray(ys[self.delay :]), np.hstack([us, np.ones((us.shape[0], 1))])

    def _first_state(self, y: Array, u: Array, *, derive: bool) -> tuple[Array, Array]:
        """The first state that fits the first samples best, and its slopes by the weights."""
        y, u = y[: self._head], u[: self._head]
        return _solve_first_state(self.layout.matrices(self.scaled_theta), self.layout.n_theta, y, u, derive=derive)

    def as_json(self) -> dict[str, Any]:
        """As `NonlinearModel.as_json`."""
        layout = fields_json(self.layout, without=("dt",))
        return {"dt_s": self.dt, "delay": self.delay, "layout": layout, **self.numbers_json()}

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> Self:
        """Read it back from what `as_json` made."""
        layout = read_as(Layout, {**document["layout"], "dt": document["dt_s"]}, "layout")
        places = [*layout.rows, *(r for r, _ in layout.entries)]
        columns = [c for _, c in layout.entries]
        inside = min((*places, *columns, *layout.heads)) >= 0 and max(places) < layout.n
        inside = inside and max(columns) <= layout.n + layout.n_inputs and max(layout.heads) < layout.n
        if layout.form not in ("one-axis", "free") or not inside:
            raise EstimationError("this is not a state network: its states are not those of one. Write the file again")
        n_cloud = layout.n + layout.n_inputs
        numbers = read_numbers(document, layout.n_theta, layout.n_inputs, layout.p, n_cloud)
        return cls(layout=layout, delay=int(document["delay"]), **numbers)


def _solve_first_state(m: Matrices, P: int, y: Array, u: Array, *, derive: bool) -> tuple[Array, Array]:
    """Least squares without hidden layer and gain, O x0 = y - (forced response), and its slopes by `P` weights: dx0 =
    (O'O)^-1 (dO' r - O' d(O x0 + forced)), r what is left.
    """
    n, linear = m.M.shape[0], m.without_gain(hidden=False)
    still = np.zeros_like(y), np.zeros_like(u)
    runs = [linear.run(*still, e) for e in np.eye(n)]
    forced = linear.run(y, u, np.zeros(n))[0][:-1, m.heads].ravel()
    O = np.stack([X[:-1, m.heads].ravel() for X, _ in runs], axis=1)  # noqa: E741
    x0: Array = np.asarray(np.linalg.lstsq(O, y.ravel() - forced, rcond=None)[0], dtype=np.float64)
    if not derive:
        return x0, np.empty((n, 0))
    X, E = linear.run(y, u, x0)
    D = linear.slopes(u, X, E, np.zeros((n, P))).reshape(-1, P)
    left = y.ravel() - forced - O @ x0
    bent = np.stack([left @ linear.slopes(still[1], X, E, np.zeros((n, P))).reshape(-1, P) for X, E in runs])
    s: Array = np.ascontiguousarray(np.linalg.solve(O.T @ O, bent - O.T @ D), dtype=np.float64)
    return x0, s
