"""Prediction-error estimate of a polynomial model, each output by itself (Ljung 1999, ch. 7 and 10).

Minimise the squared residual of the predictor (thesis eq. 3.12) over coefficients, initial states and offset, from
starts that need no help; covariance sigma^2 (J'J)^-1 of the coefficients from the triangle of the gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ambid.errors import EstimationError
from ambid.identify.blackbox.data import IOData
from ambid.identify.blackbox.fit import BlackBoxFit
from ambid.identify.blackbox.made import made
from ambid.identify.blackbox.polynomial_model import PolynomialModel
from ambid.identify.blackbox.response import Offsets
from ambid.identify.polynomial.orders import Layout, Orders, fixed_places, layout_of, read_orders, shown_orders
from ambid.identify.polynomial.predictor import predictor
from ambid.identify.polynomial.search import Fitted, searched
from ambid.identify.polynomial.stability import stable_predictor
from ambid.identify.polynomial.starts import starts
from ambid.identify.threads import one_thread

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scaled:
    """Data without means, in units of their standard deviations.

    Attributes
    ----------
    u, y : ndarray, shape (n_inputs, n_samples), (n_outputs, n_samples)
    u_mean, u_scale : ndarray, shape (n_inputs,)
    y_mean, y_scale : ndarray, shape (n_outputs,)
    """

    u: Array
    y: Array
    u_mean: Array
    u_scale: Array
    y_mean: Array
    y_scale: Array


def estimate(
    name: str,
    data: IOData,
    orders: Orders,
    fixed: Mapping[str, float] | None,
    tick: Callable[[], None] | None,
) -> BlackBoxFit:
    """Fit one of the eight structures.

    Parameters
    ----------
    name : str
    data : IOData
    orders : Mapping[str, int or tuple of int]
    fixed : Mapping[str, float] or None
        Known coefficients, by the names of `PolynomialModel.names`, in SI.
    tick : callable or None
        Called before each look at the data.

    Returns
    -------
    BlackBoxFit

    Raises
    ------
    EstimationError
        If the orders break a rule, the record is too short, or a channel does not move.
    """
    read = read_orders(name, data, orders)
    scaled = scaled_data(name, data)
    if "nk" in read and read["nk"] is None:
        read["nk"] = (1,) * data.n_inputs
    layouts = (layout_of(read, data.n_inputs),) * data.n_outputs
    known = fixed_places(name, layouts, {} if fixed is None else fixed)
    with one_thread():
        fits = [
            fit_output(name, replace(layout, fixed=tuple(known[o])), scaled, o, known[o], tick)
            for o, layout in enumerate(layouts)
        ]
    return _result(name, data, scaled, [replace(x, fixed=tuple(k)) for x, k in zip(layouts, known, strict=True)], fits)


def scaled_data(name: str, data: IOData) -> Scaled:
    """Take off means and divide by standard deviations.

    Parameters
    ----------
    name : str
    data : IOData

    Returns
    -------
    Scaled

    Raises
    ------
    EstimationError
        If a channel does not move.
    """
    out = []
    for values, names in ((data.u, data.inputs), (data.y, data.outputs)):
        mean = np.mean(values, axis=0)
        centred = np.ascontiguousarray((values - mean).T)
        scale = np.sqrt(np.mean(centred**2, axis=1)) if values.size else np.ones(0)
        for k, channel in enumerate(names):
            if not scale[k] > 1e-13 * np.max(np.abs(values[:, k])):
                raise EstimationError(
                    f"{name}: {channel!r} does not move (constant at {mean[k]:g}); nothing can be learnt from it. "
                    "Excite it, or leave it out"
                )
        out.append((np.asarray(centred / scale[:, None]), mean, scale))
    (u, u_mean, u_scale), (y, y_mean, y_scale) = out
    return Scaled(u=u, y=y, u_mean=u_mean, u_scale=u_scale, y_mean=y_mean, y_scale=y_scale)


def unit(layout: Layout, scaled: Scaled, o: int) -> Array:
    """Return what one scaled coefficient is worth in SI, shape (n_theta,).

    Parameters
    ----------
    layout : Layout
    scaled : Scaled
    o : int
        Output.

    Returns
    -------
    ndarray, shape (n_theta,)
    """
    out = np.ones(layout.n_theta)
    for i in range(layout.n_inputs):
        out[layout.places["B", i]] = scaled.y_scale[o] / scaled.u_scale[i]
    return out


def fit_output(
    name: str,
    layout: Layout,
    scaled: Scaled,
    o: int,
    known: Mapping[int, float],
    tick: Callable[[], None] | None,
) -> Fitted:
    """Fit one output from the best of its starts.

    Parameters
    ----------
    name : str
    layout : Layout
    scaled : Scaled
    o : int
    known : Mapping[int, float]
        Fixed coefficients by place, SI.
    tick : callable or None

    Returns
    -------
    Fitted

    Raises
    ------
    EstimationError
        If the record is too short.
    """
    p, y = predictor(layout), scaled.y[o]
    need = layout.first_row + 2 * (p.n_nuisance + layout.free.size) + 1
    if y.size < need:
        raise EstimationError(
            f"{name}: {y.size} samples for {layout.free.size} coefficients; at least {need} are needed. "
            "Lower the orders, or take a longer part of the record"
        )
    worth = unit(layout, scaled, o)
    best: Fitted | None = None
    for start in starts(layout, y, scaled.u):
        for place, value in known.items():
            start[place] = value / worth[place]
        if not stable_predictor(layout, start):
            continue
        found = searched(p, y, scaled.u, start, tick=tick)
        if best is None or found.cost < best.cost:
            best = found
        if best.converged:
            break
    if best is None:
        raise EstimationError(f"{name}: no stable predictor to start from. Change the fixed coefficients of C or F")
    return best


def _result(name: str, data: IOData, scaled: Scaled, layouts: list[Layout], fits: list[Fitted]) -> BlackBoxFit:
    thetas, covariances, sd, offsets = [], [], [], []
    n_full = sum(x.n_theta for x in layouts)
    covariance, first = np.zeros((n_full, n_full)), 0
    for o, (layout, fit) in enumerate(zip(layouts, fits, strict=True)):
        worth = unit(layout, scaled, o)
        thetas.append(fit.theta * worth)
        variance = fit.cost / max(fit.n_rows - fit.nuisance.size - layout.free.size, 1)
        inverse = np.linalg.pinv(fit.triangle)
        block = variance * (inverse @ inverse.T) * np.outer(worth[layout.free], worth[layout.free])
        places = first + layout.free
        covariance[np.ix_(places, places)] = block
        covariances.append(block)
        sd.append(np.sqrt(variance) * scaled.y_scale[o])
        offsets.append(
            scaled.y_mean[o] + scaled.y_scale[o] * fit.nuisance[-1] / np.sum(fit.theta[layout.places["A", None]])
        )
        first += layout.n_theta
    model = PolynomialModel(outputs=tuple(x.polynomials(t) for x, t in zip(layouts, thetas, strict=True)), dt=data.dt)
    return made(
        name,
        data,
        orders=shown_orders(name, layouts[0]),
        model=model,
        covariance=covariance,
        n_estimated=sum(x.free.size for x in layouts),
        offsets=Offsets(u=scaled.u_mean, y=np.array(offsets)),
        noise_covariance=np.diag(np.square(sd)),
        status="converged" if all(f.converged for f in fits) else "stalled",
        details={"iterations": [f.iterations for f in fits]},
    )
