"""The fit that comes out of the training of a state-space network: model in SI, covariance, noise, warnings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.blackbox.data import IOData
from ambid.estimation.progress import Tick
from ambid.nonlinear.cloud import cloud_of
from ambid.nonlinear.failed import failed_fit, provenance
from ambid.nonlinear.fit import NonlinearFit
from ambid.nonlinear.networks.nn_spread import spread_of
from ambid.nonlinear.networks.nn_train import State
from ambid.nonlinear.networks.start import carried_to_continuous
from ambid.nonlinear.networks.state_model import StateNetwork
from ambid.nonlinear.records import Scaled

if TYPE_CHECKING:
    from ambid.nonlinear.networks.nn_stages import Work


def finished(
    records: Sequence[IOData],
    used: Mapping[str, Any],
    data: Scaled,
    work: Work,
    *,
    seed: int,
    tick: Tick | None = None,
) -> NonlinearFit:
    """Return the fit of a trained network.

    `used`: settings; `work`: with a network; `tick`: of the bootstrap. Returns failed where the network does not run on
    its own records.
    """
    assert work.state is not None
    problem = work.state.problem(data)
    state = work.state.moved(problem, work.state.vector)
    model = None if state is None else _model(records, data, state, int(used["delay"]))
    if state is None or model is None:
        reason = "the network does not stay finite on the records that it was trained on: check the columns"
        return failed_fit("nn", records, used, seed, reason, work.timing_s)
    began = perf_counter()
    spread = spread_of(state, data, str(used["uncertainty"]), seed, tick, work.rivals)
    covariance, condition = spread.covariance, spread.condition
    work.timing_s["standard deviations"] = perf_counter() - began
    warnings = [*work.warnings, *_cautions(records, state), *spread.warnings]
    work.timing_s["all"] = sum(work.timing_s.values())
    freedom = max(state.n_rows - state.layout.n_theta / state.layout.p, 1.0)
    noise = state.noise * state.n_rows / freedom
    return NonlinearFit(
        structure="nn",
        settings=dict(used),
        model=model,
        covariance=covariance,
        covariance_from=spread.origin,
        n_estimated=int(state.theta.size),
        noise_covariance=noise * data.y_scale[:, None] * data.y_scale,
        seed=seed,
        status=work.status,
        curves=tuple(work.curves),
        warnings=tuple(warnings),
        timing_s=dict(work.timing_s),
        details={**work.details, **_details(state, model, condition)},
        **provenance(records),
    )


def _model(records: Sequence[IOData], data: Scaled, state: State, delay: int) -> StateNetwork | None:
    """The model with the cloud of its own states in training; None where it leaves the finite numbers there."""
    nowhere = cloud_of(np.zeros((1, state.layout.n + state.layout.n_inputs)))
    model = StateNetwork(
        layout=state.layout,
        theta=state.theta * state.layout.unit,
        u_level=data.u_level,
        u_scale=data.u_scale,
        y_level=data.y_level,
        y_scale=data.y_scale,
        cloud=nowhere,
        delay=delay,
    )
    with np.errstate(over="ignore", invalid="ignore"):
        z = np.concatenate([model.regressors(x.u, x.y) for x in records])
    if not np.all(np.isfinite(z)) or not np.all(np.isfinite(model.theta)):
        return None
    return StateNetwork(
        **{k: getattr(model, k) for k in ("layout", "theta", "u_level", "u_scale", "y_level", "y_scale")},
        cloud=cloud_of(z),
        delay=delay,
    )


def _cautions(records: Sequence[IOData], state: State) -> list[str]:
    found = []
    told_open = not records[0].n_inputs or all(x.open_loop for x in records)
    if not told_open and not state.layout.gain:
        found.append(
            "trained on simulation errors, nn is biased where a controller was at work, and nothing says that these "
            "records are open loop: say noise = innovations, or --open-loop if there was no feedback"
        )
    return found


def _details(state: State, model: StateNetwork, condition: float) -> dict[str, object]:
    found: dict[str, object] = {
        "form": state.layout.form,
        "gain": state.layout.gain,
        "A": model.A.tolist(),
        "B": model.B.tolist(),
        "K": state.K.tolist(),
        "condition": condition,
    }
    if state.layout.form == "one-axis":
        return found
    m = state.layout.matrices(state.theta)
    both = carried_to_continuous(state.layout, m.A, m.B[:, :-1])
    found["continuous"] = None if both is None else {"A": both[0].tolist(), "B": both[1].tolist()}
    return found
