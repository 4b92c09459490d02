"""The main job: one record and one rig in, one checked estimate out.

Read -> cut -> identify -> validate -> Estimate. Each arrow is one call below; what a step does stands in its own room.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ambid.errors import EstimationError
from ambid.estimation.estimate import Check, Estimate
from ambid.job._progress import Tick, silent
from ambid.physics.linear_model import LinearModel
from ambid.physics.models import model
from ambid.record import Record
from ambid.rig import Rig, default_rig, load_rig, read_bench, rig_text
from ambid.signals.conditioning import cut

if TYPE_CHECKING:
    from ambid.bearing.uncertainty import Uncertainty
    from ambid.estimation.likelihood import Fit


def identify(
    record: Record | str | Path,
    rig: Rig | str | Path | None = None,
    *,
    validate: Record | str | Path | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    tick: Tick | None = None,
) -> Estimate:
    """Identify the physical parameters of a bench from one record, and check the result.

    Parameters
    ----------
    record : Record, str or Path
        A file in the rig's columns, or a record whose channels are named by role.
    rig : Rig, str or Path, optional
        What is known of the bench; default: columns voltage, current and position, everything free.
    validate : Record, str or Path, optional
        A second record of the same bench to judge the estimate on.
    from_s, to_s : float, optional
        Part of the record (and of the second) to use, in s; overrides the rig's.
    rate_hz : float, optional
        Sampling rate for a file without a time column.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps in a file.
    tick : callable, optional
        Called with the name of the present stage now and then (progress); may raise to interrupt.

    Returns
    -------
    Estimate
        With `checks` made and `warnings` set; see ``passed``.

    Raises
    ------
    AmbidError
        If record or rig break a rule.
    EstimationError
        If nothing can be identified from the record.
    """
    from ambid.bearing.greybox import greybox
    from ambid.bearing.uncertainty import uncertainty
    from ambid.estimation.threads import one_thread

    say = tick or silent
    clock = _Clock()
    rig = default_rig() if rig is None else rig if isinstance(rig, Rig) else load_rig(rig)
    bench = load(record, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    plant = model(rig.model)
    clock.lap("read")
    say("identify")
    signals = signals_of(bench, plant)
    wanted = {role: rig.channel(role).delay for role in plant.inputs}
    delay = wanted[plant.inputs[0]]
    fit = greybox(plant, signals, rig.parameters, delay=delay, tick=lambda: say("identify"))
    if fit.status == "failed":
        raise EstimationError("the search found no predictor for this record. Check columns, signs and fixed values")
    clock.lap("fit")
    clock.split("fit", "initial", fit.start_s)
    if fit.global_search is not None:
        clock.split("fit", "global_search", float(str(fit.global_search["seconds"])))
    say("check")
    with one_thread():
        estimate = judged(fit, uncertainty(fit), rig, bench, delay_how="estimated" if delay == "auto" else "given")
    clock.lap("checks")
    if validate is not None:
        from ambid.validate.second_record import validation

        say("validate")
        other = load(validate, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
        estimate = replace(estimate, validation=validation(estimate, signals_of(other, plant)))
        clock.lap("validate")
    return replace(estimate, timing_s=clock.laps)


def judged(
    fit: Fit, known: Uncertainty, rig: Rig, bench: Record, *, delay_how: Literal["estimated", "given"]
) -> Estimate:
    """Check a fit on its own record and put the estimate together.

    Parameters
    ----------
    fit : Fit
        Not failed.
    known : Uncertainty
        Of that fit.
    rig : Rig
    bench : Record
        The record it came from, channels named by role.
    delay_how : {"estimated", "given"}

    Returns
    -------
    Estimate
        Without timings.

    Raises
    ------
    EstimationError
        If the fit has no predictor.
    """
    import numpy as np

    from ambid.bearing.result import estimate_of
    from ambid.estimation.sensitivity import innovations
    from ambid.validate.physical import (
        agreement,
        assumption_checks,
        innovation_checks,
        physical_checks,
        simulation_error,
    )
    from ambid.validate.residuals import fit_of

    problem = fit.problem
    e = innovations(problem, fit.vector)
    if e is None:
        raise EstimationError("the search found no predictor for this record. Check columns, signs and fixed values")
    moved = agreement(fit)
    checks = innovation_checks(fit, e, known, moved)
    robust = fit.status != "converged" or not all(c.passed for c in checks.values())
    known = replace(known, disagreement=moved.disagreement() if robust else np.zeros(len(known.names)))
    checks |= assumption_checks(fit, known, delay_how)
    checks |= physical_checks(fit, known, bench, robust=robust)
    y, error = problem.y[problem.skip :], simulation_error(fit)
    estimate = estimate_of(
        fit,
        known,
        rig.parameters,
        robust=robust,
        delay_how=delay_how,
        means={role: float(bench[role].mean()) for role in (*problem.model.inputs, *problem.model.outputs)},
        one_step=fit_of(e * problem.scales.output, y),
        simulation=None if error is None else fit_of(error, y),
        checks=checks,
        warnings=_warnings(fit, checks, robust=robust),
        record={
            "samples": bench.n_samples,
            "rate_hz": bench.rate_hz,
            "sha256": bench.provenance.get("sha256"),
            "file": bench.provenance.get("file"),
            "history": [str(step) for step in bench.history],
        },
        rig=_remembered(rig),
    )
    return replace(estimate, global_search=fit.global_search)


def _remembered(rig: Rig) -> dict[str, object]:
    """What an estimate keeps of its rig, so that other records can be judged alike."""
    folder = Path.cwd() if rig.source is None else rig.source.resolve().parent
    return {"name": rig.name, "text": rig_text(rig, folder), "folder": str(folder)}


def _warnings(fit: Fit, checks: Mapping[str, Check], *, robust: bool) -> tuple[str, ...]:
    """What a reader has to know before using the numbers, most important first."""
    from ambid.bearing.rescue import told

    found = [] if fit.status == "converged" else ["the search did not converge: treat the numbers as a first guess"]
    if fit.global_search is not None:
        found.append(told(fit.global_search))
    found += [c.detail for c in checks.values() if not c.passed]
    if robust:
        found.append(
            "the model explains the record only in part: standard deviations are robust ones (scatter over the record "
            "and disagreement of refits included), and still cannot cover a bias that is the same everywhere"
        )
    return tuple(found)


class _Clock:
    """Laps in seconds of wall time."""

    def __init__(self) -> None:
        self._last, self.laps = time.perf_counter(), dict[str, float]()

    def split(self, lap: str, part: str, seconds: float) -> None:
        self.laps[part] = seconds
        self.laps[lap] -= seconds

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name], self._last = now - self._last, now


def load(
    record: Record | str | Path,
    rig: Rig,
    *,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
) -> Record:
    """Read a record through a rig and cut it to the part that is to be used.

    Parameters
    ----------
    record : Record, str or Path
        A file, or a record whose channels are named by role.
    rig : Rig
    from_s, to_s : float, optional
        Override the rig's ``record.from`` and ``record.to``; s.
    rate_hz : float, optional
    gaps : {"error", "interpolate", "cut"}, optional

    Returns
    -------
    Record
        Channels named by role, SI units.

    Raises
    ------
    AmbidError
        If the file, its columns or the cut break a rule.
    """
    bench = record if isinstance(record, Record) else read_bench(record, rig, rate_hz=rate_hz, gaps=gaps)  # type: ignore[arg-type]
    first = from_s if from_s is not None else rig.record.from_s
    last = to_s if to_s is not None else rig.record.to_s
    return bench if first is None and last is None else cut(bench, first, last)


def signals_of(record: Record, plant: LinearModel) -> Any:
    """Take a model's inputs and outputs out of a record.

    Parameters
    ----------
    record : Record
        Channels named by role.
    plant : LinearModel

    Returns
    -------
    ambid.bearing.greybox.Signals
        u (n_samples, n_inputs), y (n_samples, n_outputs), SI.
    """
    import numpy as np

    from ambid.bearing.multistart import Signals

    return Signals(
        u=np.stack([record[r] for r in plant.inputs], axis=1),
        y=np.stack([record[r] for r in plant.outputs], axis=1),
        rate_hz=record.rate_hz,
    )
