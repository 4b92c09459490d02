"""ROSS: whirl frequencies of a rotor over its speed, by its own finite elements and its own eigenvalues.

Run: PYTHON peer_ross.py, see peer_child.py. The rotor comes as ``orders``: its elements, discs and bearings by node; u
are the speeds in rad/s.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import peer_child

MODES = 48  # eigenvalues asked for, those of torsion and of axial motion among them


def fit(structure: str, orders: dict[str, Any], mode: str, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """Return the lowest damped frequencies of lateral modes, (n_speeds, n_lines), rad/s."""
    import ross  # it writes to standard output, which `serve` has closed by now

    del structure, mode, y
    steel = ross.Material(name="steel", rho=orders["rho"], E=orders["E"], Poisson=orders["nu"])
    shaft = [
        ross.ShaftElement(L=e["length"], idl=e["bore"], odl=e["diameter"], material=steel) for e in orders["shaft"]
    ]
    discs = [ross.DiskElement(n=d["n"], m=d["m"], Id=d["Id"], Ip=d["Ip"]) for d in orders["discs"]]
    bearings = [
        ross.BearingElement(n=b["n"], kxx=b["k"][0], kyy=b["k"][1], cxx=b["c"][0], cyy=b["c"][1])
        for b in orders["bearings"]
    ]
    rotor = ross.Rotor(shaft, discs, bearings)
    return {"frequency": [_lateral(rotor, speed, orders["lines"]) for speed in u]}


def _lateral(rotor: Any, speed: float, lines: int) -> np.ndarray:
    modal = rotor.run_modal(float(speed), num_modes=MODES)
    values, vectors = np.asarray(modal.evalues), np.asarray(modal.evectors)
    n = vectors.shape[0] // 2
    size = np.abs(vectors[:n]) ** 2  # displacements; of each node x, y, z, alpha, beta, theta
    other = sum(size[k::6].sum(axis=0) for k in (2, 5)) / size.sum(axis=0)
    found = values.imag[(values.imag > 1.0) & (other < 0.5)]
    return np.sort(found)[:lines]


if __name__ == "__main__":
    peer_child.serve(fit)
