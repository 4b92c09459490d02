"""Rotors of an independent simulator with one thing wrong each, and what `ambid.identify` makes of them.

The simulator is a file with `BENCHES`, `simulate`, `plant` and `modal_of`, such as ``rotor_truth.py`` of the outside
checks. Slow elements before coils or forces are added to its plant; magnets that bend are those of the preset ``rmit``.
A rig holds what an engineer would know, and how well what is wrong is calibrated.

Alone: ``python bench/rotors.py SIMULATOR [--bench rigid,flexible] [--only hum,gain] [--seeds 3]``.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import lfilter

import ambid
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.record import read_record
from ambid.rig import rig_from_text, rig_of_preset

Array = NDArray[np.float64]
AXES, UNITS = ("ax", "ay", "bx", "by"), {"voltage": "V", "current": "A", "position": "m", "reference": "A"}
DATUM, FAR, TURN = 0.2, 4.0, 2 * math.pi
SHORTER = {"rigid": {"period": 0.25}, "flexible": {"periods": 4}}  # than the simulator's own


def _larger(x: Array, _: float) -> Array:
    return 1.01 * x


def _late(x: Array, rate: float) -> Array:
    pole = math.exp(-TURN * 2e3 / rate)
    return np.asarray(lfilter([1 - pole], [1, -pole], x, zi=[pole * x[0]])[0])


def _hum(*hertz: float) -> Callable[[Array, float], Array]:
    def humming(x: Array, rate: float) -> Array:
        waves = [np.sin(TURN * f / rate * np.arange(x.size) + k) for k, f in enumerate(hertz, 1)]
        return np.asarray(x + 0.05 * x.std() * np.sum(waves, axis=0))

    return humming


@dataclass(frozen=True, kw_only=True)
class Case:
    """What is wrong, the names under which it is right (none: nothing can be seen), and what the rig says."""

    causes: tuple[str, ...] = ()
    of: str = "no channel"  # end of the names of channels that are logged in another way
    logged: Callable[[Array, float], Array] = _larger  # of their values and the rate
    slow: tuple[str, float] | None = None  # "voltage" before a coil, "iron" before a force, Hz; no "back-EMF"
    planes: Mapping[str, float] = field(default_factory=dict)  # by how much the rig has them too large, m
    known: Mapping[str, str] = field(default_factory=dict)  # lines of the rig, by channel or bearing
    part: float = 1.0  # of the record that is kept
    lost: int = 0  # samples
    eddy: bool = False  # whether the rig asks for an eddy pole
    drive: str = "voltage"
    curved: bool = False


def _cases() -> dict[str, Case]:
    """Return the table; of ``X short`` there are no whole periods."""
    cases = {"sound": Case()}
    for q, word in (("current", "voltage"), ("voltage", "current"), ("position", "position")):
        names, said = (f"ax_{q}.gain", f"ax_{word}.gain"), {f"{a}_{q}": "gain_sd = 0.01" for a in AXES}
        cases[f"{q} gain 1 %"] = Case(causes=names, of=f"ax_{q}", known={f"ax_{q}": "gain_sd = 0.01"})
        cases[f"all {q} gains 1 %"] = Case(of=q, known=said)
    electric = ("currents.lag", "voltages.lag")
    for hertz in (1000.0, 2000.0):
        cases[f"amplifiers of {hertz:g} Hz"] = Case(causes=electric, slow=("voltage", hertz))
    cases["current filter 2 kHz"] = Case(causes=("ax_current.lag", "ax_voltage.lag"), of="ax_current", logged=_late)
    cases["current filters 2 kHz"] = Case(causes=electric, of="current", logged=_late)
    cases["position filter 2 kHz"] = Case(causes=("ax_position.lag",), of="ax_position", logged=_late)
    cases["position filters 2 kHz"] = Case(causes=("positions.lag", "eddy_pole"), of="position", logged=_late)
    together = {"A": 'z_sd = { value = 2, unit = "mm" }'}
    cases["bearing 2 mm off"] = Case(planes={"A.z": 2e-3, "A.z_sensor": 2e-3}, known=together)
    cases["plane 5 mm off"] = Case(causes=("A.z", "A.z_sensor"), planes={"A.z_sensor": 5e-3})
    cases["two planes 6 mm off"] = Case(causes=("planes",), planes={"A.z_sensor": 6e-3, "B.z": 6e-3})
    cases["hum in current"] = Case(causes=("line", "lines"), of="ax_current", logged=_hum(50.0))
    cases["two tones"] = Case(causes=("line", "lines"), of="ax_current", logged=_hum(50.0, 55.3))
    cases["tones off the lines"] = Case(causes=("line", "lines"), of="ax_position", logged=_hum(149.3, 152.6))
    cases["lost samples"] = Case(causes=("lost_samples",), lost=3)
    cases["current alone"] = Case(drive="current")
    cases["command in ampere"] = Case(drive="command", slow=("back-EMF", 0.0))
    cases["curvature"] = Case(causes=("curvature",), curved=True)
    for hertz in (20e3, 200e3):
        iron = {"slow": ("iron", hertz), "causes": ("eddy_pole", "solid_iron")}
        cases[f"solid iron {hertz / 1e3:g} kHz"] = Case(**iron)
        cases[f"solid iron {hertz / 1e3:g} kHz, a"] = Case(**iron, eddy=True)
    short = ("sound", "current gain 1 %", "position gain 1 %", "current filter 2 kHz", "position filter 2 kHz",
             "amplifiers of 2000 Hz", "plane 5 mm off", "bearing 2 mm off", "hum in current")  # fmt: skip
    return cases | {f"{name}, short": replace(cases[name], part=0.45) for name in short}


CASES = _cases()


def _iron(hertz: float) -> tuple[Array, Array]:
    """Return poles, the largest as good as none, and shares of 1/(1 + (s/w)^(1/2)), flux in solid iron."""
    poles, s = TURN * np.geomspace(0.3, 1e6, 20), 1j * TURN * np.geomspace(0.1, 1e4, 200)
    terms = np.vstack([poles / (s[:, None] + poles), 1e3 * np.ones(poles.size)])
    right = np.append(1 / (1 + np.sqrt(s / (TURN * hertz))), 1e3)
    return poles, nnls(np.vstack([terms.real, terms.imag]), np.append(right.real, right.imag))[0]


def _slowed(plant: tuple[Array, Array, Array], currents: Array, what: str, hertz: float) -> tuple[Array, ...]:
    """Return a plant whose coils or forces are driven through first-order elements, or whose coils see no motion."""
    A, B, C = plant
    if what == "back-EMF":
        A[currents, : currents[0]] = 0.0
        return A, B, C
    poles, shares = (np.array([TURN * hertz]), np.ones(1)) if what == "voltage" else _iron(hertz)
    n, k = A.shape[0], poles.size
    big, into = np.zeros((n + 4 * k,) * 2), np.zeros((n + 4 * k, B.shape[1]))
    big[4 * k :, 4 * k :], into[4 * k :] = A, B
    for j, current in enumerate(4 * k + currents):
        own = slice(j * k, (j + 1) * k)
        big[own, own] = -np.diag(poles)
        if what == "voltage":
            big[:, own] += np.outer(into[:, j], shares)
            into[own, j], into[4 * k :, j] = poles, 0.0
        else:
            forces = big[:, current].copy()
            forces[4 * k + currents] = 0.0
            big[:, current] -= forces
            big[:, own] += np.outer(forces, shares)
            big[own, current] = poles
    return big, into, np.hstack([np.zeros((8, 4 * k)), C])


@cache
def _simulated(module: Any, name: str, slow: tuple[str, float] | None, seed: int) -> Mapping[str, Array]:
    bench, plain = replace(module.BENCHES[name], **SHORTER.get(name, {})), module.plant
    if slow is not None:
        currents = 4 * module.modal_of(bench).mass.size + np.arange(4)
        module.plant = lambda b: _slowed(plain(b), currents, *slow)
    done = module.simulate(bench, seed)
    module.plant = plain
    columns = {f"{axis}_{q}": done[q][:, j] for q in UNITS for j, axis in enumerate(AXES)}
    return columns | {f"{axis}_command": columns[f"{axis}_voltage"] for axis in AXES}


def record_of(module: Any, name: str, case: Case, seed: int) -> tuple[Any, Any, dict[str, float]]:
    """Return record, rig and truth."""
    if case.curved:
        return _curved(seed)
    bench, modal = module.BENCHES[name], module.modal_of(module.BENCHES[name])
    columns = dict(_simulated(module, name, case.slow, seed))
    inputs = {"voltage": ("voltage", "current"), "current": ("current",), "command": ("command",)}[case.drive]
    wanted = [f"{axis}_{q}" for q in (*inputs, "position", "reference") for axis in AXES]
    size = round(case.part * columns["ax_current"].size)
    kept = np.delete(np.arange(size), slice(int(0.8 * size), int(0.8 * size) + case.lost))
    logged = {c: case.logged(columns[c], bench.rate) if c.endswith(case.of) else columns[c] for c in wanted}
    record = read_record(
        {c: x[kept] for c, x in logged.items()}, rate_hz=bench.rate, units={c: UNITS.get(c[3:], "A") for c in wanted}
    )
    truth = {"m": modal.mass[0], "Id": modal.mass[1], "z_cg": DATUM}
    truth |= {f"{a}.{q}": getattr(bench, q)[j] for q in ("k_i", "k_x", "R", "L") for j, a in enumerate(AXES)}
    truth |= {f"{a}.amplifier_pole": bench.R[j] / bench.L[j] for j, a in enumerate(AXES)}
    truth |= {f"mode{r}": w / TURN for r, w in enumerate(modal.omega[2:], 1)}
    return record, rig_from_text(_rig(case, bench, modal, inputs, truth), "rig.toml"), truth


def _rig(case: Case, bench: Any, modal: Any, inputs: Sequence[str], truth: Mapping[str, float]) -> str:
    text = ['schema = "ambid.rig/1"', 'name = "rotors"', 'model = "rotor"']
    for j, b in enumerate("AB"):
        planes = {"z": modal.bearing[j, 1], "z_sensor": modal.sensor[j, 1]}
        text += [f"[bearings.{b}]", f'axes = ["{b.lower()}x", "{b.lower()}y"]', case.known.get(b, "")]
        at = {key: 1e3 * (DATUM + z + case.planes.get(f"{b}.{key}", 0.0)) for key, z in planes.items()}
        text += [f'{key} = {{ value = {z:.6f}, unit = "mm" }}' for key, z in at.items()]
    for role in (f"{axis}_{q}" for axis in AXES for q in (*inputs, "position", "reference")):
        text += [f"[channels.{role}]", f'column = "{role}"', case.known.get(role, "")]
    weighed = "" if case.drive == "voltage" else f', role = "fixed", value = {float(truth["m"])!r}'
    text += ["[parameters]", f'm = {{ unit = "kg"{weighed} }}', 'Id = { unit = "kg m^2" }', 'z_cg = { unit = "mm" }']
    text += ['a = { unit = "rad/s" }'] * case.eddy
    units = {"k_i": "N/A", "k_x": "N/m"} | ({"R": "ohm", "L": "H"} if case.drive == "voltage" else {})
    text += [f'"{axis}.{q}" = {{ unit = "{unit}" }}' for axis in AXES for q, unit in units.items()]
    if case.drive == "command":
        gain = '"{}.amplifier_gain" = {{ unit = "A/V", role = "fixed", value = {!r} }}'
        text += [gain.format(axis, 1 / R) for axis, R in zip(AXES, bench.R, strict=True)]
        pole = '"{}.amplifier_pole" = {{ unit = "rad/s", value = {!r} }}'  # as a data sheet has it
        text += [pole.format(axis, 1.2 * R / L) for axis, R, L in zip(AXES, bench.R, bench.L, strict=True)]
    return "\n".join(text) + "\n"


def _curved(seed: int) -> tuple[Any, Any, dict[str, float]]:
    """Magnets driven to a tenth of the gap."""
    rig = rig_of_preset(preset("rmit"))
    record = ambid.simulate(
        rig, nonlinear=True, amplitude=10.0, seed=seed, duration=1.0, periods=4, excitation="zippered",
        band=(4.0, 500.0),
    )  # fmt: skip
    assert rig.rotor is not None
    free = tuple(p if p.name in rig.rotor.places else Parameter(name=p.name, unit=p.unit) for p in rig.parameters)
    return record, replace(rig, parameters=free), {p.name: float(p.value or 0.0) for p in rig.parameters}


def judged(module: Any, bench: str, name: str, seed: int) -> dict[str, Any]:
    """Return one row: what ambid says, and how far the numbers that it calls identified are from the truth."""
    case, began = CASES[name], time.perf_counter()
    record, rig, truth = record_of(module, bench, case, seed)
    row: dict[str, Any] = {"bench": bench, "case": name, "seed": seed, "named": [], "checks": []}
    try:
        found: Any = ambid.identify(record, rig)
    except ambid.AmbidError as refusal:
        row |= {"word": "refused", "right": "general", "checks": [str(refusal)]}
        return row | {"worst": 0.0, "of": "-", "seconds": time.perf_counter() - began}
    stated = {p.name: (p.value, p.sd_calibrated or p.sd) for p in found.parameters if p.identifiable and p.sd}
    for f in (m.frequency_hz for m in found.modes if m.identifiable):  # beside the nearest true one
        true = min((n for n in truth if n.startswith("mode")), key=lambda n: abs(truth[n] - f.value), default="")
        stated[true or f"mode of {f.value:.4g} Hz"] = (f.value, f.sd)
    z = {n: abs(x - truth[n]) / sd if n in truth else math.inf for n, (x, sd) in stated.items() if n != "a"}
    row["of"], row["worst"] = max(z.items(), key=lambda item: item[1], default=("-", 0.0))
    failed = {k: c for k, c in found.checks.items() if not c.passed}
    row["checks"] = list(failed)
    row["named"] = [x for c in failed.values() if c.cause for x in (c.cause, *c.alternatives)]
    row["named"] += ["lines"] * any("lines were taken out" in w for w in found.warnings)
    bent = found.checks.get("curvature")
    row["named"] += ["curvature"] * (bent is not None and "the intervals hold it" in str(bent.detail))
    row |= {"word": found.verdict.word, "seconds": time.perf_counter() - began}
    right = "right" if set(row["named"]) & set(case.causes) else "wrong" if row["named"] else "general"
    return row | {"right": "silent" if right == "general" and row["word"] == "usable" else right}


def main() -> None:
    """Judge what is asked for: a row each, and the totals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("simulator", type=Path)
    parser.add_argument("--bench", default="rigid,flexible")
    parser.add_argument("--only", default="", help="cases by parts of their names, separated by commas")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=1)
    asked, rows = parser.parse_args(), list[dict[str, Any]]()
    sys.path.append(str(asked.simulator.parent))
    module = importlib.import_module(asked.simulator.stem)
    print("bench, case, seed, verdict, cause, worst |z|, of, seconds, causes with alternatives | failed checks")
    names = [n for n in CASES if any(part in n for part in asked.only.split(","))]
    seeds = range(asked.first, asked.first + asked.seeds)
    for seed, bench, name in product(seeds, asked.bench.split(","), names):
        rows.append(judged(module, bench, name, seed))
        print("{bench:8} {case:28} {seed} {word:8} {right:7}".format_map(rows[-1]), end=" ")
        print("{worst:6.1f} {of:7} {seconds:5.1f} s  {named} | {checks}".format_map(rows[-1]), flush=True)
    wrong = [r for r in rows if CASES[r["case"]].causes]
    counts = {word: sum(r["right"] == word for r in wrong) for word in ("right", "wrong", "general", "silent")}
    print(f"{len(rows)} cases; of {len(wrong)} with a cause: {counts}")
    print(f"named without a cause that shows: {sum(r['right'] == 'wrong' for r in rows if r not in wrong)}")
    print(f"usable beyond {FAR:g} sd: {sum(r['word'] == 'usable' and r['worst'] > FAR for r in rows)}")


if __name__ == "__main__":
    main()
