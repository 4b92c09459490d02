"""An identified plant as C source (C99, math.h alone, no allocation), with the delay of its inputs, and as FMU.

Position, current and voltage, of states, inputs, outputs and stops, count from the operating point.

A linear plant steps by exact zero-order-hold matrices of its parameters, a nonlinear magnet by the simulator's
Runge-Kutta steps and stops; code in ``data/plant_*.c``. An FMU (FMI 2.0 for co-simulation) holds source and this
machine's binary, byte by byte the same for the same estimate and compiler.
"""

from __future__ import annotations

import math
import platform
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from ambid.arrays import Array
from ambid.bearing.magnet_result import NonlinearBearingEstimate
from ambid.errors import AmbidError, EstimationError
from ambid.estimation.estimate import Estimate
from ambid.physics.law_magnet import BEARING_NUMBERS
from ambid.physics.linear_model import MASS, UNITS, C, ParameterSpec, R, model
from ambid.physics.loop import UNLIMITED, Interval
from ambid.physics.nonlinear import IDEAL
from ambid.rotor.estimate import RotorEstimate
from ambid.simulation.rig_bench import enough_steps, plant_of_law

ANY, _POSITIVE = -sys.float_info.max, sys.float_info.min  # least values of what may be anything, and must be positive
_FREE = 1e300  # where a stop is that there is none
_ABSENT = {"L_leak": 0.0, "L_rise": 0.0, "i_knee": 1.0, "sigma": 0.0, "i0": 0.0, "k_asym": 0.0, "i0_asym": 0.0,
           "v_offset": 0.0, "v_drop": 0.0, "i_drop": IDEAL.i_drop, "g": 0.0, "a": 0.0}  # fmt: skip
_ALWAYS = {"x_offset": 0.0, "i_offset": 0.0}
_SPECS = {spec.name: spec for spec in (*BEARING_NUMBERS, MASS, R, C)}
_MATRICES = {  # of `LinearModel.matrices`: entries of A, then of B with the columns of E behind
    "one-axis": {
        "A": {(0, 1): "1.0", (1, 0): "-p->k_x / p->m", (1, 1): "-p->c / p->m", (1, 2): "p->k_i / p->m",
              (2, 1): "-p->k_i / p->L", (2, 2): "-p->R / p->L"},
        "B": {(2, 0): "1.0 / p->L", (1, 1): "1.0 / p->m", (2, 2): "1.0 / p->L"},
    },
    "coil": {"A": {(0, 0): "-p->R / p->L"}, "B": {(0, 0): "1.0 / p->L", (0, 1): "1.0 / p->L"}},
    "rotor": {
        "A": {(0, 1): "1.0", (1, 0): "-p->k_x / p->m", (1, 1): "-p->c / p->m"},
        "B": {(1, 0): "p->k_i / p->m", (1, 1): "1.0 / p->m"},
    },
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """A parameter of the exported plant, SI: a member of the structure in C, a variable in an FMU."""

    name: str
    unit: str
    about: str
    value: float
    tunable: bool = True  # while it runs
    least: float = ANY  # physics allows nothing less


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlantSource:
    """What C source and FMU are made of; signals by name with their SI units."""

    numbers: tuple[Number, ...]  # delays last, one for each input
    states: Mapping[str, str]
    inputs: Mapping[str, str]
    disturbances: Mapping[str, str]
    outputs: Mapping[str, str]
    period: float  # of the record, s
    code: str  # what stands between the declarations and `plant_step`
    more: str  # further definitions and members
    members: str = ""


def source_of(result: Any, stops: Interval = UNLIMITED) -> PlantSource:
    """Return the plant of an estimate; `stops`: between which its rotor can move, m."""
    if isinstance(result, NonlinearBearingEstimate):
        return _of_magnet(result, stops)
    if isinstance(result, Estimate):
        return _of_axis(result, stops)
    if isinstance(result, RotorEstimate):
        return _of_rotor(result)
    raise EstimationError(
        f"{type(result).__name__} has no physical parameters; C source and FMU hold an estimate of 'ambid identify'. "
        "Give such an estimate, or a file ending in .mat or .py"
    )


def _of_axis(result: Estimate, stops: Interval) -> PlantSource:
    of, at = model(result.model), result.operating_point
    period, units = 1.0 / float(str(result.record["rate_hz"])), of.units
    numbers = [_number(s, result[s.name].value) for s in of.parameters]
    shown = dict.fromkeys([*of.outputs, *(s for s in of.states if s == "velocity")])
    rows = np.array([[float(s == o) for s in of.states] for o in shown])
    entries = _MATRICES[of.name]
    filled = [f"    {name}[{i}][{j}] = {text};" for name in "AB" for (i, j), text in entries[name].items()]
    late = result.delay[of.inputs[0]]
    return PlantSource(
        numbers=(*numbers, *_rests({role: at[role] for role in (*of.outputs, *of.inputs)}, of.states),
                 *_stops(stops, at.get("position") if "position" in of.states else None),
                 _delay("delay", (late.samples + late.fraction) * period)),
        states={s: units[s] for s in of.states}, inputs={r: units[r] for r in of.inputs},
        disturbances=_disturbances(of.disturbances), outputs={o: units[o] for o in shown}, period=period,
        code=_linear(filled, rows, _start_lines(of.states, of.outputs), stop="position" in of.states),
        more="", members=_KEPT,
    )  # fmt: skip


def _of_rotor(result: RotorEstimate) -> PlantSource:
    of, space, units = result.plant, result.plant.matrices(result.numbers), result.plant.units
    period = 1.0 / float(str(result.record["rate_hz"]))
    B = np.hstack([result.continuous.B, space.E])
    tables = [_table(name, x) for name, x in (("a", result.continuous.A), ("b", B))]
    filled = ["    (void)p;", "    memcpy(A, plant_a, sizeof plant_a);", "    memcpy(B, plant_b, sizeof plant_b);"]
    late = {r: result.delay[r].samples + result.delay[r].fraction if r in result.delay else 0.0 for r in of.inputs}
    code = _linear(filled, result.continuous.C, ["    (void)p, (void)x;"], stop=False)
    return PlantSource(
        numbers=tuple(_delay(f"{r}_delay", x * period) for r, x in late.items()),
        states={s: units[s] for s in of.states}, inputs={r: units[r] for r in of.inputs},
        disturbances={f"disturbing_{d}": units[d] for d in of.disturbances},
        outputs={o: units[o] for o in of.outputs}, period=period, code="\n".join([*tables, code]), more="",
        members=_KEPT,
    )  # fmt: skip


def _of_magnet(result: NonlinearBearingEstimate, stops: Interval) -> PlantSource:
    plant, rate = plant_of_law(result.law, result.values, eddy=result.eddy), float(str(result.records[0]["rate_hz"]))
    rest = plant.equilibrium(result.operating_point["position"])
    states = {s: UNITS[s] for s in ("position", "velocity", "current")} | ({"pull": "N"} if result.eddy else {})
    values = {**_ALWAYS, **result.values}
    numbers = [
        _number(replace(_SPECS[name], unit=unit), values[name])
        for name, unit in {**{p.name: p.unit for p in result.parameters}, "x_offset": "m", "i_offset": "A"}.items()
    ]
    strength, length = result.law.names[:2]
    named = {name: f"p->{name}" if name in values else repr(x) for name, x in _ABSENT.items()} | {
        "x_offset": "p->x_offset", "strength": f"p->{strength}", "length": f"p->{length}", "length_name": length,
    }  # fmt: skip
    return PlantSource(
        numbers=(*numbers, *_rests(rest_of(result), states), *_stops(stops, rest.position),
                 _delay("delay", (result.delay_samples(rate) or 0.0) / rate)),
        states=states, inputs={"voltage": "V"}, disturbances=_disturbances(("force", "voltage")),
        outputs={o: UNITS[o] for o in ("position", "current", "velocity")}, period=1.0 / rate,
        code="\n".join([*_begin(_start_lines(tuple(states), ("position", "current"))), *_stop(True), "", re.sub(
            r"@(\w+)@", lambda found: named[found[1]], read_data("plant_magnet.c"))]),
        more="\n".join([
            f"#define PLANT_PAIR {int(result.law.pair)}",
            f"#define PLANT_EXPONENTIAL {int(result.law.gap == 'exponential')}",
            f"#define PLANT_FOLLOWS {int(result.eddy)} /* whether the force lags behind the current */",
            f"#define PLANT_SUBSTEPS {enough_steps(plant, rest, rate)} /* Runge-Kutta steps in a sample */",
        ]),
    )  # fmt: skip


def rest_of(result: NonlinearBearingEstimate) -> dict[str, float]:
    """Return position, current and voltage, as measured, where the magnet holds its load at the mean position."""
    plant = plant_of_law(result.law, result.values, eddy=result.eddy)
    rest = plant.equilibrium(result.operating_point["position"])._asdict()
    return {**rest, "current": rest["current"] + result.values.get("i_offset", 0.0)}


def _number(of: ParameterSpec, value: float) -> Number:
    least = _POSITIVE if of.positive else 0.0 if of.name in ("sigma", "L_leak", "L_rise") else ANY
    return Number(name=of.name, unit=of.unit, about=of.meaning, value=value, least=least if value >= least else ANY)


def _rests(values: Mapping[str, float], states: Collection[str]) -> list[Number]:
    said = {"rest": "the operating point, from which it counts", "start": "where it starts, from the operating point"}
    kept = [("rest", values), ("start", {r: 0.0 for r in values if r in states})]
    return [
        Number(name=f"{r}_{what}", unit=UNITS[r], about=said[what], value=x, tunable=False)
        for what, of in kept for r, x in of.items()
    ]  # fmt: skip


def _stops(stops: Interval, rest: float | None) -> list[Number]:
    """Return the stops of a rotor that rests at a position; none of what does not move."""
    if rest is None:
        return []
    low, high = (math.copysign(_FREE, x) if math.isinf(x) else x - rest for x in stops)
    ends = {"position_low": ("lower", low), "position_high": ("upper", high)}
    return [Number(name=n, unit="m", about=f"{which} stop of the rotor", value=x) for n, (which, x) in ends.items()]


def _delay(name: str, value: float) -> Number:
    return Number(name=name, unit="s", about="by which the input acts late", value=value, least=0.0)


def _disturbances(names: Sequence[str]) -> dict[str, str]:
    return {f"disturbing_{name}": UNITS[name] for name in names}


def read_data(name: str) -> str:
    """Return the text of a file of the package."""
    return (files("ambid") / "data" / name).read_text(encoding="utf-8")


# --- text -----------------------------------------------------------------------------------------------------------

_KEPT = """    struct plant_transition {
        double length;
        struct plant_parameters p;
        double P[PLANT_STATES][PLANT_STATES], G[PLANT_STATES][PLANT_INPUTS + PLANT_DISTURBANCES];
    } kept[PLANT_KEPT];
    int oldest;
"""


def _start_lines(states: Sequence[str], measured: Collection[str]) -> list[str]:
    return [f"    x[{k}] = p->{name}_start;" for k, name in enumerate(states) if name in measured]


def _begin(lines: Sequence[str]) -> list[str]:
    """Return the function that writes the states in which the plant starts."""
    return ["static void plant_begin(const struct plant_parameters *p, double *x)", "{", *lines, "}", ""]


def _stop(moves: bool) -> list[str]:
    """Return the function that ends a movement at a stop."""
    ends = "(void)s;\n    return 0;" if not moves else (
        "double *x = s->x;\n\n    if (x[0] > s->p.position_low && x[0] < s->p.position_high)\n        return 0;\n"
        "    x[1] = x[0] >= s->p.position_high ? fmin(x[1], 0.0) : fmax(x[1], 0.0);\n"
        "    x[0] = x[0] >= s->p.position_high ? s->p.position_high : s->p.position_low;\n    return 1;"
    )  # fmt: skip
    return ["/* Whether the rotor touches a stop, which it does without rebound. */",
            "static int plant_stop(struct plant *s)", "{", f"    {ends}", "}"]  # fmt: skip


def _linear(filled: Sequence[str], rows: Array, start: Sequence[str], *, stop: bool) -> str:
    wide = "B[PLANT_STATES][PLANT_INPUTS + PLANT_DISTURBANCES]"
    return "\n".join([
        _table("C", rows), "", *_begin(start),
        f"static void plant_matrices(const struct plant_parameters *p, double A[PLANT_STATES][PLANT_STATES],\n"
        f"                           double {wide})", "{", *filled, "}", "", *_stop(stop), "",
        read_data("plant_linear.c"),
    ])  # fmt: skip


def _table(name: str, matrix: Array) -> str:
    rows = ",\n".join("    {" + ", ".join(map(repr, row)) + "}" for row in matrix.tolist())
    return f"static const double plant_{name}[{matrix.shape[0]}][{matrix.shape[1]}] = {{\n{rows},\n}};"


def declarations(of: PlantSource, about: Sequence[str]) -> str:
    """Return what a program that uses the plant has to know; `about`: lines of the comment that begins it."""
    own = [x for x in of.numbers if x.name.rpartition("_")[2] != "delay"]
    longest = max((x.value for x in of.numbers[len(own) :]), default=0.0)
    listed = {
        "x": of.states,
        "u": of.inputs,
        "d": of.disturbances,
        "y": of.outputs,
    }
    words = {key: ", ".join(f"{name} [{unit}]" for name, unit in names.items()) for key, names in listed.items()}
    sizes = {"STATES": len(of.states), "INPUTS": len(of.inputs), "DISTURBANCES": len(of.disturbances),
             "OUTPUTS": len(of.outputs), "HISTORY": 8 * math.ceil(longest / of.period) + 64,
             "KEPT": len(of.inputs) + 2}  # fmt: skip
    return "\n".join([
        f"/* {comment_text(about[0])}", *(f" * {comment_text(line)}" for line in about[1:]), " *",
        *(f" * {key}: {comment_text(text)}" for key, text in words.items()), " *",
        " * All in SI; position, current, voltage and the stops count from the operating point (what ends in _rest).",
        " * plant_reset once; then, each sample, plant_outputs, and plant_step with the inputs that the plant was just",
        " * given, the disturbances, and how long both are held (such as PLANT_PERIOD).",
        " * plant_step returns 1 where the rotor touched a stop, else 0, or one of the negative numbers below.", " */",
        "#ifndef PLANT_DECLARED", "#define PLANT_DECLARED", "", "#include <math.h>", "#include <string.h>", "",
        *(f"#define PLANT_{name} {n}" for name, n in sizes.items()),
        f"#define PLANT_PERIOD {of.period!r} /* s, of the record */",
        "#define PLANT_LOST (-1) /* the rotor left the air gap, or numbers are no longer finite: reset */",
        "#define PLANT_REFUSED (-2) /* no step, far too long a one, or too many changes within the delay */",
        *([of.more] if of.more else ["#define PLANT_FOLLOWS 0"]), "", "struct plant_parameters {",
        *(f"    double {x.name}; /* {x.unit}: {x.about} */" for x in own),
        "    double delay[PLANT_INPUTS]; /* s: by which each input acts late */", "};", "", "struct plant {",
        "    struct plant_parameters p; /* may be changed between steps */", "    double x[PLANT_STATES];",
        "    int known; /* changes of the inputs that still count, and how long ago each was */",
        "    double age[PLANT_HISTORY], past[PLANT_HISTORY][PLANT_INPUTS];", of.members + "};", "",
        "extern const struct plant_parameters plant_identified;",
        "void plant_reset(struct plant *s, const struct plant_parameters *p);",
        "void plant_outputs(const struct plant *s, double *y);",
        "int plant_step(struct plant *s, const double *u, const double *d, double length);",
        "void plant_derivative(const struct plant_parameters *p, const double *x, const double *u, const double *d,",
        "                      double *dx); /* x' with inputs that act at once */", "", "#endif", "",
    ])  # fmt: skip


def c_source(of: PlantSource, about: Sequence[str]) -> str:
    """Return the whole source, declarations first."""
    own = [x for x in of.numbers if x.name.rpartition("_")[2] != "delay"]
    late = ", ".join(repr(x.value) for x in of.numbers[len(own) :])
    return "\n".join([
        declarations(of, about), "const struct plant_parameters plant_identified = {",
        *(f"    {x.value!r}, /* {x.name} */" for x in own), f"    {{{late}}},", "};", "",
        of.code + read_data("plant_step.c"),
    ])  # fmt: skip


def prefixed(text: str, stem: str) -> str:
    """Return C source with a prefix of its own, so that one program may hold several plants; `stem`: of the file."""
    name = identifier(stem.lower(), 40)
    found = re.sub(r"\bplant_(?=\w)", f"{name}_", re.sub(r"\bPLANT_(?=\w)", f"{name.upper()}_", text))
    return re.sub(r"\bstruct plant\b", f"struct {name}", found)


MARK = "documentation/made-by-ambid.txt"
"""The first entry of each FMU, by which it is known as one of `ambid`."""

_DATE = (1980, 1, 1, 0, 0, 0)
_FLAGS = ("-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden")
_SECONDS = 120.0
_LONGEST = 60  # letters of an identifier
_WORDS = """
alignas alignof and asm auto bitand bitor bool break case catch char class compl concept const consteval constexpr
constinit continue decltype default delete do double else enum explicit export extern false float for friend goto if
i386 inline int linux long mutable namespace new noexcept not nullptr operator or private protected public register
requires restrict return short signed sizeof static struct switch template this throw true try typedef typeid typename
typeof union unix unsigned using virtual void volatile while xor
"""  # which can name no structure: keywords of C and C++, and what compilers define


def write_fmu(of: PlantSource, path: Path, name: str, about: Sequence[str]) -> None:
    """Write a plant; `name`: of the model, as the user gave it; `about`: lines that say what it is."""
    least = ", ".join(repr(x.least) for x in of.numbers)
    sources = {"plant.c": c_source(of, about), "fmi2.c": f"#define PLANT_LEAST {least}\n{read_data('fmi2.c')}"}
    of_model = identifier(name, _LONGEST)
    seen = sha256("\0".join([of_model, *sources.values()]).encode()).hexdigest()
    guid = "{" + "-".join(seen[a:b] for a, b in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32))) + "}"
    sources["fmi2.c"] = f'#define PLANT_GUID "{guid}"\n{sources["fmi2.c"]}'
    entries: dict[str, bytes] = {
        MARK: b"An identified plant, written by ambid.\n",
        "modelDescription.xml": model_description(of, name, of_model, guid, about).encode(),
        **{f"sources/{file}": text.encode() for file, text in sources.items()},
    }
    entries |= _binary(sources, of_model)
    with zipfile.ZipFile(path, "w") as made:
        for entry, content in entries.items():
            information = zipfile.ZipInfo(entry, _DATE)
            information.external_attr = (0o755 if entry.startswith("binaries") else 0o644) << 16
            information.create_system = 3
            plain = zipfile.ZIP_STORED if entry == MARK else zipfile.ZIP_DEFLATED
            made.writestr(information, content, plain)


def identifier(name: str, longest: int) -> str:
    """Return a name that C and file systems take, of what the user called the model."""
    kept = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:longest]
    return kept if kept[:1].isalpha() and kept not in _WORDS.split() else f"plant_{kept}".rstrip("_")


def _binary(sources: Mapping[str, str], of_model: str) -> dict[str, bytes]:
    """Compile the sources for this machine; nothing where there is no compiler, or it cannot."""
    compiler = next((found for found in map(shutil.which, ("cc", "gcc", "clang")) if found), None)
    if compiler is None:
        return {}
    system, ending = {"win32": ("win", ".dll"), "darwin": ("darwin", ".dylib")}.get(sys.platform, ("linux", ".so"))
    machine = platform.machine().lower()
    folder = f"{system}64" if machine in ("x86_64", "amd64") else f"{machine}-{system}"
    with TemporaryDirectory() as room:
        for file, text in sources.items():
            (Path(room) / file).write_text(text, encoding="utf-8")
        words = [compiler, *_FLAGS, "-o", "made", "fmi2.c", *(() if system == "win" else ("-lm",))]
        try:
            subprocess.run(words, cwd=room, check=True, capture_output=True, timeout=_SECONDS)
        except (OSError, subprocess.SubprocessError):
            return {}
        return {f"binaries/{folder}/{of_model}{ending}": (Path(room) / "made").read_bytes()}


def binaries(path: Path) -> tuple[str, ...]:
    """Return for which machines an FMU has a binary."""
    with zipfile.ZipFile(path) as made:
        return tuple(name.split("/")[1] for name in made.namelist() if name.startswith("binaries/"))


def model_description(of: PlantSource, name: str, of_model: str, guid: str, about: Sequence[str]) -> str:
    """Return modelDescription.xml: references count parameters, inputs and disturbances, outputs."""
    driven = {**{k: (unit, "from the operating point, late by its delay") for k, unit in of.inputs.items()},
              **{k: (unit, "disturbance, acts at once") for k, unit in of.disturbances.items()}}  # fmt: skip
    variables = [
        _variable(x.name, x.about, x.unit, f'causality="parameter" variability="{_WHEN[x.tunable]}" initial="exact"',
                  x.value, x.least) for x in of.numbers
    ]  # fmt: skip
    variables += [_variable(k, text, unit, 'causality="input" variability="continuous"', 0.0)
                  for k, (unit, text) in driven.items()]  # fmt: skip
    variables += [
        _variable(
            k, "from the operating point", unit, 'causality="output" variability="continuous" initial="calculated"'
        )
        for k, unit in of.outputs.items()
    ]
    if len({*(x.name for x in of.numbers), *driven, *of.outputs}) != len(variables):
        raise AmbidError("two signals of the rotor have one name, which an FMU cannot hold. Rename axes in the rig")
    units = sorted({x.unit for x in of.numbers} | {u for u, *_ in driven.values()} | set(of.outputs.values()))
    first = len(variables) - len(of.outputs) + 1
    unknown = "".join(f'<Unknown index="{k}"/>' for k in range(first, len(variables) + 1))
    counted = (line.format(k) for k, line in enumerate(variables))
    return "\n".join([
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="2.0" modelName={_quoted(name)} guid="{guid}"'
        f' description={_quoted(" ".join(about))} generationTool="ambid" variableNamingConvention="flat">',
        f'<CoSimulation modelIdentifier="{of_model}" canHandleVariableCommunicationStepSize="true"'
        ' canGetAndSetFMUstate="true" canSerializeFMUstate="true">',
        '<SourceFiles><File name="fmi2.c"/></SourceFiles>', "</CoSimulation>",
        "<UnitDefinitions>", *(f"<Unit name={_quoted(unit)}/>" for unit in units), "</UnitDefinitions>",
        f'<DefaultExperiment startTime="0" stopTime="1" stepSize="{of.period!r}"/>',
        "<ModelVariables>", *counted, "</ModelVariables>",
        f"<ModelStructure><Outputs>{unknown}</Outputs><InitialUnknowns>{unknown}</InitialUnknowns></ModelStructure>",
        "</fmiModelDescription>", "",
    ])  # fmt: skip


_WHEN = {True: "tunable", False: "fixed"}


def _variable(
    name: str, about: str, unit: str, kind: str, start: float | None = None, least: float = ANY
) -> str:  # fmt: skip
    """Return an entry of the variables, with a place for its number."""
    begins = ("" if least == ANY else f' min="{least!r}"') + ("" if start is None else f' start="{start!r}"')
    named = f"name={_quoted(name)} description={_quoted(about)}".replace("{", "{{").replace("}", "}}")
    return f'<ScalarVariable {named} valueReference="{{}}" {kind}><Real unit={_quoted(unit)}{begins}/></ScalarVariable>'


def _quoted(text: str) -> str:
    """Return an attribute's value; letters that XML cannot hold become spaces."""
    return quoteattr("".join(c if c.isprintable() else " " for c in text))


def comment_text(name: str) -> str:
    """Return a text, such as a name that somebody gave, that begins and ends no comment and no string."""
    text = "".join(c if c.isprintable() and c not in '"\\' else " " for c in name)
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").strip() or "a rig"
