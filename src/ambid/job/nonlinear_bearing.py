"""The job of the nonlinear bearing: several records and one rig in, one estimate with curves out."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ambid.errors import EstimationError, nearest
from ambid.job._progress import Tick, silent
from ambid.physics.coenergy_law import MagnetLaw
from ambid.physics.parameters import Parameter
from ambid.record import Record
from ambid.rig import Rig, load_rig

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ambid.identify.estimate import Check, EstimatedParameter, OutputFit
    from ambid.identify.nonlinear_bearing.likelihood import BearingFit
    from ambid.identify.nonlinear_bearing.problem import BearingRecord
    from ambid.identify.nonlinear_bearing.result import NonlinearBearingEstimate
    from ambid.identify.nonlinear_bearing.uncertainty import BearingUncertainty

Magnet = MagnetLaw | Literal["auto", "single", "pair"]

_P_LEAST = 1e-3  # as for the linear model
_OFF_SD = 1.0  # of the voltage of a stage that is off, V: a diode's, or none
_INFLATION = 1.5  # robust over information standard deviation from which the model, not the noise, sets the error


def identify_nonlinear(
    records: Sequence[Record | str | Path],
    rig: Rig | str | Path,
    *,
    magnet: Magnet = "auto",
    held: Sequence[Record | str | Path] = (),
    parameters: Sequence[Parameter] = (),
    eddy: bool = False,
    drift: bool = False,
    off_below: float | None = None,
    from_s: float | None = None,
    to_s: float | None = None,
    rate_hz: float | None = None,
    gaps: str | None = None,
    tick: Tick | None = None,
) -> NonlinearBearingEstimate:
    """Identify one nonlinear bearing from several records at several operating points at once.

    Prediction error with an extended Kalman predictor, consistent under feedback as far as its linearised noise is.

    Parameters
    ----------
    records : sequence of Record, str or Path
        Of a rotor that moves; files in the rig's columns, or records with channels named by role.
    rig : Rig, str or Path
        Model ``one-axis``. Its m, R, c say what is known of them; its k_x, k_i and L are not looked at: they are
        curves here. Calibration tables take duty to voltage; ``loop.limits.voltage`` is what the amplifier gives.
    magnet : MagnetLaw or {"auto", "single", "pair"}
        Co-energy; "auto": a pair where the current changes its sign; one magnet: hyperbolic or exponential gap law,
        rising leakage and saturation, as the likelihood decides. With a `MagnetLaw`, just that.
    held : sequence of Record, str or Path
        Records with the rotor held at rest at different distances: they show the coil.
    parameters : sequence of Parameter
        What is known of further numbers, or otherwise than the rig says: k, s, L_g, zeta, sigma, L_leak, L_rise,
        i_knee, i0, g, a, x_offset, i_offset, v_offset (SI). g is fixed at 9.81 for one magnet and 0 for a pair;
        i_offset, and for one magnet x_offset, at 0.
    eddy : bool
        The force has a pole a/(s + a) (thesis eq. 1.4), found up to about twice the sampling rate in rad/s.
    drift : bool
        A slowly walking force takes up what the law leaves over. One magnet then no longer has to carry the weight
        at rest, which is the surest thing that its records say; so it is off unless asked for.
    off_below : float, optional
        Voltage in V at or below which the stage is off: while the current then dies through a diode, the coil's
        voltage is not known (1 V rms is taken for it).
    from_s, to_s : float, optional
        Part of the moving records to use, in s; overrides the rig's, which does not apply to held ones.
    rate_hz : float, optional
        For files without time.
    gaps : {"error", "interpolate", "cut"}, optional
        What to do about gaps in a file.
    tick : callable, optional
        Called with the name of the stage; KeyboardInterrupt during the search ends in the best so far, stalled.

    Returns
    -------
    NonlinearBearingEstimate

    Raises
    ------
    AmbidError
        If a record or the rig breaks a rule.
    EstimationError
        If the rig is not ``one-axis``, a number is not known, or nothing can be estimated.
    """
    from ambid.identify.nonlinear_bearing.estimate import estimate_bearing
    from ambid.identify.nonlinear_bearing.uncertainty import uncertainty

    say, begun = tick or silent, time.perf_counter()
    rig = rig if isinstance(rig, Rig) else load_rig(rig)
    if rig.model != "one-axis":
        raise EstimationError(f"the rig's model is {rig.model!r}; a nonlinear bearing wants 'one-axis'")
    say("read")
    bare = replace(rig, record=replace(rig.record, from_s=None, to_s=None))
    taken = [_taken(r, rig, from_s, to_s, rate_hz, gaps, off_below, held=False) for r in records]
    taken += [_taken(r, bare, None, None, rate_hz, gaps, off_below, held=True) for r in held]
    clipped = [t[2] for t in taken if t[2]]
    known = _known(rig, parameters)
    laws = _laws(magnet, [t[0] for t in taken if not t[0].held])
    wanted = rig.channel("voltage").delay
    read = time.perf_counter()
    fit = estimate_bearing(
        [t[0] for t in taken], known, laws=laws, delay=None if wanted == "auto" else float(wanted),
        extend=magnet == "auto" or magnet == "single", eddy=eddy, drift=drift, tick=lambda: say("identify"),
    )  # fmt: skip
    fitted = time.perf_counter()
    say("check")
    estimate = _judged(fit, uncertainty(fit), [t[1] for t in taken], tuple(clipped))
    laps = {"read": read - begun, "fit": fitted - read, "checks": time.perf_counter() - fitted}
    return replace(estimate, timing_s=laps)


def _taken(
    record: Record | str | Path, rig: Rig, from_s: float | None, to_s: float | None, rate_hz: float | None,
    gaps: str | None, off_below: float | None, *, held: bool,
) -> tuple[BearingRecord, Mapping[str, object], str]:  # fmt: skip
    """A record as the predictor sees it, what is remembered of it, and a warning where the voltage was limited."""
    import numpy as np

    from ambid.identify.nonlinear_bearing.problem import BearingRecord
    from ambid.job.physical import load

    bench = load(record, rig, from_s=from_s, to_s=to_s, rate_hz=rate_hz, gaps=gaps)
    u, name = np.array(bench["voltage"]), str(bench.provenance.get("file") or "record")
    warning = ""
    if rig.limits is not None:
        low, high = rig.limits.voltage
        beyond = int(np.count_nonzero((u < low) | (u > high)))
        if beyond:
            u = np.clip(u, low, high)
            warning = f"{name}: {beyond} samples of the voltage lie beyond loop.limits.voltage; the limit was taken"
    loose = np.where(u <= off_below, _OFF_SD, 0.0) if off_below is not None else np.zeros(u.size)
    y = np.column_stack([bench["position"], bench["current"]])
    taken = BearingRecord(
        name=name, rate_hz=bench.rate_hz, u=u, loose=loose, y=y, valid=np.ones(y.shape, dtype=np.bool_), held=held
    )  # fmt: skip
    remembered = {"samples": bench.n_samples, "rate_hz": bench.rate_hz, "sha256": bench.provenance.get("sha256"),
                  "file": bench.provenance.get("file"), "held": held}  # fmt: skip
    return taken, remembered, warning


def _known(rig: Rig, parameters: Sequence[Parameter]) -> dict[str, Parameter]:
    from ambid.identify.nonlinear_bearing.problem import UNITS

    for p in parameters:
        if p.name not in UNITS:
            raise EstimationError(
                f"a nonlinear bearing has no number {p.name!r}; it has {', '.join(UNITS)}."
                f"{nearest(p.name, list(UNITS))}"
            )
    return {**{n: rig.parameter(n) for n in ("m", "R", "c")}, **{p.name: p for p in parameters}}


def _laws(magnet: Magnet, records: Sequence[BearingRecord]) -> list[MagnetLaw]:
    if isinstance(magnet, MagnetLaw):
        return [magnet]
    if magnet == "auto":
        low, high = min(r.y[:, 1].min() for r in records), max(r.y[:, 1].max() for r in records)
        magnet = "pair" if low < -0.2 * high else "single"
    if magnet == "pair":
        return [MagnetLaw(pair=True)]
    return [MagnetLaw(gap="hyperbolic"), MagnetLaw(gap="exponential")]


def _judged(
    fit: BearingFit, known: BearingUncertainty, remembered: Sequence[Mapping[str, object]], clipped: tuple[str, ...],
) -> NonlinearBearingEstimate:  # fmt: skip
    """Check a fit on its own records and put the estimate together."""
    import numpy as np

    from ambid.identify.estimate import Check, Delay, OutputFit
    from ambid.identify.nonlinear_bearing.problem import LEVELS
    from ambid.identify.nonlinear_bearing.residual_test import whiteness
    from ambid.identify.nonlinear_bearing.result import NonlinearBearingEstimate

    problem, names = fit.problem, _names(fit)
    tests = [whiteness(fit, r) for r in range(len(problem.records))]
    worst = int(np.argmin([t.p for t in tests]))
    white = Check(
        passed=tests[worst].p >= _P_LEAST, p=tests[worst].p,
        detail=f"one-step errors against their past: p = {tests[worst].p:.2g} on {names[worst]}, largest correlation "
        f"{max(t.largest for t in tests):.3f}",
        values={n: t.p for n, t in zip(names, tests, strict=True)},
    )  # fmt: skip
    robust = not white.passed or known.inflation > _INFLATION or fit.status != "converged"
    parameters = _parameters(fit, known, robust=robust)
    checks = {"residuals_white": white, "identifiable": _shown(parameters)} | _gravity(fit)
    outputs: dict[str, dict[str, OutputFit]] = {}
    for name, record, test in zip(names, problem.records, tests, strict=True):
        spread = record.y.std(axis=0)
        outputs[name] = {
            role: OutputFit(one_step=float(1.0 - sd / spread[c]), simulation=None, innovation_sd=sd)
            for c, (role, sd) in enumerate(zip(("position", "current"), test.innovation_sd, strict=True))
            if np.isfinite(sd)
        }
    delay = {}
    for rate in problem.delays:
        total, free = problem.delay_at(fit.vector, rate), rate in problem.free_delay
        whole = int(np.floor(total))
        delay[f"{rate:g} Hz"] = Delay(
            samples=whole, fraction=total - whole, sd=known.delay_sd.get(rate), how="estimated" if free else "given"
        )
    noise = {
        n: dict(zip((LEVELS[j] for j in problem.levels(r)), np.exp(fit.vector[place]).tolist(), strict=True))
        for r, (n, place) in enumerate(zip(names, problem.noise_slices, strict=True))
    }
    points = np.concatenate([r.y for r in problem.records])
    return NonlinearBearingEstimate(
        status="converged" if fit.status == "converged" else "stalled",
        law=problem.law,
        records=tuple(remembered),
        parameters=parameters,
        covariance_names=known.names,
        covariance=known.covariance(robust=robust),
        covariance_method="robust" if robust else "information",
        delay=delay,
        noise=noise,
        fit=outputs,
        range={role: (low, high) for role, low, high in zip(
            ("position", "current"), points.min(axis=0).tolist(), points.max(axis=0).tolist(), strict=True)},
        hull=_hull(points),
        criterion=fit.criterion,
        bic=fit.criterion + problem.size * float(np.log(problem.n_used)),
        checks=checks,
        warnings=_warnings(fit, checks, robust=robust) + clipped,
    )  # fmt: skip


def _names(fit: BearingFit) -> list[str]:
    """Names of the records, each its own."""
    found: list[str] = []
    for r in fit.problem.records:
        found.append(r.name if r.name not in found else f"{r.name} ({len(found) + 1})")
    return found


def _parameters(fit: BearingFit, known: BearingUncertainty, *, robust: bool) -> tuple[EstimatedParameter, ...]:
    """Every number that acts, as it came out."""
    import numpy as np

    from ambid.identify.estimate import EstimatedParameter
    from ambid.identify.nonlinear_bearing.problem import UNITS
    from ambid.identify.uncertainty import WEAK

    law, values, found = fit.problem.law, fit.problem.values(fit.vector), []
    sds = np.sqrt(np.diag(known.covariance(robust=robust)))
    absent = {"sigma": law.saturation, "L_rise": law.rise, "i_knee": law.rise, "i0": law.pair, "a": fit.problem.eddy}
    for n in fit.problem.numbers:
        if not absent.get(n.name, True):
            continue
        j = known.names.index(n.name) if n.estimated else -1
        sd, value = float(sds[j]) if n.estimated else 0.0, values[n.name]
        prior = np.isfinite(n.prior_sd)
        size = max(n.magnitude, abs(value)) if n.signed else value
        share = None
        if prior and n.estimated:
            share = float(np.clip(1.0 - known.information[j, j] / n.prior_sd**2, 0.0, 1.0))
        role: Literal["free", "fixed", "prior"] = "fixed" if not n.estimated else "prior" if prior else "free"
        found.append(
            EstimatedParameter(
                name=n.name,
                unit=UNITS[n.name],
                value=value,
                sd=sd,
                ci95=(value - 1.96 * sd, value + 1.96 * sd),
                role=role,
                identifiable=not n.estimated or sd < WEAK * abs(size),
                data_share=share,
            )
        )
    return tuple(found)


def _shown(parameters: Sequence[EstimatedParameter]) -> Check:
    from ambid.identify.estimate import Check

    hidden = [p.name for p in parameters if not p.identifiable]
    detail = "the records show every number" if not hidden else (
        f"the records do not show {', '.join(hidden)} (relative standard deviation above 25 %): fix them, "
        "give a prior, or record with more motion"
    )  # fmt: skip
    return Check(passed=not hidden, detail=detail)


def _gravity(fit: BearingFit) -> dict[str, Check]:
    """For one magnet: does the law carry the weight where the rotor stood, whatever the dynamics say?"""
    import numpy as np

    from ambid.identify.estimate import Check

    law, values = fit.problem.law, fit.problem.values(fit.vector)
    weight = values["m"] * values["g"]
    if law.pair or weight == 0.0:
        return {}
    means = np.array([r.y.mean(axis=0) for r in fit.problem.records if not r.held])
    force = law.table(means[:, 0] - values["x_offset"], means[:, 1] - values["i_offset"], values)[0][:, 0]
    off = float(np.max(np.abs(force / weight + 1.0)))
    detail = f"the magnet's mean force differs from the weight by at most {off:.1%} on any record"
    return {"carries_its_weight": Check(passed=off < 0.1, detail=detail, values={"largest": off})}


def _hull(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners of the convex hull, counter-clockwise."""
    from scipy.spatial import ConvexHull

    found: NDArray[np.float64] = points[ConvexHull(points / points.std(axis=0)).vertices]
    return found


def _warnings(fit: BearingFit, checks: Mapping[str, Check], *, robust: bool) -> tuple[str, ...]:
    """What a reader has to know before using the numbers, most important first."""
    found = [] if fit.status == "converged" else ["the search did not converge: treat the numbers as a first guess"]
    found += [c.detail for c in checks.values() if not c.passed]
    if robust:
        found.append(
            "the model explains the records only in part: standard deviations are robust ones (scatter over the "
            "records), and cannot cover a bias that is the same everywhere"
        )
    if fit.problem.drift:
        found.append("a slowly walking force takes up what the law leaves over; forces at rest count for less then")
    return tuple(found)
