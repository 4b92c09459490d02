"""A hidden layer G(x, u) put on the physics of a state-space network, and trained with it (thesis eq. 4.9)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ambid.estimation.progress import Tick, part_of
from ambid.nonlinear.networks.layout import Layout
from ambid.nonlinear.networks.nn_train import State, Trained, trained
from ambid.nonlinear.networks.residual import STIFF, Orthogonal, Ridge, orthogonal_to_physics
from ambid.nonlinear.networks.start import widened
from ambid.nonlinear.records import Scaled

_AGAIN = 3  # rounds more, where the network went elsewhere than it was bound at
_LEFT = 0.1  # projection on physics that is let be, in standard deviations of what it is projected on
_LATE = 0.9  # share of the time that is over before them


def added_network(
    state: State,
    data: Scaled,
    neurons: int,
    prior: float,
    anchored: bool,
    *,
    seed: list[int],
    iterations: int,
    tick: Tick | None,
) -> Trained:
    """Add a hidden layer to the physics and train both.

    `state`: with or without a hidden layer, which is begun anew; `prior`: deviation of the hidden layer's weights
    before the data; `anchored`: else orthogonal to what the free weights explain.
    """
    bare, bare_theta = widened(state.layout, state.theta, neurons=0)
    layout, theta = widened(bare, bare_theta, neurons=neurons, anchored=anchored)
    rng = np.random.default_rng(seed)
    d, k = layout.n + layout.n_inputs, layout.n_directions
    theta[k : k + neurons * d] = rng.standard_normal(neurons * d) / np.sqrt(d)
    theta[k + neurons * d : k + neurons * (d + 1)] = rng.standard_normal(neurons)
    ridge = Ridge(layout=layout, prior=prior)
    new = replace(state, layout=layout, theta=theta, penalties=(ridge,))
    if anchored:
        return trained(new, data, stage="hidden layer", iterations=iterations, tick=tick)
    found: Trained = None
    for k in range(len(STIFF) + _AGAIN):  # where the network goes, and its errors, are known only afterwards
        at = state if found is None else found[0]
        bound = _orthogonal(at, layout, data, STIFF[min(k, len(STIFF) - 1)])
        if k >= len(STIFF) and float(np.sum(bound.rows(at.theta)[1] ** 2)) < (_LEFT * STIFF[-1]) ** 2:
            break
        new = replace(new if found is None else found[0], penalties=(ridge, bound))
        own = part_of(tick, min(k / len(STIFF), _LATE), min((k + 1) / len(STIFF), 1.0))
        found = trained(new, data, stage="hidden layer", iterations=iterations, tick=own) or found
        if found is None:
            break
    return found


def _orthogonal(state: State, layout: Layout, data: Scaled, stiff: float) -> Orthogonal:
    """The penalty at the states that a network goes through."""
    problem = state.problem(data)
    X, E = problem.errors(state.vector)
    noise = np.full(layout.n, float(np.sqrt(np.mean(np.concatenate(E) ** 2))))
    return orthogonal_to_physics(layout, [x[:-1] for x in X], [s.u[:, :-1] for s in problem.shots], noise, stiff)
