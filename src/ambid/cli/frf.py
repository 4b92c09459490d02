"""``ambid frf``: a frequency response from one record, and models fitted to it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ambid.cli.options import (
    FAILED_CHECK,
    FIGURE_ENDINGS,
    From,
    Gaps,
    Inputs,
    JsonFile,
    OpenLoop,
    OutputColumns,
    Rate,
    RecordFile,
    References,
    RigFile,
    Strict,
    To,
    band_of,
    json_path,
    option,
    orders_of,
    switch,
)
from ambid.cli.output import Outputs
from ambid.cli.terminal import painter, progress
from ambid.errors import AmbidError

if TYPE_CHECKING:
    from ambid.blackbox.data import Orders


def command(
    record: RecordFile,
    inputs: Inputs = None,
    output: OutputColumns = None,
    reference: References = None,
    open_loop: OpenLoop = False,
    method: Annotated[
        Literal["auto", "periodic", "random", "local"],
        switch("--method", "How to measure: averages over periods, averaged spectra, local polynomials, or what fits."),
    ] = "auto",
    band: Annotated[str | None, option("--band", "LO:HI", "Lines that are used, in Hz.", "all")] = None,
    hold: Annotated[
        Literal["zoh", "band-limited"],
        switch("--hold", "What the input does between samples: held, or without power above half the rate."),
    ] = "zoh",
    orders: Annotated[
        str | None,
        option(
            "--orders",
            "nf=2,nb=1",
            "Fit transfer functions by maximum likelihood: degree of the denominator, numerator coefficients.",
        ),
    ] = None,
    state_space: Annotated[
        str | None, option("--state-space", "n=3|auto", "Fit a state space by subspace with the Laguerre operator.")
    ] = None,
    feedthrough: Annotated[
        bool, switch("--feedthrough", "With --state-space: a direct path from input to output (D).")
    ] = False,
    domain: Annotated[
        Literal["s", "z"] | None,
        option(
            "--domain", None, "Of that model: continuous or discrete time.", "z for --orders of a held input, else s"
        ),
    ] = None,
    delay: Annotated[
        str | None,
        option("--delay", "S|auto", "Delay of the inputs in s, for the models.", "0; with --rig as the rig says"),
    ] = None,
    rig: RigFile = None,
    from_s: From = None,
    to_s: To = None,
    rate: Rate = None,
    gaps: Gaps = None,
    json: JsonFile = None,
    plot: Annotated[Path | None, option("--plot", "FILE.png", "Draw response, levels and models.")] = None,
    strict: Strict = False,
) -> None:
    """Measure a frequency response with its noise and distortion, and fit models to it.

    With --reference (the loop's outer excitation) feedback does not bias it. With --rig, physical parameters come out,
    and inputs and outputs are the rig's.
    """
    from ambid.bearing.measured import measured_text
    from ambid.job import frf
    from ambid.report.fit_text import frf_text

    with Outputs(record, rig) as outputs:
        outputs.claim(json_path(json), "--json")
        outputs.claim(plot, "--plot", FIGURE_ENDINGS)
        between, wanted, n, late = band_of(band), _orders(orders), _order(state_space), _delay(delay)
        with progress("measure") as tick:
            found = frf(
                record, inputs=inputs or (), outputs=output or (), references=reference or (), open_loop=open_loop,
                method=method, hold=hold, band=between, orders=wanted, state_space=n, feedthrough=feedthrough,
                domain=domain, delay=late, rig=rig, from_s=from_s, to_s=to_s, rate_hz=rate, gaps=gaps, tick=tick,
            )  # fmt: skip
            if plot is not None:
                from ambid.report.drawing import save
                from ambid.report.fit_figures import frf_figure

                tick("draw")
                page = frf_figure(found)
                outputs.stage(plot, lambda path: save(page, path))
        written = measured_text(found)
        outputs.stage_json(json, written)
    typer.echo(written if json == "-" else frf_text(found, paint=painter()), nl=json != "-")
    if strict and not found.passed:
        raise typer.Exit(FAILED_CHECK)


def _orders(text: str | None) -> Orders | None:
    found = None if text is None else orders_of(text)
    if text is not None and found is None:
        raise AmbidError("--orders auto: a transfer function wants its degree. Give nf=2, or use --state-space auto")
    return found


def _order(text: str | None) -> int | Literal["auto"] | None:
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    number = text.strip().removeprefix("n=")
    if not number.isdecimal() or len(number) > 3:
        raise AmbidError(f"--state-space is {text!r}; it is an order, or auto. Give n=3 and so on")
    return int(number)


def _delay(text: str | None) -> float | Literal["auto"] | None:
    if text is None or text.strip() == "auto":
        return None if text is None else "auto"
    try:
        return float(text)
    except ValueError:
        raise AmbidError(f"--delay is {text!r}; it is a time in s, or auto. Give e.g. --delay 1e-4") from None
