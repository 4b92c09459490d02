"""What is measured inside this process: residual and Jacobian, whole identifications, simulation steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import cycle

import numpy as np

import scipy_baseline
import scipy_simulation
from ambid.bearing.linear import greybox
from ambid.estimation.likelihood import Workspace, linearise, residual_blocks, search
from ambid.job import identify
from ambid.physics.linear_model import model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.rig import default_rig
from ambid.simulation import simulate_preset
from cases import SEED, Array, Case, bearing_excitation
from timing import Line, Timing, alternate

MODES = "SciPy: modes, lfilter, forward differences"
TRANSFER = "SciPy: ss2tf, third-order lfilter, forward differences"
LEAST_SQUARES = "SciPy: least_squares on the modes' residual, 2-point differences; start, delay, noise weight given"


def residual_lines(case: Case) -> Iterator[Line]:
    """Residual and Jacobian at vectors near the estimate; both implementations must agree there."""
    work, vectors = Workspace(case.problem), cycle(case.nearby(7))
    given = case.scipy_arguments()
    ways: dict[str, Callable[..., Array]] = {
        MODES: scipy_baseline.by_modes,
        TRANSFER: scipy_baseline.by_transfer_functions,
    }

    def exact() -> None:
        for _ in residual_blocks(case.problem, next(vectors), case.weight, work):
            pass

    def compressed() -> None:
        linearise(case.problem, next(vectors), case.weight, work)

    def differences(filtered: Callable[..., Array]) -> Callable[[], None]:
        def job() -> None:
            vector = next(vectors)
            scipy_baseline.jacobian(vector, scipy_baseline.residual(vector, filtered, *given), filtered, *given)

        return job

    ours, reduced, *others = alternate(
        9, (exact, 12), (compressed, 5), *((differences(filtered), 1) for filtered in ways.values())
    )
    for (beside, filtered), theirs in zip(ways.items(), others, strict=True):
        yield Line(
            group="Residual and Jacobian: 2 outputs, 13 estimated numbers",
            job=case.name,
            unit="s",
            ambid=ours,
            beside=beside,
            other=theirs,
            notes=_agreement(case, work, filtered, given),
        )
    yield Line(
        group="Residual and Jacobian: 2 outputs, 13 estimated numbers",
        job=f"{case.name}, compressed by QR to 14 rows for the optimiser",
        unit="s",
        ambid=reduced,
    )


def _agreement(
    case: Case, work: Workspace, filtered: Callable[..., Array], given: tuple[object, ...]
) -> dict[str, object]:
    """Largest difference of the residuals in standard deviations, and error of the differences in each column."""
    names = (*case.problem.estimated, "noise 1", "noise 2", "noise 3", "offset 1", "offset 2", "x0", "v0", "i0")
    parts = [b.copy() for b in residual_blocks(case.problem, case.vector, case.weight, work)]
    rows = np.concatenate(parts).reshape(-1, len(names) + 1)
    theirs = scipy_baseline.residual(case.vector, filtered, *given)
    apart = scipy_baseline.jacobian(case.vector, theirs, filtered, *given) - rows[:, :-1]
    error = np.linalg.norm(apart, axis=0) / np.linalg.norm(rows[:, :-1], axis=0)
    return {
        "samples": case.problem.n_used,
        "largest_difference_of_residuals_sd": float(np.max(np.abs(theirs - rows[:, -1]))),
        "relative_error_of_differences": dict(zip(names, error.tolist(), strict=True)),
        "worst_column": names[int(np.argmax(error))],
        "worst_physical_column": names[int(np.argmax(error[: case.problem.n_physical]))],
    }


def identification_lines(case: Case) -> Iterator[Line]:
    """Whole identifications from the record in memory."""
    record, plant, parameters = case.simulation.record, model("one-axis"), default_rig().parameters
    given = (scipy_baseline.by_modes, *case.scipy_arguments())
    whole, alone, last, theirs = alternate(
        5,
        (lambda: identify(record), 1),
        (lambda: greybox(plant, case.signals, parameters), 1),
        (lambda: search(case.problem, case.start), 1),
        (lambda: scipy_baseline.fit(case.start, *given), 1),
    )
    estimate, found = identify(record), scipy_baseline.fit(case.start, *given)
    truth = case.simulation.truth
    sd = np.linalg.norm(np.linalg.pinv(found.jac), axis=1)  # a level of noise may have come to nothing
    accuracy: dict[str, dict[str, float]] = {}
    for j, name in enumerate(case.problem.estimated):
        ours, other = estimate.parameter(name), float(found.x[j] * case.problem.magnitude[j])
        accuracy[name] = {
            "truth": truth[name],
            "ambid": ours.value,
            "ambid_sd": ours.sd,
            "scipy": other,
            "scipy_sd": float(sd[j] * abs(case.problem.magnitude[j])),
        }
    notes: dict[str, object] = {
        "status": estimate.status,
        "scipy_evaluations": int(found.nfev),
        "scipy_converged": bool(found.success),
        "accuracy": accuracy,
    }
    group = "Whole identification: 20 000 samples in memory"
    for job, ours in (
        (f"{case.name}: the main job (start values and delay found, uncertainty, checks)", whole),
        (f"{case.name}: the fit (start values and delay found)", alone),
        (f"{case.name}: the search alone, from the same start values", last),
    ):
        yield Line(group=group, job=job, unit="s", ambid=ours, beside=LEAST_SQUARES, other=theirs, notes=notes)


def simulation_lines() -> Iterator[Line]:
    """Nonlinear differential bearing under its controller: time of one sample, which is one Runge-Kutta step."""
    n, n_loop, n_adaptive = 1_000_000, 20_000, 1000
    bench, excitation = preset("unstable-bearing"), bearing_excitation(n)
    scale = np.concatenate([[bench.noise.position, bench.noise.current], bench.noise.held_rms(bench.rate_hz)])

    def plain(step: Callable[..., list[float]], count: int) -> Callable[[], Array]:
        def job() -> Array:
            noise = np.random.default_rng(SEED).standard_normal((count, 4)) * scale
            return scipy_simulation.simulate(bench, excitation[:count], step, noise)

        return job

    ours, loop, adaptive = alternate(
        3,
        (lambda: simulate_preset(bench, excitation, seed=SEED, nonlinear=True), 1),
        (plain(scipy_simulation.runge_kutta, n_loop), 1),
        (plain(scipy_simulation.adaptive, n_adaptive), 1),
    )
    quiet = simulate_preset(bench, excitation[:2000], seed=SEED, nonlinear=True, noise=Noise())
    still = np.zeros((2000, 4))
    for beside, step, theirs, count in (
        ("plain Python, the same Runge-Kutta step", scipy_simulation.runge_kutta, loop, n_loop),
        ("SciPy: solve_ivp over each sample", scipy_simulation.adaptive, adaptive, n_adaptive),
    ):
        log = scipy_simulation.simulate(bench, excitation[:500], step, still)
        apart = np.abs(log - quiet.states[:500, [0, 2]]).max(axis=0)
        yield Line(
            group="Simulation: nonlinear unstable bearing under its controller, with noise, 20 kHz",
            job="one step, in a run of 1 000 000 steps",
            unit="s",
            ambid=_per(ours, n),
            beside=beside,
            other=_per(theirs, count),
            notes={
                "steps_per_second": 1.0 / _per(ours, n).median,
                "other_steps_per_second": 1.0 / _per(theirs, count).median,
                "whole_run_s": ours.median,
                "other_steps_run": count,
                "largest_difference": {"position_m": float(apart[0]), "current_A": float(apart[1])},
            },
        )


def _per(timing: Timing, n: int) -> Timing:
    return Timing(median=timing.median / n, minimum=timing.minimum / n, repeats=timing.repeats)
