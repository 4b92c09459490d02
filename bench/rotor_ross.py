"""Finite elements of rotors: ambid's whirl frequencies beside those of ROSS, up to 20 000 1/min.

Both get the same drawing, ROSS cut where ambid cuts it; lateral modes, damped frequencies. Alone:
``python bench/rotor_ross.py``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from ambid.physics import Disc, Material, Shaft, Step, Support, campbell
from peers import Bench, bench
from table import Table
from timing import quantity

SPEEDS = np.linspace(0.0, 20_000.0, 11) * math.pi / 30
LINES, LIMIT_S = 10, 600.0


def rotors() -> dict[str, tuple[Shaft, list[Support]]]:
    """Drawings and bearings, by name; with the sources of those that are published."""
    book = Material(E=211e9, rho=7810.0, nu=211 / (2 * 81.2) - 1)
    steel = Material(E=2.11e11, rho=7810.0, nu=0.3)
    plain = Shaft(steps=(Step(length=1.5, diameter=0.05),), material=book)
    two = tuple(
        Disc.of_geometry(z=z, outer=d, inner=0.05, width=0.07, rho=7810.0) for z, d in ((0.5, 0.28), (1.0, 0.35))
    )
    three = tuple(
        Disc.of_geometry(z=z, outer=d, inner=0.1, width=w, rho=7800.0)
        for z, d, w in ((0.2, 0.24, 0.05), (0.5, 0.40, 0.05), (1.0, 0.40, 0.06))
    )
    sleeves = Shaft(
        steps=tuple(
            Step(length=length, diameter=d)
            for length, d in (
                (0.06, 0.022), (0.08, 0.036), (0.21, 0.026), (0.05, 0.040), (0.21, 0.026), (0.08, 0.036), (0.06, 0.022),
            )
        ),
        discs=(
            Disc(z=0.10, m=0.90, Id=6.0e-4, Ip=9.0e-4), Disc(z=0.375, m=2.40, Id=4.2e-3, Ip=8.0e-3),
            Disc(z=0.65, m=0.95, Id=6.3e-4, Ip=9.4e-4),
        ),
        material=steel,
    )  # fmt: skip
    hollow = Shaft(
        steps=(
            Step(length=0.1, diameter=0.04, bore=0.02), Step(length=0.25, diameter=0.06, bore=0.03),
            Step(length=0.1, diameter=0.03),
        ),
        discs=(Disc.of_geometry(z=0.45, outer=0.14, inner=0.03, width=0.02, rho=7810.0),),
        material=steel,
    )  # fmt: skip
    journal = {"stiffness": ((5e7, 0.0), (0.0, 7e7)), "damping": ((500.0, 0.0), (0.0, 700.0))}
    return {
        "two discs (Friswell 2010, 5.9.1)": (replace(plain, discs=two), _alike((0.0, 1.5), 1e6)),
        "overhung disc (Friswell 2010, 5.9.9)": (
            replace(plain, discs=(Disc.of_geometry(z=1.5, outer=0.35, inner=0.05, width=0.07, rho=7810.0),)),
            _alike((0.0, 1.0), 1e7),
        ),
        "three discs, unlike damped bearings (Lalanne and Ferraris 1998)": (
            Shaft(steps=(Step(length=1.3, diameter=0.1),), discs=three, material=Material(E=2e11, rho=7800.0)),
            [Support(z=z, **journal) for z in (0.0, 1.3)],
        ),
        "two sleeves and a disc, on magnets": (sleeves, _alike((0.10, 0.65), 1e6, 400.0)),
        "two sleeves and a disc, soft supports": (sleeves, _alike((0.10, 0.65), 1e4)),
        "hollow, stubby, overhung disc": (hollow, _alike((0.1, 0.35), 3e6)),
    }


def _alike(planes: tuple[float, ...], stiffness: float, damping: float = 0.0) -> list[Support]:
    return [Support(z=z, stiffness=stiffness, damping=damping) for z in planes]


def rotor_tables() -> Iterator[Table]:
    with bench() as opened:
        yield _table(opened)


def _table(opened: Bench) -> Table:
    rows, data = [], {}
    drawn = rotors()
    shaft, supports = next(iter(drawn.values()))
    opened.ask("ross", "campbell", _described(shaft, supports), SPEEDS[:1], SPEEDS[:1], limit_s=LIMIT_S)  # imports
    for name, (shaft, supports) in drawn.items():
        before = time.perf_counter()
        # more lines than are compared: some come down with speed
        ours = np.sort(campbell(shaft, SPEEDS, supports, lines=LINES + 6).frequency, axis=1)[:, :LINES]
        seconds = time.perf_counter() - before
        said = opened.ask("ross", "campbell", _described(shaft, supports), SPEEDS, SPEEDS, limit_s=LIMIT_S)
        if "problem" in said:
            rows.append((name, "–", "–", "–", quantity(seconds, "s"), said["problem"]))
            continue
        theirs = np.array(said["found"]["frequency"])
        off = np.abs(ours - theirs) / theirs
        data[name] = {"ambid_rad_s": ours.tolist(), "ross_rad_s": theirs.tolist()}
        data[name] |= {"ambid_s": seconds, "ross_s": said["seconds"]}
        span = f"{theirs[0, 0] / (2 * np.pi):.4g} … {theirs[0, -1] / (2 * np.pi):.4g} Hz"
        rows.append(
            (name, span, f"{100 * off[0].max():.2g} %", f"{100 * off.max():.2g} %", quantity(seconds, "s"),
             quantity(said["seconds"], "s"))
        )  # fmt: skip
    return Table(
        group="Rotors from drawings: whirl frequencies beside ROSS",
        columns=("rotor", "modes at rest", "apart at rest", "apart up to 20 000 1/min", "ambid", "ROSS"),
        rows=tuple(rows),
        before=(
            f"The lowest {LINES} damped frequencies of lateral modes at {SPEEDS.size} speeds: largest relative "
            "difference, and time for all speeds. Published rotors with their published bearings."
        ),
        data=data,
    )


def _described(shaft: Shaft, supports: list[Support]) -> dict[str, Any]:
    """The drawing for peer_ross.py: elements from node to node, discs and bearings at nodes."""
    z = shaft.free_rotor(1, planes=[s.z for s in supports]).z
    ends = np.cumsum([step.length for step in shaft.steps])
    elements = []
    for a, b in pairwise(z):
        step = shaft.steps[int(np.searchsorted(ends, (a + b) / 2))]
        elements.append({"length": b - a, "diameter": step.diameter, "bore": step.bore})

    def node(plane: float) -> int:
        return int(np.argmin(np.abs(z - plane)))

    def both(given: Any) -> list[float]:
        return [given, given] if isinstance(given, float) else [given[0][0], given[1][1]]

    m = shaft.material
    return {
        "E": m.E, "rho": m.rho, "nu": m.nu, "lines": LINES, "shaft": elements,
        "discs": [{"n": node(d.z), "m": d.m, "Id": d.Id, "Ip": d.Ip} for d in shaft.discs],
        "bearings": [{"n": node(s.z), "k": both(s.stiffness), "c": both(s.damping)} for s in supports],
    }  # fmt: skip


if __name__ == "__main__":
    for table in rotor_tables():
        print(table.as_markdown())
