"""``ambid frf``: a frequency response from one record, and models fitted to it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from ambid.cli import options as opt
from ambid.cli.options import option, switch
from ambid.cli.output import Outputs
from ambid.cli.terminal import progress
from ambid.errors import AmbidError


def command(
    record: opt.RecordFile,
    inputs: opt.Inputs = None,
    output: opt.OutputColumns = None,
    reference: opt.References = None,
    open_loop: opt.OpenLoop = False,
    method: Annotated[
        Literal["auto", "periodic", "random", "local"],
        switch(
            "--method", "Method: averages over periods, averaged spectra, local polynomials, or what suits the record."
        ),
    ] = "auto",
    band: Annotated[str | None, option("--band LO:HI", "Frequency band to use, in Hz.", "all")] = None,
    hold: Annotated[
        Literal["zoh", "band-limited"] | None,
        option(
            "--hold",
            "Input between samples: held constant, or band-limited to half the rate.",
            "zoh; band-limited for a file of responses",
        ),
    ] = None,
    orders: Annotated[
        str | None,
        option(
            "--orders nf=2,nb=1",
            "Fit transfer functions by maximum likelihood: degree of the denominator, number of numerator "
            "coefficients.",
        ),
    ] = None,
    state_space: Annotated[
        str | None,
        option("--state-space n=3|auto", "Fit a state space by subspace identification with the Laguerre operator."),
    ] = None,
    feedthrough: Annotated[
        bool, switch("--feedthrough", "With --state-space: include a direct path from input to output (D).")
    ] = False,
    modes: Annotated[
        str | None,
        option(
            "--modes auto|N",
            "Find modes of vibration by maximum likelihood: frequency, damping, shape over the outputs; N: so many. "
            "Without --input: operational modes.",
        ),
    ] = None,
    estimate: Annotated[
        Path | None,
        option("--estimate E.json", "With --modes: compare them with the modes of a physical estimate (MAC)."),
    ] = None,
    domain: Annotated[
        Literal["s", "z"] | None,
        option(
            "--domain", "Domain of the model: continuous or discrete time.", "z for --orders with a held input, else s"
        ),
    ] = None,
    delay: Annotated[
        str | None,
        option("--delay S|auto", "Delay of the inputs in s, for the models.", "0; with --rig as the rig says"),
    ] = None,
    rig: opt.RigFile = None,
    from_s: opt.From = None,
    to_s: opt.To = None,
    rate: opt.Rate = None,
    gaps: opt.Gaps = None,
    layout: opt.Layout = None,
    json: opt.JsonFile = None,
    plot: Annotated[Path | None, option("--plot FILE.png", "Draw response, levels and models.")] = None,
    report: opt.Report = None,
    strict: opt.Strict = False,
) -> None:
    """Measure a frequency response with its noise and distortion, or take one from .uff, .unv or .csv; fit models.

    With --reference (the loop's outer excitation) feedback does not bias it. With --rig, physical parameters come out,
    and inputs and outputs are the rig's.
    """
    from ambid.job import frf

    with Outputs(record, rig, estimate, json=json, plot=plot, report=report) as outputs:
        between, n, late, count = opt.band_of(band), _order(state_space), _delay(delay), _modes(modes)
        with progress("measure") as tick:
            found = frf(
                record, input=inputs, output=output, reference=reference, open_loop=open_loop,
                method=method, hold=hold, band=between, orders=orders, state_space=n, feedthrough=feedthrough,
                modes=count, estimate=estimate, domain=domain, delay=late, rig=rig, from_s=from_s,
                to_s=to_s, rate_hz=rate, gaps=gaps,
                layout=opt.layout_of(layout), tick=tick,
            )  # fmt: skip
            outputs.give(found, tick)
    outputs.show(found, strict=strict)


def _order(text: str | None) -> int | Literal["auto"] | None:
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    number = text.strip().removeprefix("n=")
    if not number.isdecimal() or len(number) > 3:
        raise AmbidError(f"--state-space is {text!r}; it must be an order, or auto. Give n=3, for example")
    return int(number)


def _modes(text: str | None) -> int | Literal["auto"] | None:
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    if not text.strip().isdecimal() or not 1 <= int(text) <= 999:
        raise AmbidError(f"--modes is {text!r}; it must be a number of modes, or auto. Give --modes auto, for example")
    return int(text)


def _delay(text: str | None) -> float | Literal["auto"] | None:
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    try:
        return float(text)
    except ValueError:
        raise AmbidError(
            f"--delay is {text!r}; it must be a time in s, or auto. Give --delay 1e-4, for example"
        ) from None
