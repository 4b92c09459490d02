"""The estimate of a rotor as people see it: a table for the rotor and its bending modes, one for each bearing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

from ambid.control.zones import Zone
from ambid.estimation.estimate import EstimatedParameter
from ambid.estimation.result import RecordEntry
from ambid.physics.rotor_model import Bearing, position_role
from ambid.physics.shaft import Shaft
from ambid.report.document import Checks, Document, Fitting, Lines, Section, Warnings, grid, timing_section
from ambid.report.estimate import computing_time, correlations_section, poles_section, rig_sections, second_section
from ambid.report.numbers import quantity, sized
from ambid.report.parameters import calibration_lines, parameter_table, short_numbers
from ambid.report.rotor_drawing import expected_rotor, partners_of, synchronous_sections
from ambid.report.text import Line, late, names_words, other_warnings, pure, status_words, text_of
from ambid.rotor.estimate import RotorEstimate
from ambid.units import parse_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ambid.report.drawing import Block
    from ambid.report.rotor_figures import RotorEvidence

_UNSEEN = "✗"
TURN = 30.0 / 3.141592653589793  # 1/min in a rad/s


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
}


def rotor_document(estimate: RotorEstimate, shaft: Shaft | None, evidence: Callable[[], RotorEvidence]) -> Document:
    """Describe the estimate of a rotor; `shaft`: its drawing, `evidence`: what its figures show beside it."""
    e = estimate
    meanings = {spec.name: spec.meaning for spec in e.plant.parameters}
    of_rotor = [p for p in e.parameters if "." not in p.name]
    speed = f"Model at {e.speed * TURN:.6g} 1/min." if e.speed else "Model at rest."
    bearings = [_bearing(e, b) for b in e.plant.bearings]
    unseen = any(
        _UNSEEN in text_of([cell]) for b in e.plant.bearings for row in bearing_rows(e, b, b.axes) for cell in row
    )
    cross: list[Line] = [[(_UNSEEN, "bad"), " not identifiable from these data"]] if unseen else []
    calibrated = any(p.sd_calibrated for p in e.parameters)
    in_brackets = ["In brackets: one standard deviation with calibration"] if calibrated else []
    sections = [
        Section(parts=[Lines(lines=_records(e), wrap=False)], page=False),
        Section(title="Rotor", parts=[parameter_table(of_rotor, e.verdict, meanings, label="rotor")], note=speed),
        Section(title="Bending modes", parts=[grid(mode_rows(e, shaft))] if e.modes else []),
        *(replace(b, title="" if k else "Bearings", note=_SIGNS) for k, b in enumerate(bearings)),
        Section(parts=[Lines(lines=cross)], page=False),
        Section(parts=[Lines(lines=[*in_brackets, *calibration_lines(e)], indent=2)]),
        *synchronous_sections(e),
        Section(title="Checks", parts=[Checks(checks=e.checks, above=True)]),
        *([] if e.validation is None else [second_section(e.validation)]),
        Section(parts=[Warnings(warnings=other_warnings(e.checks, e.warnings))]),
        timing_section(e.timing_s, wrap=False),
    ]

    def drawings() -> list[Section]:
        from ambid.report.drawing import single
        from ambid.report.signals import record_strips

        shown_evidence = evidence()
        drawn = [
            Section(title=title, caption=caption, figure=partial(single, block))
            for block, title, caption in _titles(shown_evidence.drawings(), e)
        ]
        signals = [record_strips(r, len(shown_evidence.records)) for r in shown_evidence.records]
        close = Section(title="Signals", caption=_SIGNALS, signals=signals, folded=True)
        return [*drawn, *([close] if signals else [])]

    def drawn(width: float) -> Figure:
        from ambid.report.rotor_figures import rotor_overview

        return rotor_overview(evidence(), width)

    def appendix() -> list[Section]:
        from ambid.report.rotor_figures import rotor_poles

        noise = Section(title="Noise", caption="Levels of white sources, rms of samples.", parts=[grid(noise_rows(e))])
        correlations = correlations_section("Correlations of the estimated numbers", e.covariance_names, e.covariance)
        return [noise, correlations, poles_section(rotor_poles(e)), *rig_sections(e.rig)]

    records, rig = [RecordEntry.of(r) for r in e.records], str(e.rig.get("name") or "–")
    origin = [(r.name, f"{taken(r)}, SHA-256 {r.sha256 or '–'}") for r in records]
    count = f"rotor on {len(e.plant.axes)} axes"
    first = RecordEntry.of(e.record).name
    return Document(
        title=f"{first}, {count}",
        headline=f"{first if len(records) == 1 else names_words([r.name for r in records])}: {count}: "
        "physical parameters",
        subtitle=f"{rig} – {e.n_modes} bending modes in the model, search {e.status}",
        sections=sections, figure=drawn, drawings=drawings, appendix=appendix,
        frame=parameter_table((*e.parameters, *e.mode_parameters)).frame,
        provenance=[*origin, ("rig", rig), *computing_time(e.timing_s)],
        history=[f"{r.name}: {step}" for r in records for step in r.history],
        numbers=short_numbers(e.parameters),
    )  # fmt: skip


def _records(e: RotorEstimate) -> list[Line]:
    """Say what was identified, and from which records at which speeds."""
    n, records = len(e.plant.axes), [RecordEntry.of(r) for r in e.records]
    what = f"rotor on {n} {'axis' if n == 1 else 'axes'}"
    if len(records) == 1:
        return [[(records[0].name, "strong"), f": {what}, {taken(records[0])}", *status_words(e.status)]]
    lines: list[Line] = [[(r.name, "strong"), f": {taken(r)}"] for r in records]
    return [[f"{what}, from {len(records)} records", *status_words(e.status)], *lines]


def taken(record: RecordEntry) -> str:
    """Say how long a record is, at which rate and speed."""
    r = record
    long = f"{r.periods} periods of {r.period_s:.4g} s" if r.periods else f"{r.seconds:.4g} s"
    return f"{long} at {r.rate_hz:g} Hz, {f'{r.speed * TURN:.6g} 1/min' if r.speed else 'at rest'}"


def mode_rows(estimate: RotorEstimate, shaft: Shaft | None = None) -> list[tuple[str, ...]]:
    """Return a table of the bending modes, beside what a drawing expects of each."""
    rotor = None if shaft is None else expected_rotor(estimate.modes, shaft)
    expected = [] if rotor is None else ["from the drawing"]
    rows: list[tuple[str, ...]] = [("bending mode", "frequency", "damping ratio", *expected, "")]
    for r, (m, k) in enumerate(zip(estimate.modes, partners_of(estimate.modes, rotor), strict=True), 1):
        f, z = m.frequency_hz, m.damping
        remark = "" if m.identifiable else f"{_UNSEEN} not identifiable"
        cells = [] if rotor is None else ["–" if k is None else f"{rotor.omega[k + 2] / (2 * math.pi):.5g} Hz"]
        ratio = f"{pure(100 * z.value, 100 * z.sd)} %"
        rows.append((f"  {r}", quantity(f.value, f.sd, "Hz").text, ratio, *cells, remark))
    return rows


def _bearing(e: RotorEstimate, bearing: Bearing) -> Section:
    """Return the table of a bearing, a column for each axis; one table below the other where that is too wide."""
    wide, alone = (
        grid(bearing_rows(e, bearing, bearing.axes)),
        [grid(bearing_rows(e, bearing, (a,))) for a in bearing.axes],
    )
    return Section(parts=[Fitting(wide=[wide], narrow=lambda _: alone)])


def _titles(drawn: Mapping[str, Block], e: RotorEstimate) -> Iterator[tuple[Block, str, str]]:
    """Yield each figure with title and caption; of several records residuals have the record's name."""
    for name, block in drawn.items():
        title, caption = _CAPTIONS[name.split("_")[0] if name.startswith(("residuals", "orbits")) else name]
        if name.startswith("residuals") and len(e.records) > 1:
            k = int(name.split("_")[1]) - 1 if "_" in name else 0
            title = f"{title} of {e.records[k].get('file') or f'record {k + 1}'}"
        yield block, title, caption


def bearing_rows(estimate: RotorEstimate, bearing: Bearing, axes: Sequence[str]) -> list[tuple[str, ...]]:
    """Return parameters, delays and fits of some axes of a bearing, then its planes."""
    e, rate = estimate, RecordEntry.of(estimate.record).rate_hz
    rows: list[tuple[str, ...]] = [(f"bearing {bearing.name}", *axes)]
    own = {axis: [p for p in e.parameters if p.name.startswith(f"{axis}.")] for axis in axes}
    for what in dict.fromkeys(p.name.split(".", 1)[1] for axis in axes for p in own[axis]):
        by_name = {p.name: p for axis in axes for p in own[axis]}
        rows.append((what, *(_cell(by_name.get(f"{axis}.{what}")) for axis in axes)))
    delays = [next((d for role, d in e.delay.items() if role.startswith(f"{axis}_")), None) for axis in axes]
    rows.append(
        ("delay", *("" if d is None else f"{late(d, rate)}{', given' if d.how == 'given' else ''}" for d in delays))
    )
    fitted = [*(position_role("", k) for k in range(len(bearing.z_sensors))), "_current"]
    rows += [
        (f"fit of {role[1:]}", *(_fit(e, f"{axis}{role}") for axis in axes))
        for role in fitted
        if any(f"{axis}{role}" in e.fit for axis in axes)
    ]
    loops = [e.sensitivity.get(axis) for axis in axes]
    if any(loops):
        rows.append(("sensitivity", *("" if s is None else _loop(s) for s in loops)))
    planes = [p for p in e.parameters if p.name.startswith(f"{bearing.name}.")]
    blank = [""] * (len(axes) - 1)
    rows += [(_plane(p.name.split(".", 1)[1]), _cell(p), *blank) for p in planes]
    return rows


def _cell(p: EstimatedParameter | None) -> str:
    """A parameter in a cell: value ± sd, and where it comes from unless it is free."""
    if p is None:
        return ""
    text = quantity(p.value, p.sd, p.unit).text
    if p.sd_calibrated:
        text += f" (± {quantity(p.value, p.sd_calibrated, p.unit).sd})"
    return f"{'' if p.identifiable else f'{_UNSEEN} '}{text}{'' if p.role == 'free' else f', {p.role}'}"


def _fit(e: RotorEstimate, role: str) -> str:
    if role not in e.fit:
        return ""
    unit = parse_unit(e.plant.units[role]).si
    return f"{e.fit[role].one_step:.4f}, {sized(e.fit[role].innovation_sd, unit)} rms left"


def _loop(sensitivity: dict[str, object]) -> str:
    """The peak of an axis' sensitivity and its zone by ISO 14839-3."""
    peak = sensitivity["peak_db"]
    assert isinstance(peak, dict)
    return f"{pure(float(peak['value']), float(peak['sd'] or 0.0))} dB, {Zone.read(sensitivity).words}"


def _plane(what: str) -> str:
    """Name a plane of a bearing: z, z_sensor, z_sensor2 …"""
    return "plane" if what == "z" else f"{what.removeprefix('z_').replace('sensor', 'sensor plane ')}".strip()


def noise_rows(e: RotorEstimate) -> list[tuple[str, ...]]:
    """Return a table of the levels of noise, a column for each axis."""
    axes = e.plant.axes
    kinds = list(dict.fromkeys(name.split("_", 1)[1] for name in e.noise))
    rows: list[tuple[str, ...]] = [("noise of", *axes)]
    for kind in kinds:
        unit = {"force": "N", "voltage": "V", "current": "A"}.get(kind, "m")
        cells = [e.noise.get(f"{axis}_{kind}") for axis in axes]
        rows.append((kind, *("" if x is None else sized(x, unit) for x in cells)))
    return rows
