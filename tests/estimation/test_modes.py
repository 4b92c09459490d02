"""Modes as values: intervals and likeness of shapes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import block_diag

from ambid.errors import EstimationError
from ambid.estimation.estimate import plain_json, read_as
from ambid.estimation.modes import EstimatedNumber, Modal, Mode, mac, plant_modes


def mode(frequency, **shape):
    number = EstimatedNumber.of
    return Mode(
        frequency_hz=number(frequency, 0.1),
        damping=number(0.01, 0.001),
        shape={k: number(np.real(v), 0.01, size=1.0) for k, v in shape.items()},
        shape_quadrature={k: number(np.imag(v), 0.01, size=1.0) for k, v in shape.items()},
    )


def test_interval_and_what_the_data_show():
    x = EstimatedNumber.of(0.01, 0.004)
    assert x.ci95 == pytest.approx((0.01 - 1.96 * 0.004, 0.01 + 1.96 * 0.004), rel=1e-3)
    assert not x.identifiable
    assert EstimatedNumber.of(0.0, 0.004, size=1.0).identifiable
    assert not EstimatedNumber.of(1.0, np.inf).identifiable


def test_assurance_ignores_size_and_phase_and_sees_orthogonal_shapes():
    first = mode(10.0, a=1.0, b=0.5, c=-0.2)
    turned = mode(11.0, a=0.5j, b=0.25j, c=-0.1j)
    other = mode(12.0, a=0.5, b=-1.0, c=0.0)
    assert mac([first], [turned, other]) == pytest.approx(np.array([[1.0, 0.0]]), abs=1e-12)


def test_shapes_are_compared_on_outputs_of_the_same_name():
    assert mac([mode(1.0, a=1.0, b=1.0, x=9.0)], [mode(1.0, b=1.0, a=1.0, y=5.0)])[0, 0] == pytest.approx(1.0)
    with pytest.raises(EstimationError, match="share 1 outputs"):
        mac([mode(1.0, a=1.0, b=1.0)], [mode(1.0, a=1.0, c=1.0)])


def test_mode_is_written_and_read():
    found = mode(10.0, a=1.0, b=0.5 + 0.1j)
    written = plain_json(found)
    assert set(written["frequency_hz"]) == {"value", "sd", "ci95", "identifiable"}
    assert read_as(Mode, written) == found


def test_modes_of_a_plant_are_those_that_oscillate_in_the_band():
    blocks = [np.array([[0.0, 1.0], [-((2 * np.pi * f) ** 2), -2 * z * 2 * np.pi * f]]) for f, z in PLANT]
    A, C = block_diag(*blocks, [[-3.0]]), np.array([[1.0, 0, 1.0, 0, 1.0, 0, 1.0], [2.0, 0, -1.0, 0, 0, 0, 0]])
    found = plant_modes(A, C, ("a", "b"), (5.0, 100.0), 0.15)
    assert [m.frequency_hz.value for m in found] == pytest.approx([10.0, 40.0])
    assert [m.damping.value for m in found] == pytest.approx([0.01, 0.02])
    assert found[0].complex_shape == {"a": pytest.approx(0.5), "b": pytest.approx(1.0)}
    modal = Modal(
        status="converged", method="", modes=(mode(10.1, a=0.5, b=1.0),), checks={}, inputs=(), outputs=("a", "b", "i"),
        units={"a": "m", "b": "m", "i": "A"}, band_hz=(5.0, 100.0),
    )  # fmt: skip
    assert modal.beside(found).mac[0] == pytest.approx([1.0, 0.1], abs=1e-9)


PLANT = ((10.0, 0.01), (40.0, 0.02), (60.0, 0.4))  # Hz and damping; the last is none of vibration
