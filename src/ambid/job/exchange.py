"""Results for other programs: ``.mat``, python-control, C source, FMU; a rotor as a script for ROSS.

ROSS 3 takes bearings as tables over whirl frequency and speed; before, it reads them at the running speed alone, and a
controlled magnet's stand for the synchronous frequency.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array, Complex
from ambid.bearing.magnet_result import NonlinearBearingEstimate, linearised
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.prediction import plant_form
from ambid.errors import AmbidError, EstimationError, nearest
from ambid.estimation.estimate import Continuous
from ambid.job.files import EXPORT_ENDINGS, MAT_HEADER, Files
from ambid.job.plant_source import comment_text
from ambid.job.results import rig_of
from ambid.physics.linear_model import UNITS, StateSpace, delayed, model
from ambid.physics.loop import UNLIMITED
from ambid.physics.shaft import Disc, Material, Shaft, Step
from ambid.rotor.estimate import RotorEstimate
from ambid.settings.caller import check_switch, path_of, setting

SCRIPTS = ("control", "ross")
"""For which library a script can be."""

_LATEST = 1000  # samples by which an input may act late
_STILL = 1.0  # Hz at which the bearings of a rotor at rest are read, and where their tables begin
_POINTS, _HIGHEST = 80, 0.45  # of these tables, the latter of the sampling rate
_STIFF, _LIGHT, _THICK = 1e14, 1e-3, 0.05  # E, rho and diameter of the shaft of a rotor without drawing


def plant_of(result: Any) -> Any:
    """Return the model of a linear result, whose inputs and outputs have names."""
    return result.plant if isinstance(result, RotorEstimate) else model(result.model)


def continuous_of(result: Any) -> Continuous:
    """Return the continuous plant about the operating point, which is the zero of every export."""
    if not isinstance(result, NonlinearBearingEstimate):
        return result.continuous  # type: ignore[no-any-return]
    rest = _operating_point(result)
    return linearised(result, rest["position"], rest["current"])


def _operating_point(result: Any) -> dict[str, float]:
    """Return what signals are, SI, where an export's are zero; empty for a rotor, whose estimate has no means."""
    if isinstance(result, BlackBoxFit):
        levels = np.concatenate([result.offsets.u, result.offsets.y]).tolist()
        return dict(zip((*result.inputs, *result.outputs), levels, strict=True))
    if isinstance(result, NonlinearBearingEstimate):
        from ambid.job.plant_source import rest_of

        return rest_of(result)
    return {} if isinstance(result, RotorEstimate) else dict(result.operating_point)


def _zero(result: Any) -> str:
    """Say from what the signals of an export count."""
    units = result.units if isinstance(result, BlackBoxFit) else UNITS
    at = ", ".join(f"{name} {x!r} {units[name]}" for name, x in _operating_point(result).items())
    return f"Inputs and outputs count from the operating point: {at or 'the mean of each signal over the record'}."


def export(result: Any, path: str | Path, to: str | None = None, *, anyway: bool = False) -> None:
    """Write a plant, as `write_plant`; nothing is written over that was not made here."""
    path = path_of(path, "path")
    with Files() as written:
        written.claim(path, "path", EXPORT_ENDINGS)
        written.stage(path, lambda beside: write_plant(result, beside, path.stem, to, anyway=anyway))


def write_plant(result: Any, path: Path, name: str, to: str | None = None, *, anyway: bool = False) -> None:
    """Write a plant called `name` (C, FMU) by the file's ending, a script for `to` of `SCRIPTS`; `anyway`: also where
    the result should not be relied on, and then the file says so.
    """
    check_switch({"anyway": anyway})
    ending = path.suffix.lower()
    if to is not None and to not in SCRIPTS:
        raise EstimationError(
            f"to is {to!r:.40}; scripts are for {' or '.join(SCRIPTS)}.{nearest(to, SCRIPTS)} Correct it"
        )
    if to is not None and ending != ".py":
        raise EstimationError(
            f"'to' is for scripts, files ending in .py, and this one ends in {ending}. Omit it, or rename the file"
        )
    doubt = _doubt(result)
    if doubt and not anyway:
        raise EstimationError(
            f"{doubt}; its plant is not exported. Identify it better, or give {setting('anyway', True)}"
        )
    about = [*_about(result), _zero(result), *([f"NOT TO BE RELIED ON: {doubt}."] if doubt else [])]
    ross = ending == ".py" and (isinstance(result, RotorEstimate) if to is None else to == "ross")
    if ross and not isinstance(result, RotorEstimate):
        raise EstimationError("a script for ROSS holds a rotor; this result is none. Export it for python-control")
    if ending == ".mat":
        write_mat(path, {**_matrices(result), "about": " ".join(about)})
    elif ending == ".py":
        path.write_text(ross_script(result, about) if ross else control_script(result, about), encoding="utf-8")
    else:
        _write_source(result, path, name, about)


def _write_source(result: Any, path: Path, name: str, about: list[str]) -> None:
    from ambid.job.plant_source import c_source, declarations, prefixed, source_of, write_fmu

    try:
        limits = None if isinstance(result, BlackBoxFit) else rig_of(result, "the estimate").limits
    except AmbidError:  # it remembers no rig: where the rotor stops is not known
        limits = None
    if not isinstance(result, BlackBoxFit):
        _space(result)  # which refuses what nothing can hold
    source = source_of(result, UNLIMITED if limits is None else limits.position)
    if path.suffix.lower() == ".fmu":
        write_fmu(source, path, name, about)
    else:
        text = (c_source if path.suffix.lower() == ".c" else declarations)(source, about)
        path.write_text(prefixed(text, name), encoding="utf-8")


def _doubt(result: Any) -> str:
    """Say why a plant should not be relied on; empty where nothing is against it."""
    found = []
    if result.verdict.word == "unusable":
        found.append(f"the result is unusable ({'; '.join(r.text for r in result.verdict.reasons[:2])})")
    if not isinstance(result, BlackBoxFit):  # whose coefficients mean nothing one by one
        unseen = [p.name for p in (*result.parameters, *getattr(result, "mode_parameters", ())) if not p.identifiable]
        found += [f"its record does not show {', '.join(unseen)}"] if unseen else []
        positive = {spec.name for spec in plant_of(result).parameters if spec.positive}
        found += [f"{p.name} = {p.value:g} {p.unit} is not positive" for p in result.parameters
                  if p.name in positive and not p.value > 0.0]  # fmt: skip
    return ", and ".join(found)


def _about(result: Any) -> list[str]:
    """Say in a few lines what a plant is and where it comes from, free of what could end a comment or a string."""
    records = getattr(result, "records", None) or (getattr(result, "record", None) or {},)
    kind = f"structure {result.structure}" if isinstance(result, BlackBoxFit) else f"model {result.model}"
    if isinstance(result, NonlinearBearingEstimate):
        kind = f"{kind}, {result.law}"
    if isinstance(result, RotorEstimate):
        kind = f"{kind} at {result.speed:.6g} rad/s, about its mean position"
    known = [str(getattr(result, "rig", {}).get("name", "")) or "a record", str(records[0].get("file") or "")]
    lines = [
        f"The plant of {known[0]}: {kind}.",
        f"Identified {f'from {known[1]} ' if known[1] else ''}by ambid {version('ambid')};"
        f" verdict {result.verdict.word}.",
        f"sha256 of the record: {records[0].get('sha256') or 'none'}",
    ]
    return [comment_text(line) for line in lines]


def _space(result: Any) -> tuple[Any, Any, Array, float]:
    """Return states with A, B and C, the model whose signals have names, the delays in samples, the period in s."""
    bearing = isinstance(result, NonlinearBearingEstimate)
    at, plant = continuous_of(result), plant_of(result)
    rate = float(str((result.records[0] if bearing else result.record)["rate_hz"]))
    late = {"voltage": result.delay_samples(rate) or 0.0} if bearing else {
        role: x.samples + x.fraction for role, x in result.delay.items()
    }  # fmt: skip
    if not all(np.isfinite(x).all() for x in (at.A, at.B, at.C)):
        raise EstimationError("the plant has numbers that are not finite; it cannot be exported. Identify it again")
    if max(late.values(), default=0.0) > _LATEST:
        raise EstimationError(f"an input acts more than {_LATEST} samples late, too many to export. Identify it again")
    return at, plant, np.array([late.get(role, 0.0) for role in plant.inputs]), 1.0 / rate


def _sampled(at: Any, delays: Array, period: float) -> dict[str, Any]:
    """Return the matrices of the sampled plant, inputs held and late, with states for those on their way."""
    space = StateSpace(A=at.A, B=at.B, C=at.C, E=np.zeros((at.A.shape[0], 0)))
    d = delayed(space, period, delays)
    return {"A": d.A, "B": d.B, "C": d.C, "D": np.zeros((d.C.shape[0], d.B.shape[1])), "sample_time_s": period}


def _matrices(result: Any) -> dict[str, Any]:
    """Return what a ``.mat`` file holds: the plant by name, numbers as columns."""
    if isinstance(result, BlackBoxFit):
        form = plant_form(result)
        names = {"inputs": _cells(result.inputs), "outputs": _cells(result.outputs)}
        names |= {"input_rest": result.offsets.u, "output_rest": result.offsets.y}
        return {"A": form.A, "B": form.B, "C": form.C, "D": form.D, "sample_time_s": form.dt, **names}
    at, plant, delays, period = _space(result)
    found: dict[str, Any] = {
        "A": at.A, "B": at.B, "C": at.C, "D": np.zeros((at.C.shape[0], at.B.shape[1])), "states": _cells(at.states),
        "inputs": _cells(plant.inputs), "outputs": _cells(plant.outputs), "delay_samples": delays,
        "input_units": _cells(plant.units[x] for x in plant.inputs),
        "output_units": _cells(plant.units[x] for x in plant.outputs),
        "parameters": _cells(p.name for p in result.parameters), "units": _cells(p.unit for p in result.parameters),
        "value": np.array([p.value for p in result.parameters]), "sd": np.array([p.sd for p in result.parameters]),
        "covariance": result.covariance, "covariance_names": _cells(result.covariance_names),
        "sampled": _sampled(at, delays, period),
    }  # fmt: skip
    if isinstance(result, RotorEstimate):
        modes = result.modes
        found |= {
            "speed_rad_s": result.speed, "rate_hz": 1.0 / period,
            "mode_hz": np.array([m.frequency_hz.value for m in modes]),
            "mode_damping": np.array([m.damping.value for m in modes]),
            "mode_shape": np.array([[m.shape[p].value for p in result.plant.places] for m in modes]),
            "mode_places": _cells(result.plant.places),
        }  # fmt: skip
    else:
        found["operating_point"] = _operating_point(result)
    return found


def _cells(names: Any) -> Any:
    return np.array(list(names), dtype=object)


# --- python-control -------------------------------------------------------------------------------------------------


def control_script(result: Any, about: list[str]) -> str:
    """Return a Python script that makes the plant an object of python-control, continuous and sampled."""
    begin = [*_opened(about), "import control", "import numpy as np", ""]
    if isinstance(result, BlackBoxFit):
        form = plant_form(result)
        names = {"inputs": result.inputs, "outputs": result.outputs}
        parts = {"plant": ("sampled at DT", {x: getattr(form, x) for x in "ABCD"}, "DT", names)}
        begin += [f"DT = {form.dt!r}  # s"]
    else:
        at, plant, delays, period = _space(result)
        names = {"inputs": plant.inputs, "outputs": plant.outputs}
        late = _sampled(at, delays, period)
        D = np.zeros((at.C.shape[0], at.B.shape[1]))
        continuous = {"A": at.A, "B": at.B, "C": at.C, "D": D}
        parts = {
            "plant": ("continuous, inputs without their delay", continuous, "0", {**names, "states": at.states}),
            "sampled": ("sampled at DT, inputs held and late by their delay", late, "DT", names),
        }
        begin += [
            f"DT = {period!r}  # s", f"DELAY = {dict(zip(plant.inputs, delays.tolist(), strict=True))}  # samples",
            f"PARAMETERS = {{  # value, standard deviation, unit{''.join(_entry(p) for p in result.parameters)}\n}}",
        ]  # fmt: skip
    begin += [f"OPERATING_POINT = {_operating_point(result)}  # what signals are where they are zero here, SI"]
    for name, (what, matrices, dt, labels) in parts.items():
        begin += [
            "", "", f"def {name}():", f'    """Return the plant, {what}."""',
            *(f"    {x} = np.array({matrices[x].tolist()}).reshape{matrices[x].shape}" for x in "ABCD"),
            f"    return control.ss(A, B, C, D, {dt}, {', '.join(f'{k}={list(v)}' for k, v in labels.items())})",
        ]  # fmt: skip
    return "\n".join([*begin, "", "", 'if __name__ == "__main__":', "    print(plant())", ""])


def _entry(p: Any) -> str:
    return f"\n    {p.name!r}: ({p.value!r}, {p.sd!r}, {p.unit!r}),"


def _opened(about: list[str]) -> list[str]:
    """Return the beginning of a script, its docstring not yet ended by what is to follow."""
    return [f'"""{about[0]}', "", *about[1:], '"""', ""]


# --- ROSS -----------------------------------------------------------------------------------------------------------


def ross_script(estimate: RotorEstimate, about: list[str]) -> str:
    """Return a Python script that builds the rotor for ROSS, with its state space."""
    from ambid.rig import rig_from_text

    rig = rig_from_text(str(estimate.rig["text"]), str(estimate.rig["name"]))
    theta, (_, plant, delays, period) = estimate.numbers, _space(estimate)
    synchronous = abs(estimate.speed) or 2.0 * np.pi * _STILL
    end = 2.0 * np.pi * _HIGHEST / period
    whirl = np.unique([*np.geomspace(2.0 * np.pi * _STILL, end, _POINTS), synchronous])
    known = _stiffnesses(estimate, rig, whirl)
    planes = [theta[place] for place in plant.places]
    shaft = rig.shaft or _rigid(planes, theta)
    z = np.asarray(shaft.free_rotor(1, planes=[*planes, theta["z_cg"]]).z)
    read = "the loop and the magnets" if known else "the magnets alone (no controller is known)"
    of = "the drawing" if rig.shaft else "m, Id and Ip on a shaft that does not bend (no drawing is known)"
    axes = {"frequency": "WHIRL", **({"speed": "SPEEDS"} if len(known) > 1 else {})}
    return "\n".join([
        f'"""{about[0]}', "", *about[1:], "",
        f"Shaft: {of}. Bearings: {read}, in ROSS 3 over whirl frequency{' and speed' * (len(known) > 1)}, in ROSS 2",
        f"synchronous, at {synchronous / (2.0 * np.pi):.6g} Hz; at other frequencies those are wrong.",
        'The identified plant, all frequencies, is state_space(): x\' = A x + B u, y = C x, SI, u late by DELAY.',
        '"""', "",
        "import numpy as np", "import ross as rs", "", f"SPEED = {estimate.speed!r}  # rad/s",
        f"WHIRL = {whirl.tolist()}  # rad/s", f"SPEEDS = {sorted(known)}  # rad/s",
        f"INPUTS = {list(plant.inputs)}", f"OUTPUTS = {list(plant.outputs)}",
        f"DELAY = {[x * period for x in delays.tolist()]}  # s, by which each input acts late",
        f"STATES = {list(estimate.continuous.states)}",
        "TABLES = int(getattr(rs, \"__version__\", \"2\").split(\".\")[0]) >= 3", "", "",
        "def bearing(n, tag, **table):",
        '    """Return a bearing by its table; before ROSS 3 synchronous, at SPEED."""',
        "    if TABLES:",
        f"        return rs.BearingElement(n=n, tag=tag, {', '.join(f'{k}={v}' for k, v in axes.items())}, **table)",
        f"    at = WHIRL.index({synchronous!r})",
        "    there = {name: float(np.atleast_2d(x)[-1, at]) for name, x in table.items()}",
        "    return rs.BearingElement(n=n, tag=tag, **there)",
        "", "", "def rotor():",
        '    """Return the rotor: shaft, discs, bearings."""', *_elements(shaft, z),
        "    discs = [", *_discs(shaft, z), "    ]", "    bearings = [", *_bearings(estimate, known, whirl, z),
        "    ]", "    return rs.Rotor(shaft, discs, bearings)", "", "", "def state_space():",
        '    """Return A, B, C."""',
        *(f"    {x} = np.array({getattr(estimate.continuous, x).tolist()})" for x in "ABC"),
        "    return A, B, C", "", "", 'if __name__ == "__main__":',
        "    found = rotor().run_modal(SPEED, **({\"matched_whirl\": True} if TABLES else {}))",
        "    print(found.wd / (2 * np.pi), \"Hz\")", "",
    ])  # fmt: skip


def _rigid(planes: list[float], theta: Mapping[str, float]) -> Shaft:
    """Return a light, stiff shaft through all planes with the mass of a rotor without drawing as one disc."""
    low, high = min(*planes, theta["z_cg"]), max(*planes, theta["z_cg"])
    disc = Disc(z=theta["z_cg"], m=theta["m"], Id=theta["Id"], Ip=theta.get("Ip", 0.0))
    steps = (Step(length=high - low, diameter=_THICK),)
    return Shaft(steps=steps, discs=(disc,), material=Material(E=_STIFF, rho=_LIGHT), z=low, elements=1)


def _elements(shaft: Shaft, z: Array) -> list[str]:
    """Return the shaft's elements from node to node."""
    ends = shaft.z + np.cumsum([step.length for step in shaft.steps])
    materials = list(dict.fromkeys(step.material or shaft.material for step in shaft.steps))
    lines = [
        f'    material{k} = rs.Material(name="material{k}", rho={m.rho!r}, E={m.E!r}, Poisson={m.nu!r})'
        for k, m in enumerate(materials)
    ]
    lines.append("    shaft = [")
    for a, b in pairwise(z.tolist()):
        step = shaft.steps[min(int(np.searchsorted(ends, (a + b) / 2.0)), len(shaft.steps) - 1)]
        k = materials.index(step.material or shaft.material)
        lines.append(
            f"        rs.ShaftElement(L={b - a!r}, idl={step.bore!r}, odl={step.diameter!r}, material=material{k}),"
        )
    return [*lines, "    ]"]


def _discs(shaft: Shaft, z: Array) -> list[str]:
    return [f"        rs.DiskElement(n={_node(z, d.z)}, m={d.m!r}, Id={d.Id!r}, Ip={d.Ip!r})," for d in shaft.discs]


def _bearings(estimate: RotorEstimate, known: Mapping[float, Complex], whirl: Array, z: Array) -> list[str]:
    """Return the bearings, stiffness and damping of each axis over whirl frequency, by row over speed too."""
    theta, plant, lines = estimate.numbers, estimate.plant, []
    for b in plant.bearings:
        node = _node(z, theta["z_cg"] if b.axial else theta[f"{b.name}.z"])
        words = {name: np.zeros((max(len(known), 1), whirl.size)) for name in ("kxx", "kyy", "cxx", "cyy")}
        for plane, axis in zip("z" if b.axial else "xy", b.axes, strict=False):
            j = plant.axes.index(axis)
            k_x = np.full(whirl.size, theta[f"{axis}.k_x"], complex)
            k = np.array([known[at][:, j] for at in sorted(known)] or [k_x])
            words |= {f"k{plane}{plane}": k.real, f"c{plane}{plane}": k.imag / whirl}
        lines.append(f"        bearing({node}, {b.name!r},")
        for name, x in words.items():
            table = [[float(f"{value:.9g}") for value in row] for row in x]
            lines.append(f"            {name}={table[0] if len(table) == 1 else table},")
        lines.append("        ),")
    return lines


def _node(z: Array, at: float) -> int:
    return int(np.argmin(np.abs(z - at)))


def _stiffnesses(estimate: RotorEstimate, rig: Any, whirl: Array) -> dict[float, Complex]:
    """Return the dynamic stiffness of the bearings at whirl frequencies by speed, both in rad/s, (n, n_axes), with the
    controller of the records at each, or of the rig; empty where none is known.
    """
    from ambid.control.acceptance import dynamic_stiffness
    from ambid.control.closed import ClosedLoop
    from ambid.job.closed_loop import controller_of, plant_of, spectra_of
    from ambid.rotor.synchronous import separate

    found: dict[float, Complex] = {}
    rate, of, hz = float(str(estimate.record["rate_hz"])), estimate.plant, whirl / (2.0 * np.pi)
    for record, used in zip(estimate.records, estimate.used or (None,) * len(estimate.records), strict=True):
        speed = float(str(record["speed"])) if used is not None else estimate.speed
        spectra = None if used is None else spectra_of(separate(used, of, speed).record, of, speed)
        plant = plant_of(estimate, rate, speed)
        try:
            controller = controller_of(plant, rig, spectra)
        except EstimationError:
            continue
        stiffness = dynamic_stiffness(ClosedLoop(plant=plant, controller=controller, frequency_hz=hz))
        if controller.source == "rig":
            return {abs(estimate.speed): stiffness}
        found[abs(speed)] = stiffness
    return found


def write_mat(path: Path, content: Mapping[str, Any]) -> None:
    """Write a ``.mat`` file, version 5, whose header says that it comes from here and not when."""
    from scipy.io import savemat

    written = BytesIO()
    savemat(written, content, long_field_names=True, oned_as="column")
    path.write_bytes(MAT_HEADER.ljust(116) + written.getvalue()[116:])
