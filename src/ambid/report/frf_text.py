"""A measured frequency response, and what was fitted to it, as tables for the terminal: 80 columns, without colour."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.arrays import Array
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.frequency.measured import Measured
from ambid.blackbox.model import BlackBoxModel
from ambid.blackbox.structures import any_structure
from ambid.blackbox.transfer_model import TransferModel
from ambid.report.fit_text import coefficient_lines, pole_lines
from ambid.report.numbers import prefixed, quantity, sized
from ambid.report.text import WIDTH, Paint, check_lines, columns, parameter_lines, plain, timing_line, warning_lines
from ambid.units import UNKNOWN

if TYPE_CHECKING:
    from ambid.blackbox.frequency.physical_estimate import FrequencyEstimate


_SHOWN = 8  # singular values that a line has room for


def frf_text(measured: Measured, *, width: int = WIDTH, paint: Paint = plain) -> str:
    """Write a measured response for people.

    `width`: columns of the terminal; `paint`: adds colour; the layout does not depend on it. Returns header, table of
    the pairs, distortion levels, fit, physical parameters, warnings and timing, without a final line feed.
    """
    fit, estimate = measured.fit, measured.estimate
    blocks = [
        _header(measured, width, paint),
        pair_lines(measured, width=width),
        _distortion_lines(measured, width),
        [] if fit is None else _fit_lines(fit, width, paint),
        [] if estimate is None else _estimate_lines(estimate, width, paint),
        warning_lines(warnings_of(measured), width=width, paint=paint),
        [paint(timing_line(measured.timing_s), "dim")] if measured.timing_s else [],
    ]
    return "\n\n".join("\n".join(block) for block in blocks if block)


def _header(measured: Measured, width: int, paint: Paint) -> list[str]:
    frf, record = measured.response, measured.record
    name, samples = str(record.get("file") or "record"), int(str(record.get("samples", 0)))
    first = f"{paint(name, 'strong')}: frequency response"
    if samples:
        first += f", {samples} samples at {frf.rate_hz:g} Hz ({samples / frf.rate_hz:.4g} s)"
    reference = f", reference {', '.join(measured.references)}" if measured.references else ""
    loop = ", said to be open loop" if measured.open_loop else ""
    signals = f"from {', '.join(frf.inputs)} to {', '.join(frf.outputs)}{reference}{loop}"
    f = frf.frequency_hz
    method = f"{frf.method}{_periods(frf.details)}; {f.size} lines, {sized(f[0], 'Hz')} to {sized(f[-1], 'Hz')}"
    return [first, *textwrap.wrap(signals, width), *textwrap.wrap(method, width)]


def _periods(details: Any) -> str:
    if "period" not in details:
        return ""
    counts = "+".join(str(n) for n in details["periods"])
    dropped = sum(details.get("dropped_periods", ()))
    return f", {counts} periods of {details['period']} samples" + (f" ({dropped} more left out)" if dropped else "")


def pair_lines(measured: Measured, *, width: int = WIDTH) -> list[str]:
    """Write size and quality of the response of every pair.

    Returns a header, a line for each pair and what the columns are: medians over the lines, in percent of the
    magnitude.
    """
    frf, noise, distortion = measured.response, measured.response.noise_sd, measured.distortion_sd
    size = frf.magnitude
    rows = [("", "|G|", "sd", "noise", "distortion", "coherence")]
    for j, o in enumerate(frf.outputs):
        for k, i in enumerate(frf.inputs):
            g = size[:, j, k]
            rows.append(
                (
                    f"{i} → {o}",
                    _range(g, response_unit(frf.units, o, i)),
                    _share(frf.sd[:, j, k], g),
                    "–" if noise is None else _share(noise[:, j, k], g),
                    "–" if distortion is None else _share(distortion[:, j, k], g),
                    "–" if frf.coherence is None else f"{float(np.median(frf.coherence[:, j])):.4f}",
                )
            )
    lines = columns(rows, right=(2, 3, 4, 5))
    if max(map(len, lines)) > width:
        lines = columns([(row[0], *row[2:]) for row in rows], right=(1, 2, 3, 4))
    if max(map(len, lines)) > width:  # names too long to stand beside anything: each on a line of its own
        head, *values = columns([("  ", *row[2:]) for row in rows], right=(1, 2, 3, 4))
        named = [[*textwrap.wrap(row[0], width), line] for row, line in zip(rows[1:], values, strict=True)]
        lines = [head, *(line for pair in named for line in pair)]
    about = "medians over the lines, of |G|"
    about += "; noise and distortion were not told apart" if distortion is None else ""
    return [*lines, *textwrap.wrap(f"({about})", width)]


def response_unit(units: Any, output: str, source: str) -> str:
    """Return the unit of a response, such as ``"m/V"``.

    `units`: by name; a name that is missing has an unknown unit.
    """
    above, below = str(units.get(output, UNKNOWN)), str(units.get(source, UNKNOWN))
    if above == below:
        return "1"
    if below == "1":
        return above
    return f"{above}/({below})" if set(below) & set(" /") else f"{above}/{below}"


def _range(g: Array, unit: str) -> str:
    low, high = float(np.min(g)), float(np.max(g))
    scale, shown = (1.0, unit) if unit.startswith((UNKNOWN, "1/")) else prefixed(high, unit)
    return f"{low / scale:.3g} … {high / scale:.3g} {shown}".removesuffix(" 1")


def _share(sd: Array, g: Array) -> str:
    with np.errstate(divide="ignore"):
        return f"{100 * float(np.median(sd / g)):.2g} %"


def _distortion_lines(measured: Measured, width: int) -> list[str]:
    """Levels at the lines that the excitation left out, beside the signal."""
    found: Any = measured.response.details.get("distortions")
    if found is None:
        return []
    rows: list[tuple[str, ...]] = [("at lines without excitation", "even", "its noise", "odd", "its noise")]
    for k, output in enumerate(measured.response.outputs):
        signal = _rms(found.signal, k)
        cells = [found.even, found.even_noise, found.odd, found.odd_noise]
        rows.append((output, *("–" if x is None or not x.size else _decibel(_rms(x, k), signal) for x in cells)))
    return [*columns(rows, right=(1, 2, 3, 4)), *textwrap.wrap("(rms of a line beside that of an excited one)", width)]


def _rms(levels: Array, k: int) -> float:
    return float(np.sqrt(np.mean(levels[:, k] ** 2)))


def _decibel(x: float, beside: float) -> str:
    return f"{20 * np.log10(x / beside):.1f} dB" if x > 0 and beside > 0 else "none"


def _fit_lines(fit: BlackBoxFit, width: int, paint: Paint) -> list[str]:
    verdict = "" if fit.status == "converged" else f" – {fit.status}"
    orders = ", ".join(f"{k} = {'/'.join(map(str, v)) if isinstance(v, tuple) else v}" for k, v in fit.orders.items())
    about = f"{fit.structure}: {any_structure(fit.structure).summary}; {orders}{verdict}"
    lines = textwrap.wrap(about, width)
    lines[0] = lines[0].replace(fit.structure, paint(fit.structure, "strong"), 1)
    if fit.structure == "frf-ml":  # states are in coordinates of the method's own: their numbers say nothing
        fit = _once(fit)
        lines += coefficient_lines(fit)
    lines += [*pole_lines(_first_entry(fit), paint=paint), *_delay_lines(fit), *_laguerre_lines(fit, width)]
    return [*lines, *check_lines(fit.checks, width=width, paint=paint)]


def _common(model: BlackBoxModel) -> bool:
    if not isinstance(model, TransferModel):
        return False
    dens = [d for row in model.den for d in row]
    return len(dens) > 1 and all(np.array_equal(d, dens[0]) for d in dens)


def _once(fit: BlackBoxFit) -> BlackBoxFit:
    """Leave a denominator that all entries share to the first, so that its coefficients are shown once."""
    if not isinstance(fit.model, TransferModel) or not _common(fit.model) or fit.covariance is None:
        return fit
    covariance = fit.covariance.copy()
    for o, i, which, _, place in fit.model.parts():
        if which == "den" and (o or i):
            covariance[place, :] = covariance[:, place] = 0.0
    return replace(fit, covariance=covariance)


def _first_entry(fit: BlackBoxFit) -> BlackBoxFit:
    """Where all entries share a denominator, the fit of the first: it has all the poles."""
    model = fit.model
    if not isinstance(model, TransferModel) or not _common(model):
        return fit
    places = [np.arange(p.start, p.stop) for o, i, _, _, p in model.parts() if not (o or i)]
    own = np.concatenate(places)
    first = TransferModel(num=((model.num[0][0],),), den=((model.den[0][0],),), dt=model.dt, delay=model.delay[:1])
    return replace(fit, model=first, covariance=None if fit.covariance is None else fit.covariance[np.ix_(own, own)])


def _delay_lines(fit: BlackBoxFit) -> list[str]:
    delay, sd = (fit.details.get(k) for k in ("delay_s", "delay_sd_s"))
    if not delay and sd is None:
        return []
    value = float(str(delay))
    text = quantity(value, 0.0 if sd is None else float(str(sd)), "s").text
    return [f"delay {text} ({value / fit.dt:.4g} samples)"]


def _laguerre_lines(fit: BlackBoxFit, width: int) -> list[str]:
    d: Any = fit.details
    if "condition_without" not in d:
        return []
    values = " ".join(f"{s:.3g}" for s in d["singular_values"][:_SHOWN])
    more = " …" if len(d["singular_values"]) > _SHOWN else ""
    text = (
        f"Laguerre operator p = {d['p']:.4g} rad/s: condition {d['condition']:.3g} of {d['block_rows']} block rows, "
        f"{d['condition_without']:.3g} without it; singular values {values}{more} (noise alone: about 1)"
    )
    return textwrap.wrap(text, width)


def _estimate_lines(estimate: FrequencyEstimate, width: int, paint: Paint) -> list[str]:
    d = estimate.delay
    spread = "" if d.sd is None else f" ± {d.sd:.2g}"
    verdict = "" if estimate.status == "converged" else paint(f" – {estimate.status}", "bad")
    return [
        f"{paint('physical parameters', 'strong')} of model {estimate.model}{verdict}",
        *parameter_lines(estimate, width=width, paint=paint),
        f"delay {d.samples + d.fraction:.4g}{spread} samples ({d.how})",
        *check_lines(estimate.checks, width=width, paint=paint),
    ]


def warnings_of(measured: Measured) -> list[str]:
    """Return all warnings, each once, without what only repeats a failed check.

    Returns those of the response first, as all that follows rests on it.
    """
    found = [*measured.response.warnings]
    for x in (measured.fit, measured.estimate):
        if x is None:
            continue
        said = [c.detail for c in x.checks.values() if not c.passed]
        for whole in x.warnings:
            warning = whole
            for detail in said:  # it stands with the checks
                warning = warning.replace(f"{detail}; ", "")
            if not warning.endswith(tuple(said)):
                found.append(warning)
    return list(dict.fromkeys(found))
