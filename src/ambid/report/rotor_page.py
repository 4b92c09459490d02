"""The page of a rotor's estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from ambid.report.drawing import single
from ambid.report.estimate_page import correlations, second_section
from ambid.report.numbers import sized
from ambid.report.orbit_panels import unbalance_rows, vibration_rows
from ambid.report.page import Page, Section, check_table
from ambid.report.rotor_figures import RotorEvidence
from ambid.report.rotor_text import TURN, bearing_rows, machine, mode_rows, taken
from ambid.report.strips import record_strips
from ambid.report.text import other_warnings, parameter_rows
from ambid.rotor.estimate import RotorEstimate

if TYPE_CHECKING:
    from ambid.report.page import Cell, Table

_SIGNS = "Sign convention: force = k_i · current − k_x · position; an attracting magnet has k_x < 0."
_LINES = (
    "Lines: the identified rotor, sampled, with hold and delay of the input, and the 95 % interval that its covariance "
    "gives. Points: at lines where this axis is excited; the part of the other axes is taken out as the model says it, "
    "and the 95 % intervals come from the scatter between periods."
)
_SIGNALS = "Each record as it was sampled, with its synchronous part; of a long one extremes, and a stretch in full."
_CAPTIONS: Mapping[str, tuple[str, str]] = {
    "response_x": ("Response in plane x", _LINES),
    "response_y": ("Response in plane y", _LINES),
    "response_z": ("Response along the shaft", _LINES),
    "response_across": ("Response across the planes", "Gyroscopic coupling at the speed of the record. " + _LINES),
    "coils": ("Coils", "Current of each coil from its own voltage. " + _LINES),
    "residuals": (
        "Residuals",
        "What the model leaves of each output, mean over the periods, beside the noise that follows from the scatter "
        "between periods. For a right model 5 % lie above the line.",
    ),
    "shapes": (
        "Bending modes along the shaft",
        "Shapes at rest, of modal mass 1 kg, identified at the planes of bearings and sensors.",
    ),
    "campbell": (
        "Campbell diagram",
        "Whirl of the rotor without its bearings over speed: from the identified modes and gyroscopic terms with 95 % "
        "bands, and from the drawing where the rig holds one. Unbalance excites a forward line where it meets 1x.",
    ),
    "orbits": (
        "Orbits",
        "Above what turns with the rotor, runout of the sensors included, below what does not, beside the clearance.",
    ),
    "unbalance": (
        "Unbalance",
        "Unbalance by plane as seen on the rotor, with 95 % regions, and where mass times radius is to be added; "
        "motion at the sensors now and with that correction. Phases count from the mark of angle zero, from x to y.",
    ),
    "poles": ("Poles", "Of the identified rotor in its magnets, in open loop, with their 95 % regions."),
    "correlations": (
        "Uncertainty of the parameters",
        "Parameters with a correlation near ±1 are known only together: what the data show is their combination.",
    ),
}


def rotor_page(evidence: RotorEvidence) -> Page:
    """Return the page of a rotor's estimate, with its figures."""
    e = evidence.estimate
    drawn = evidence.drawings()
    signals = [record_strips(r, len(evidence.records)) for r in evidence.records]
    sections = [
        _parameters(e),
        *([Section(title="Bending modes", tables=[mode_rows(e, evidence.shaft)])] if e.modes else []),
        Section(title="Bearings", tables=[bearing_rows(e, b, b.axes) for b in e.plant.bearings], note=_SIGNS),
        *([_turning(e)] if e.synchronous else []),
        Section(title="Checks", tables=[check_table(e.checks)]),
        *([] if e.validation is None else [second_section(e.validation)]),
        *(Section(title=t, caption=c, figure=partial(single, drawn[n])) for n, t, c in _titles(drawn, e)),
        *([Section(title="Signals", caption=_SIGNALS, signals=signals, folded=True)] if signals else []),
        Section(title="Noise", caption="Levels of white sources, rms of samples.", tables=[noise_rows(e)]),
        Section(
            title="Correlations of the estimated numbers", tables=[correlations(e.covariance_names, e.covariance)],
            folded=True,
        ),
        Section(title="Rig", text=str(e.rig.get("text") or ""), folded=True),
    ]  # fmt: skip
    rows = [(str(r.get("file") or "record"), f"{taken(r)}, SHA-256 {r.get('sha256') or '–'}") for r in e.records]
    time = [("computing time", f"{sum(e.timing_s.values()):.3g} s")] if e.timing_s else []
    rig = str(e.rig.get("name") or "–")
    return Page(
        title=f"{evidence.title}: physical parameters",
        subtitle=f"{rig} – {e.n_modes} bending modes in the model, search {e.status}",
        warnings=other_warnings(e.checks, e.warnings),
        sections=sections,
        provenance=[*rows, ("rig", rig), *time],
        history=[f"{r.get('file') or 'record'}: {step}" for r in e.records for step in _steps(r)],
    )


def _steps(record: Mapping[str, object]) -> list[str]:
    history = record.get("history")
    return [str(step) for step in history] if isinstance(history, (list, tuple)) else []


def _titles(drawn: Mapping[str, object], e: RotorEstimate) -> list[tuple[str, str, str]]:
    """Return name, title and caption of each figure; of several records residuals have the record's name."""
    found = []
    for name in drawn:
        title, caption = _CAPTIONS[name.split("_")[0] if name.startswith(("residuals", "orbits")) else name]
        if name.startswith("residuals") and len(e.records) > 1:
            k = int(name.split("_")[1]) - 1 if "_" in name else 0
            title = f"{title} of {e.records[k].get('file') or f'record {k + 1}'}"
        found.append((name, title, caption))
    return found


def _turning(e: RotorEstimate) -> Section:
    s = e.synchronous
    tables = [rows for rows in (unbalance_rows(s), vibration_rows(s)) if rows]
    return Section(title="Unbalance and runout", tables=tables, note=s["hint"] or "1 g mm is 1e-6 kg m.")


def _parameters(e: RotorEstimate) -> Section:
    meaning = {spec.name: spec.meaning for spec in e.plant.parameters}
    rows: list[Sequence[Cell]] = [("", "meaning", "value ± sd", "95 % interval", "in SI", "verdict")]
    for name, *more, words, style in parameter_rows(machine(e), e.verdict):
        rows.append((name, (meaning[name], ""), *more, (words, style)))
    at = f"Model at {e.speed * TURN:.6g} 1/min." if e.speed else "Model at rest."
    return Section(title="Rotor", tables=[rows], note=at)


def noise_rows(e: RotorEstimate) -> Table:
    """Return a table of the levels of noise, a column for each axis."""
    axes = e.plant.axes
    kinds = list(dict.fromkeys(name.split("_", 1)[1] for name in e.noise))
    rows: list[Sequence[Cell]] = [("noise of", *axes)]
    for kind in kinds:
        unit = {"force": "N", "voltage": "V", "current": "A"}.get(kind, "m")
        cells = [e.noise.get(f"{axis}_{kind}") for axis in axes]
        rows.append((kind, *("" if x is None else sized(x, unit) for x in cells)))
    return rows
