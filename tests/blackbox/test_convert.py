"""Conversion to python-control keeps the frequency response, delays included."""

from __future__ import annotations

import numpy as np
import pytest

from ambid.blackbox.model import PolynomialModel, Polynomials, StateSpaceModel, TransferModel
from ambid.blackbox.prediction import to_control
from ambid.errors import ModelError

control = pytest.importorskip("control", reason="python-control is an optional dependency (ambid[control])")

DT = 0.01
OMEGA = np.array([0.5, 3.0, 40.0, 250.0])


def _oe(*, inputs: int = 1, outputs: int = 1) -> PolynomialModel:
    p = Polynomials(
        A=[1, -0.2],
        B=tuple([0, 0, 0, 0.5 + i, 0.2] for i in range(inputs)),  # more delay than denominator
        C=[1.0],
        D=[1.0],
        F=tuple([1, -1.5, 0.7 + 0.1 * i] for i in range(inputs)),
    )
    return PolynomialModel(outputs=(p,) * outputs, dt=DT)


MODELS = {
    "polynomial": _oe(),
    "polynomial of 2 outputs and 3 inputs": _oe(inputs=3, outputs=2),
    "continuous transfer function": TransferModel(num=(([2.0, 1.0],),), den=(([1.0, 0.4, 9.0],),), dt=None),
    "discrete with delay": TransferModel(num=(([1.0],),), den=(([1.0, -0.5],),), dt=DT, delay=(3 * DT,)),
    "state space": StateSpaceModel(
        A=[[0.9, 0.1], [0, 0.5]], B=[[0, 1], [1, 0]], C=[[1, 0]], D=[[0, 0.1]], K=[[0.1], [0]], dt=DT
    ),
    "continuous state space": StateSpaceModel(
        A=[[0, 1], [4, 0]], B=[[0], [1]], C=[[1, 0]], D=[[0]], K=[[0], [0]], dt=None
    ),
}


@pytest.mark.parametrize("name", MODELS)
def test_control_has_the_same_response(name: str) -> None:
    model = MODELS[name]
    system = to_control(model)
    w = model.frequency_response(OMEGA)
    point = 1j * OMEGA if model.dt is None else np.exp(1j * OMEGA * DT)
    there = np.array([np.atleast_2d(system(z, squeeze=False)).reshape(w.shape[1:]) for z in point])
    np.testing.assert_allclose(there, w, rtol=1e-8, atol=1e-12)


def test_what_has_no_place_is_refused() -> None:
    late = TransferModel(num=(([1.0],),), den=(([1.0, 2.0],),), dt=None, delay=(0.1,))
    series = PolynomialModel(outputs=(Polynomials(A=[1, 0.5], B=(), C=[1.0], D=[1.0], F=()),), dt=DT)
    with pytest.raises(ModelError, match="delay"):
        to_control(late)
    with pytest.raises(ModelError, match="time series"):
        to_control(series)
