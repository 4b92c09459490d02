"""Physical parameters straight from the equations of motion in weak form (theory.md sec. 1 and 2.7).

V = R i + L i' + k_i x' and m x'' + c x' + k_x x = k_i i are linear in the parameters; both are solved at once, with the
noise of position and current in every place where they stand. Quick, without start values, initial state or simulation;
the grey-box estimator stays the sharper one wherever disturbances act that are not named here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.weakform.bumps import degree_for
from ambid.blackbox.weakform.equations import best_support
from ambid.blackbox.weakform.ode import contradictions, kink, supports
from ambid.blackbox.weakform.system import Kink, Signal, System, Term
from ambid.errors import EstimationError
from ambid.estimation.scaling import noise_floor
from ambid.estimation.threads import one_thread
from ambid.physics.linear_model import LinearModel
from ambid.physics.parameters import Parameter

_DEGREE = degree_for(2)
_COIL = (("voltage", 0, None, -1.0), ("current", 0, "R", 1.0), ("current", 1, "L", 1.0))
_MOTION = (
    ("position", 2, "m", 1.0),
    ("position", 1, "c", 1.0),
    ("position", 0, "k_x", 1.0),
    ("current", 0, "k_i", -1.0),
)
_EQUATIONS: Mapping[str, tuple[tuple[tuple[str, int, str | None, float], ...], ...]] = {
    "coil": (_COIL,),
    "rotor": (_MOTION,),
    "one-axis": ((*_COIL, ("position", 1, "k_i", 1.0)), _MOTION),
}
_DISTURBED = {"coil": ("voltage",), "rotor": ("force",), "one-axis": ("voltage", "force")}  # by equation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeakFit:
    """Physical parameters from the weak form."""

    values: Mapping[str, float]  # all parameters, SI
    names: tuple[str, ...]  # estimated ones
    covariance: Array  # (n, n), SI, of `names`
    noise_sd: Mapping[str, float]  # white noise of the outputs as the fit finds it, SI
    half_width_s: float  # half the support of the test functions
    converged: bool
    warnings: tuple[str, ...] = ()

    @property
    def sd(self) -> Mapping[str, float]:
        """Standard deviation of every estimated parameter, SI."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


def weak_parameters(
    model: LinearModel,
    u: Array,
    y: Array,
    rate_hz: float,
    parameters: Sequence[Parameter],
    *,
    delay: float = 0.0,
    noise: Mapping[str, float] | None = None,
    half_width_s: float | None = None,
) -> WeakFit:
    """Estimate physical parameters in weak form.

    Parameters
    ----------
    model : LinearModel
    u : ndarray, shape (n_samples, n_inputs), SI
        Held over a sample, in the model's order.
    y : ndarray, shape (n_samples, n_outputs), SI
    rate_hz : float
    parameters : sequence of Parameter
        One for each of the model's: free, fixed, or with a prior.
    delay : float
        Of the input, samples.
    noise : Mapping[str, float], optional
        White noise of outputs and, where they act, of ``force`` (N) and ``voltage`` (V) held over a sample; only ratios
        matter. By default the outputs' high-frequency floor and no disturbances.
    half_width_s : float, optional
        Half the support of the test functions; by default the one that predicts the least variance.

    Returns
    -------
    WeakFit

    Raises
    ------
    EstimationError
        If the equations leave a scale open, or the record is too short.
    """
    free = [p for p in parameters if p.role != "fixed"]
    fixed = {p.name: float(p.value) for p in parameters if p.role == "fixed" and p.value is not None}
    if not free:
        raise EstimationError("every parameter is fixed; nothing is left to find. Free at least one")
    if model.name == "rotor" and not any(p.role != "free" for p in parameters if p.name != "c"):
        raise EstimationError("position and current show ratios to m only; all free leaves a scale open. Fix m")
    level = dict(zip(model.outputs, noise_floor(y).tolist(), strict=True)) | dict(noise or {})
    dt = 1.0 / rate_hz
    signals = {
        role: Signal(values=u[:, j] - u[:, j].mean(), held=True, delay=delay) for j, role in enumerate(model.inputs)
    }
    for j, role in enumerate(model.outputs):
        signals[role] = Signal(values=y[:, j] - y[:, j].mean(), sd=level[role])
    signals["one"] = Signal(values=np.ones(y.shape[0]))
    names = tuple(p.name for p in free)
    terms, constants = _terms(model.name, fixed, level, signals)
    all_names = (*names, *constants)
    prior = np.array([p.sd if p.sd is not None else np.inf for p in free] + [np.inf] * len(constants))
    mean = [p.value if p.role == "prior" and p.value is not None else 0.0 for p in free]
    kinks = []
    if "voltage" in signals:  # the current's slope jumps by the step of the voltage over L
        pattern = kink(signals["voltage"].values, delay, dt)
        if "L" in fixed:
            kinks.append(Kink(signal="current", pattern=pattern / fixed["L"], parameter=None))
        else:
            kinks.append(Kink(signal="current", pattern=pattern, parameter="L", power=-1))
    system = System(
        terms=tuple(terms),
        signals=signals,
        names=all_names,
        dt=dt,
        prior_mean=np.array(mean + [0.0] * len(constants)),
        prior_sd=prior,
        kinks=tuple(kinks),
    )
    with one_thread():
        halves = supports(y.shape[0] - int(delay), half_width_s, dt)
        best, _ = best_support(system, halves, _DEGREE, min([10, *halves]))
    return WeakFit(
        values={p.name: fixed[p.name] if p.name in fixed else best.theta[p.name] for p in model.parameters},
        names=names,
        covariance=best.covariance[: len(names), : len(names)],
        noise_sd={role: best.scale * level[role] for role in model.outputs},
        half_width_s=best.half * dt,
        converged=best.converged,
        warnings=tuple(contradictions([best.contradiction])),
    )


def _terms(
    name: str, fixed: Mapping[str, float], level: Mapping[str, float], signals: dict[str, Signal]
) -> tuple[list[Term], list[str]]:
    """Terms of the model's equations with a constant each, fixed parameters put in; adds disturbances to `signals`."""
    terms, constants = [], []
    n = next(iter(signals.values())).values.size
    for e, equation in enumerate(_EQUATIONS[name]):
        for signal, order, parameter, factor in equation:
            if parameter is not None and parameter in fixed:
                terms.append(Term(equation=e, signal=signal, order=order, factor=factor * fixed[parameter]))
            else:
                terms.append(Term(equation=e, signal=signal, order=order, parameter=parameter, factor=factor))
        constants.append(f"constant {e}")
        terms.append(Term(equation=e, signal="one", order=0, parameter=constants[-1]))
        disturbance = _DISTURBED[name][e]
        if level.get(disturbance, 0.0) > 0:
            signals[f"disturbing {disturbance}"] = Signal(values=np.zeros(n), sd=level[disturbance])
            terms.append(Term(equation=e, signal=f"disturbing {disturbance}", order=0))
    return terms, constants
