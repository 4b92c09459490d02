"""``ambid fit``: a black-box model from one record, or a nonlinear one from several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Annotated, Any

import typer

from ambid.cli import options as opt
from ambid.cli.interrupts import Stop, interruptible, signals
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs, end
from ambid.cli.terminal import progress
from ambid.errors import EstimationError
from ambid.job.files import FIGURE_ENDINGS
from ambid.settings.caller import refuse_given

Part = tuple[float | None, float | None]


def command(
    records: Annotated[
        list[Path],
        opt.argument("RECORD...", f"{opt.RECORD}; nonlinear structures take several of one bench."),
    ],
    structure: Annotated[str, option("--structure NAME", "Structure; 'ambid models' lists them.")],
    inputs: opt.Inputs = None,
    output: opt.OutputColumns = None,
    orders: Annotated[
        str,
        option(
            "--orders na=2,nb=2,nk=1",
            "Orders; nb=2/3 for two inputs with different orders, nk=auto to find the delay, auto to choose all. Of a "
            "nonlinear structure its settings, such as ny=2,degree=3; 'ambid models' lists them.",
            True,
        ),
    ] = "auto",
    settings: Annotated[str | None, option("--settings", "Former name of --orders.", hidden=True)] = None,
    seed: Annotated[int | None, option("--seed N", "Seed of all randomness in a nonlinear structure.", "0")] = None,
    criterion: Annotated[
        str, switch("--criterion", "Criterion that chooses orders: bic, aic, aicc, mdl, fpe, holdout or kfold.")
    ] = "bic",
    fix: Annotated[list[str] | None, option("--fix NAME=NUMBER", "Fix a coefficient; repeatable.")] = None,
    rig: opt.RigFile = None,
    reference: opt.References = None,
    open_loop: opt.OpenLoop = False,
    at_rest: Annotated[
        bool,
        switch(
            "--at-rest",
            "All signals are zero before the first sample: estimate no offsets and initial states (polynomial "
            "structures).",
        ),
    ] = False,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    second: opt.SecondRecord = None,
    validate_from: Annotated[
        float | None, option("--validate-from S", "Use the second record from here on, in s.")
    ] = None,
    validate_to: Annotated[float | None, option("--validate-to S", "Use the second record up to here, in s.")] = None,
    json: opt.JsonFile = None,
    plot: Annotated[
        Path | None,
        option(
            "--plot FILE.png",
            "Draw signals, residuals, Bode and poles; for a nonlinear structure signals, errors, coefficients and "
            "learning curves.",
        ),
    ] = None,
    report: opt.Report = None,
    stabilisation: Annotated[
        Path | None,
        option(
            "--stabilisation FILE.png",
            "Draw the poles of models of order 1 to 20 (by n4sid, moesp or cva if --structure names it, else pbsid).",
        ),
    ] = None,
    sensitivity: Annotated[
        bool, switch("--sensitivity", "Show how much each coefficient matters, and which are correlated.")
    ] = False,
    strict: opt.Strict = False,
) -> None:
    """Fit a black-box model to a record: polynomial, subspace, continuous-time or nonlinear structures.

    The plant is taken to be under feedback unless --open-loop says otherwise: structures that feedback disturbs warn.
    With --rig, inputs and outputs are the rig's, and a linear fit is carried on to its physical parameters.
    Ctrl-C during a nonlinear fit keeps the best model so far (exit code 130).
    """
    from ambid.job import fit, physics
    from ambid.nonlinear.fit import NONLINEAR_STRUCTURES
    from ambid.rig import load_rig

    nonlinear, part, second_part = structure in NONLINEAR_STRUCTURES, (from_s, to_s), (validate_from, validate_to)
    if nonlinear:
        refuse_given(
            {"stabilisation": stabilisation, "sensitivity": sensitivity},
            f"{{}} is for linear structures; {structure} does not use it. Omit it",
        )
    stop = Stop()
    with Outputs(*records, second, rig, json=json, plot=plot, report=report) as outputs:
        outputs.claim(stabilisation, "stabilisation", FIGURE_ENDINGS)
        opt.refuse_twice(records)
        if nonlinear:
            _check_second(records, part, second, second_part)
        bench = None if rig is None else load_rig(rig)
        columns: dict[str, Any] = {"input": inputs, "output": output, "rig": bench}
        columns |= {"rate_hz": rate, "gaps": gaps, "layout": opt.layout_of(layout)}
        with signals(stop.take) if nonlinear else nullcontext(), progress("fit") as show:
            found: Any = fit(
                records, structure=structure, orders=orders, settings=settings, criterion=criterion, fix=fix,
                at_rest=at_rest, seed=seed, open_loop=open_loop, reference=reference, from_s=from_s, to_s=to_s,
                validate=second, validate_from_s=validate_from, validate_to_s=validate_to,
                tick=interruptible(show, stop) if nonlinear else show, **columns,
            )  # fmt: skip
            stop.torn()
            if bench is not None and not nonlinear:
                found = replace(found, derived={"physical": physics(found, bench)})
            data = found.used[0]
            if sensitivity:
                from ambid.validation.sensitivity import sensitivity_analysis

                found = replace(found, derived={**found.derived, "sensitivity": sensitivity_analysis(found, data[0])})
            outputs.draw(stabilisation, lambda: _poles_by_order(found, data[0], show), show)
            outputs.give(found, show)
    outputs.show(found)
    if stop.wished():
        raise typer.Exit(stop.code)
    end(failed=found.status == "failed" or (strict and not found.passed))


def _check_second(records: Sequence[Path], part: Part, second: Path | None, second_part: Part) -> None:
    """Refuse to judge on samples that are fitted to; another part of a record is another record."""
    if second is None or second.resolve() not in {x.resolve() for x in records}:
        return
    (a, b), (c, d) = part, second_part
    begin, last = max(a or -inf, c or -inf), min(inf if b is None else b, inf if d is None else d)
    if not begin >= last:
        raise EstimationError(
            f"--validate {second} is used for fitting too, so it cannot validate. Give another record, or parts "
            "that do not overlap (--from, --to, --validate-from, --validate-to)"
        )


def _poles_by_order(found: Any, data: Any, tick: Callable[[str], None]) -> Any:
    from ambid.report.response import stabilisation_figure
    from ambid.validation.orders import stabilisation

    method = found.structure if found.structure in ("n4sid", "moesp", "cva") else "pbsid"
    return stabilisation_figure(stabilisation(data, method, tick=lambda: tick("stabilisation")))
