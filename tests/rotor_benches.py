"""Rotors of the independent simulator in ``shared/checks``, which is beside the checkout and not part of it.

Tests that need it skip where it is absent. `model_and_truth` puts its numbers under the names of `RotorModel`.
"""

from __future__ import annotations

import importlib.util
import sys
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from ambid.physics.rotor_model import Bearing, RotorModel
from tests.measured import RECORDS

DATUM = 0.2
"""Of the planes, from the centre of gravity, m."""


def _simulator() -> ModuleType | None:
    path = RECORDS.parent / "checks" / "rotor_truth.py"
    if not path.exists():
        return None
    spec = importlib.util.spec_from_file_location("rotor_truth", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["rotor_truth"] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    return module


truth: Any = _simulator()
needs_simulator = pytest.mark.skipif(truth is None, reason="the independent simulator ../shared/checks is not here")


def model_and_truth(name: str) -> tuple[RotorModel, dict[str, float]]:
    """Return the model of a bench of the independent simulator, and its numbers."""
    return model_of(truth.BENCHES[name])


def model_of(bench: Any) -> tuple[RotorModel, dict[str, float]]:
    """Return the model of a bench, and its numbers."""
    modal, eddy = truth.modal_of(bench), bool(np.isfinite(bench.eddy_pole_hz))
    n = modal.mass.size - 2
    bearings = tuple(
        Bearing(name=x, axes=(f"{x.lower()}x", f"{x.lower()}y"), z=DATUM + modal.bearing[j, 1],
                z_sensors=(DATUM + modal.sensor[j, 1],))
        for j, x in enumerate("AB")
    )  # fmt: skip
    speed = bench.rpm * 2 * np.pi / 60
    model = RotorModel(bearings=bearings, speed=speed, polar=speed > 0, extras=("a",) * eddy, n_modes=n)
    theta = {p.name: p.default for p in model.parameters if p.default is not None}
    theta |= {"m": modal.mass[0], "Id": modal.mass[1], "Ip": modal.gyro[1, 1], "z_cg": DATUM}
    theta |= {"a": 2 * np.pi * bench.eddy_pole_hz} if eddy else {}
    for j, axis in enumerate(truth.AXES):
        theta |= {f"{axis}.{q}": getattr(bench, q)[j] for q in ("k_i", "k_x", "R", "L")}
    for r in range(1, n + 1):
        theta |= {f"mode{r}.omega": modal.omega[r + 1], f"mode{r}.zeta": modal.zeta[r + 1]}
        for j, x in enumerate("AB"):
            theta |= {f"mode{r}.{x}.z": modal.bearing[j, r + 1], f"mode{r}.{x}.z_sensor": modal.sensor[j, r + 1]}
        theta |= {f"gyro.{s}{r}": modal.gyro[s + 1, r + 1] for s in range(r + 1)}
    return model, theta
