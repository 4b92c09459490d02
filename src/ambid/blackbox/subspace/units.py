"""From scaled channels back to SI: coefficients, known delays as states, operating point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.blackbox.response import Offsets
from ambid.blackbox.state_space import StateSpaceModel
from ambid.blackbox.subspace.compress import Channels
from ambid.blackbox.subspace.plan import Plan
from ambid.blackbox.subspace.realisation import Realisation


def with_units(scaled: Realisation, given: Channels, dt: float) -> tuple[StateSpaceModel, Array]:
    """Return the model in SI, and what its coefficients were multiplied by.

    Returns `scale`: (n_theta,).
    """
    u, y = given.scale_u, given.scale_y
    n = scaled.A.shape[0]
    factors = {
        "A": np.ones((n, n)),
        "B": np.ones((n, 1)) / u,
        "C": y[:, None] * np.ones((1, n)),
        "D": y[:, None] / u,
        "K": np.ones((n, 1)) / y,
    }
    model = StateSpaceModel(**{m: getattr(scaled, m) * f for m, f in factors.items()}, dt=dt)
    return model, np.concatenate([f.ravel() for f in factors.values()])


def embedded(core: StateSpaceModel, nk: tuple[int, ...]) -> tuple[StateSpaceModel, NDArray[np.intp]]:
    """Put known input delays back as states that hand the input on.

    `core`: for inputs that come nk - 1 samples early. Returns `model`: for the inputs as recorded; `places`: (n_theta
    of core,), where each coefficient of the core is among those of the model.
    """
    n, extra = core.order, sum(k - 1 for k in nk)
    N, n_u, n_y = n + extra, core.n_inputs, core.n_outputs
    value = {m: np.zeros(s) for m, s in zip("ABCDK", ((N, N), (N, n_u), (n_y, N), (n_y, n_u), (N, n_y)), strict=True)}
    value["A"][:n, :n], value["C"][:, :n], value["K"][:n] = core.A, core.C, core.K
    home = {
        "A": [(i, j) for i in range(n) for j in range(n)],
        "B": [],
        "C": [(i, j) for i in range(n_y) for j in range(n)],
        "D": [],
        "K": [(i, j) for i in range(n) for j in range(n_y)],
    }
    entry: list[tuple[str, int]] = []  # for each input: matrices and column by which it enters the core
    first = n
    for j, k in enumerate(nk):
        if k == 1:
            entry.append(("now", j))
            continue
        for i in range(first, first + k - 2):
            value["A"][i, i + 1] = 1.0
        value["B"][first + k - 2, j] = 1.0
        entry.append(("late", first))
        first += k - 1
    for j, (when, column) in enumerate(entry):
        value["B" if when == "now" else "A"][:n, column] = core.B[:, j]
        value["D" if when == "now" else "C"][:, column] = core.D[:, j]
    model = StateSpaceModel(**value, dt=core.dt)
    index = {name: i for i, name in enumerate(model.names)}
    places = [index[f"A[{i},{j}]"] for i, j in home["A"]]
    places += [index[f"{'B' if w == 'now' else 'A'}[{i},{c}]"] for i in range(n) for w, c in entry]
    places += [index[f"C[{i},{j}]"] for i, j in home["C"]]
    places += [index[f"{'D' if w == 'now' else 'C'}[{i},{c}]"] for i in range(n_y) for w, c in entry]
    places += [index[f"K[{i},{j}]"] for i, j in home["K"]]
    return model, np.array(places, dtype=np.intp)


def offsets(scaled: Realisation, plan: Plan) -> Offsets:
    """Return the operating point at which the innovations have no mean.

    A shift of y by dy and of u by du moves their mean by Py dy - Pu du, the predictor's answers at frequency zero:
    finite and solvable for unstable plants and integrators too. The shortest shift of means is taken.
    """
    f, s = plan.factors, scaled
    mean = plan.total[0] / plan.total[0, 0]
    now = f.length - 1
    error = mean[f.columns("y", now, now + 1)] - s.D @ mean[f.columns("u", now, now + 1)]
    F, G = s.A - s.K @ s.C, np.hstack([s.B - s.K @ s.D, s.K])
    row = s.C
    for k in range(now - 1, -1, -1):
        error = error - row @ (G @ mean[f.columns("z", k, k + 1)])
        row = row @ F
    return operating_point(scaled, plan.channels, error)


def operating_point(scaled: Realisation, given: Channels, error: Array) -> Offsets:
    """Return the shortest shift of the channels' means that takes a mean off the innovations.

    `error`: (n_outputs,), mean of the innovations of the centred, scaled channels.
    """
    s = scaled
    n, n_u = s.A.shape[0], s.B.shape[1]
    F, G = s.A - s.K @ s.C, np.hstack([s.B - s.K @ s.D, s.K])
    at_rest = s.C @ np.linalg.solve(np.eye(n) - F, G)
    by = np.hstack([np.eye(s.C.shape[0]) - at_rest[:, n_u:], -(s.D + at_rest[:, :n_u])])
    shift = np.linalg.lstsq(by, -error, rcond=1e-6)[0]
    n_y = s.C.shape[0]
    return Offsets(u=given.mean_u - shift[n_y:] * given.scale_u, y=given.mean_y - shift[:n_y] * given.scale_y)
