"""An identified plant as FMU: FMI 2.0 for co-simulation, source and, by a C compiler, the binary for this machine.

The file is the same, byte by byte, for the same estimate (and the same compiler).
"""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from xml.sax.saxutils import quoteattr

from ambid.errors import AmbidError
from ambid.job.plant_source import ANY, PlantSource, c_source, read_data

MARK = "documentation/made-by-ambid.txt"
"""The first entry of each FMU, by which it is known as one of `ambid`."""

_DATE = (1980, 1, 1, 0, 0, 0)
_FLAGS = ("-std=c99", "-O2", "-shared", "-fPIC", "-fvisibility=hidden")
_SECONDS = 120.0
_LONGEST = 60  # letters of an identifier


def write_fmu(of: PlantSource, path: Path, name: str, about: Sequence[str]) -> None:
    """Write a plant; `name`: of the model, as the user gave it; `about`: lines that say what it is."""
    least = ", ".join(repr(x.least) for x in of.numbers)
    sources = {"plant.c": c_source(of, about), "fmi2.c": f"#define PLANT_LEAST {least}\n{read_data('fmi2.c')}"}
    identifier = _identifier(name)
    seen = sha256("\0".join([identifier, *sources.values()]).encode()).hexdigest()
    guid = "{" + "-".join(seen[a:b] for a, b in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32))) + "}"
    sources["fmi2.c"] = f'#define PLANT_GUID "{guid}"\n{sources["fmi2.c"]}'
    entries: dict[str, bytes] = {
        MARK: b"An identified plant, written by ambid.\n",
        "modelDescription.xml": model_description(of, name, identifier, guid, about).encode(),
        **{f"sources/{file}": text.encode() for file, text in sources.items()},
    }
    entries |= _binary(sources, identifier)
    with zipfile.ZipFile(path, "w") as made:
        for entry, content in entries.items():
            information = zipfile.ZipInfo(entry, _DATE)
            information.external_attr = (0o755 if entry.startswith("binaries") else 0o644) << 16
            information.create_system = 3
            plain = zipfile.ZIP_STORED if entry == MARK else zipfile.ZIP_DEFLATED
            made.writestr(information, content, plain)


def _identifier(name: str) -> str:
    """Return a name that C and file systems take, of what the user called the model."""
    kept = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:_LONGEST]
    return kept if kept[:1].isalpha() else f"plant_{kept}".rstrip("_")


def _binary(sources: Mapping[str, str], identifier: str) -> dict[str, bytes]:
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
        return {f"binaries/{folder}/{identifier}{ending}": (Path(room) / "made").read_bytes()}


def binaries(path: Path) -> tuple[str, ...]:
    """Return for which machines an FMU has a binary."""
    with zipfile.ZipFile(path) as made:
        return tuple(name.split("/")[1] for name in made.namelist() if name.startswith("binaries/"))


def model_description(of: PlantSource, name: str, identifier: str, guid: str, about: Sequence[str]) -> str:
    """Return modelDescription.xml: references count parameters, inputs and disturbances, outputs."""
    driven = {**{k: (unit, rest, "what acts on the plant, late by its delay") for k, (unit, rest) in of.inputs.items()},
              **{k: (unit, 0.0, "disturbance, acts at once") for k, unit in of.disturbances.items()}}  # fmt: skip
    variables = [
        _variable(x.name, x.about, x.unit, f'causality="parameter" variability="{_WHEN[x.tunable]}" initial="exact"',
                  x.value, x.least) for x in of.numbers
    ]  # fmt: skip
    variables += [_variable(k, text, unit, 'causality="input" variability="continuous"', start)
                  for k, (unit, start, text) in driven.items()]  # fmt: skip
    variables += [
        _variable(k, "of the plant", unit, 'causality="output" variability="continuous" initial="calculated"')
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
        f'<CoSimulation modelIdentifier="{identifier}" canHandleVariableCommunicationStepSize="true"'
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
