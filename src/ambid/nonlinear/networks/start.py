"""First weights of a state-space network: a subspace model, carried to the network's own states.

A predictor-based subspace estimate (PBSID-opt) stands for any stability and under feedback. Its states are turned into
those of the network: measured outputs, and rates (``one-axis``; after the matrix logarithm) or differences (``free``).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.data import IOData
from ambid.errors import EstimationError
from ambid.nonlinear.networks.layout import Layout, free_entries, one_axis_entries
from ambid.nonlinear.records import Scaled

SHORT = 6  # samples of past: enough where the plant is stable and sampled well


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Start:
    """Where the training of a network begins."""

    layout: Layout  # without gain and hidden layer
    theta: Array  # (n_theta,)
    K: Array  # (n, n_outputs), scaled


def start_one_axis(data: Scaled, dt: float, heads: tuple[int, ...], connections: str, past: int = SHORT) -> Start | str:
    """Return the start in the form ``one-axis``.

    `dt`: s; `heads`: state (position, velocity, current) that each output is; `past`: samples that the first model
    looks back. Returns the reason where there is none.
    """
    found = _subspace(data, 3, past)
    if isinstance(found, str):
        return found
    A, B, C, K = found
    continuous = _logarithm(A, B, dt)
    if continuous is None:
        return "the sampled model has no continuous one (a pole on the negative real axis): sample faster"
    Ac, Bc = continuous
    at = {s: C[o] for o, s in enumerate(heads)}
    if 0 not in at or 2 not in at:
        return "position and current are needed as outputs"
    velocity = at[1] if 1 in at else at[0] @ Ac
    unit = float(np.linalg.norm(velocity)) or 1.0
    T = np.stack([at[0], velocity if 1 in at else velocity / unit, at[2]])
    if not np.linalg.cond(T) < 1e10:
        return "position, velocity and current cannot be told apart in the record: excite more"
    back = np.linalg.inv(T)
    M = np.hstack([T @ Ac @ back, T @ Bc, np.zeros((3, 1))])
    scale = np.empty(3)
    for o, s in enumerate(heads):
        scale[s] = data.y_scale[o]
    if 1 not in at:  # the velocity's scale makes x1' = x2 in SI
        scale[1] = scale[0] * unit
    layout = Layout(
        form="one-axis",
        dt=dt,
        n_inputs=1,
        heads=heads,
        steps=(),
        entries=one_axis_entries(connections),
        scale=(*scale.tolist(), *data.u_scale.tolist()),
        rates=tuple(float(np.linalg.norm(M[r, :4])) or 1.0 for r in (1, 2)),
        rows=(1, 2),
    )
    return Start(layout=layout, theta=np.array([M[r, c] for r, c in layout.entries]), K=T @ K)


def start_free(data: Scaled, dt: float, n: int, past: int = SHORT) -> Start | str:
    """Return the start in the form ``free``.

    `dt`: s; `n`: states; at least one for each output; `past`: samples that the first model looks back. Returns the
    reason where there is none.
    """
    p, m = data.y_level.size, data.u_level.size
    if n < p:
        raise EstimationError(f"nn: {n} state(s) for {p} outputs; each output is a state. Raise states")
    found = _subspace(data, n, past)
    if isinstance(found, str):
        return found
    A, B, C, K = found
    chains = tuple(n // p + (o < n % p) for o in range(p))
    T, steps = [], []
    for o, length in enumerate(chains):
        row = C[o]
        for j in range(length):
            T.append(row)
            ahead = row @ A - row
            step = float(np.linalg.norm(ahead)) / max(float(np.linalg.norm(row)), 1e-300) if j + 1 < length else 0.0
            steps.append(step)
            row = ahead / step if step else row
    T_all = np.stack(T)
    if not np.linalg.cond(T_all) < 1e10:
        return "the outputs do not show all states: lower states, or excite more"
    back = np.linalg.inv(T_all)
    M = np.hstack([T_all @ A @ back, T_all @ B, np.zeros((n, 1))])
    layout = Layout(
        form="free",
        dt=dt,
        n_inputs=m,
        heads=tuple(int(x) for x in np.cumsum((0, *chains))[:-1]),
        steps=tuple(steps),
        entries=free_entries(chains, m),
        scale=(*np.repeat(data.y_scale, chains).tolist(), *data.u_scale.tolist()),
        rates=(1.0,) * n,
        rows=tuple(range(n)),
    )
    return Start(layout=layout, theta=np.array([M[r, c] for r, c in layout.entries]), K=T_all @ K)


def _subspace(data: Scaled, n: int, past: int) -> tuple[Array, Array, Array, Array] | str:
    """Predictor-based subspace model of the longest record, in scaled signals."""
    from ambid.blackbox.subspace import pbsid

    y, u = max(data.parts, key=lambda part: part[0].shape[0])
    names = tuple(f"u{k}" for k in range(u.shape[1])), tuple(f"y{k}" for k in range(y.shape[1]))
    past = max(2 * -(-n // y.shape[1]), past)
    past = min(past, max(y.shape[0] // (3 * (y.shape[1] + u.shape[1])) - 2, 2))
    try:
        io = IOData(u=u, y=y, dt=1.0, inputs=names[0], outputs=names[1], units=dict.fromkeys(names[0] + names[1], "1"))
        model = pbsid(io, {"n": n}, past=past, horizon=past, feedthrough=False).model
    except (EstimationError, np.linalg.LinAlgError) as error:
        return f"no first model: {error}"
    found = tuple(np.asarray(getattr(model, k), dtype=np.float64) for k in "ABCK")
    if not all(np.all(np.isfinite(x)) for x in found):
        return "no first model: its matrices are not finite"
    return found  # type: ignore[return-value]


def _logarithm(A: Array, B: Array, dt: float) -> tuple[Array, Array] | None:
    """Continuous A and B whose zero-order hold is A and B; None where there is no real one."""
    from scipy.linalg import logm

    n, m = B.shape
    poles = np.linalg.eigvals(A)
    if np.any((poles.real <= 0) & (np.abs(poles.imag) < 1e-9 * np.abs(poles))):
        return None
    block = np.zeros((n + m, n + m))
    block[:n, :n], block[:n, n:], block[n:, n:] = A, B, np.eye(m)
    found = np.asarray(logm(block))
    if np.iscomplexobj(found):
        if np.max(np.abs(found.imag)) > 1e-6 * np.max(np.abs(found.real)):
            return None
        found = found.real
    return found[:n, :n] / dt, found[:n, n:] / dt


def carried_to_continuous(layout: Layout, A: Array, B: Array) -> tuple[Array, Array] | None:
    """Carry sampled A and B to continuous ones in SI by the matrix logarithm.

    `A`: (n, n), scaled; `B`: (n, n_inputs), scaled. Returns none where there is no real logarithm.
    """
    found = _logarithm(A, B, layout.dt)
    if found is None:
        return None
    size = np.array(layout.scale)
    n = layout.n
    return found[0] * size[:n, None] / size[:n], found[1] * size[:n, None] / size[n:]


def widened(layout: Layout, theta: Array, **changes: object) -> tuple[Layout, Array]:
    """Return a layout with a gain or a hidden layer more, the new weights zero.

    `theta`: (n_theta,); `changes`: ``gain``, ``neurons``, ``anchored``. Returns `theta`: (n_theta,).
    """
    new = replace(layout, **changes)  # type: ignore[arg-type]
    out = np.zeros(new.n_theta)
    k = len(layout.entries)
    out[:k] = theta[:k]
    if layout.gain and new.gain:
        out[k : new.n_directions] = theta[k : layout.n_directions]
    if layout.neurons and layout.neurons == new.neurons:
        out[new.n_directions :] = theta[layout.n_directions :]
    return new, out
