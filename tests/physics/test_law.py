"""A state-space law in place of the PID: the same loop written so is the same, in the file, in poles and in time."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ambid
from ambid.control.controller import controller_of_loop
from ambid.errors import ModelError, RigError
from ambid.physics.law import StateLaw, beside
from ambid.physics.loop import Limits, Loop, Noise
from ambid.rig import Rig, load_rig, rig_text
from ambid.rig.draft import rig_of_preset
from ambid.simulation.plant import closed_loop_poles


def as_law(rig: Rig) -> Rig:
    """Write the rig's PID as a law, on every axis."""
    assert rig.loop is not None
    assert rig.record.rate_hz is not None
    law = beside([rig.loop.as_law(rig.record.rate_hz)] * len(rig.plant.inputs))
    return replace(rig, loop=Loop(delay=rig.loop.delay, law=law))


@pytest.fixture(scope="module", params=["rmit-axis", "rmit"])
def pair(request: pytest.FixtureRequest) -> tuple[Rig, Rig]:
    rig = rig_of_preset(ambid.preset(request.param))
    return rig, as_law(rig)


def test_a_rig_holds_a_law_through_its_file(pair: tuple[Rig, Rig], tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(rig_text(pair[1], tmp_path))
    loop, back = pair[1].loop, load_rig(tmp_path / "rig.toml").loop
    assert loop is not None
    assert loop.law is not None
    assert back is not None
    assert back.law is not None
    for name in ("A", "B", "C", "D", "G", "rate_hz"):
        np.testing.assert_array_equal(getattr(back.law, name), getattr(loop.law, name))


def test_poles_and_response_are_those_of_the_pid(pair: tuple[Rig, Rig]) -> None:
    rig, law = pair
    assert rig.loop is not None
    assert law.loop is not None
    rate = float(rig.record.rate_hz or 0.0)
    theta = {p.name: float(p.value or 0.0) for p in rig.parameters}
    of, expected = rig.plant, None
    if all(p.name in theta for p in of.parameters):
        expected = closed_loop_poles(theta, rig.loop, rate, of=of)
        found = closed_loop_poles(theta, law.loop, rate, of=of)
        np.testing.assert_allclose(np.abs(found), np.abs(expected[: found.size]), atol=1e-7)
        np.testing.assert_allclose(expected[found.size :], 0.0, atol=1e-7)  # x[k-1] is no state of the law
    f = np.geomspace(1.0, 0.4 * rate, 20)
    responses = [controller_of_loop(x, of, rate).response(f)[0] for x in (rig.loop, law.loop)]
    np.testing.assert_allclose(responses[1], responses[0], rtol=1e-9)


def test_one_axis_levitates_alike() -> None:
    rig = replace(rig_of_preset(ambid.preset("rmit-axis")), noise=Noise(), limits=Limits())
    runs = [
        ambid.simulate(x, duration=0.1, seed=1, excitation="multisine", amplitude=1e-3, band=(5.0, 200.0))
        for x in (rig, as_law(rig))
    ]
    for c in runs[0].channels:
        np.testing.assert_allclose(runs[1][c.name].values, c.values, atol=1e-9 * float(np.ptp(c.values)))


def test_rotor_levitates_alike(pair: tuple[Rig, Rig]) -> None:
    runs = [
        ambid.simulate(replace(x, noise=Noise()), duration=0.05, seed=1, excitation="multisine", amplitude=1e-3)
        for x in pair
    ]
    for c in runs[0].channels:
        np.testing.assert_allclose(runs[1][c.name].values, c.values, atol=1e-9 * float(np.ptp(c.values)) + 1e-15)


def test_the_sign_of_a_law_is_that_of_kp_and_its_rate_that_of_the_rig(pair: tuple[Rig, Rig]) -> None:
    rig, law = pair
    assert rig.loop is not None
    assert law.loop is not None
    assert law.loop.pull * rig.loop.kp > 0.0
    assert law.loop.scaled(-1.0, 1.0).pull * rig.loop.kp < 0.0
    bare = replace(law, record=replace(law.record, rate_hz=None))
    assert bare.rate_hz == law.loop.law.rate_hz if law.loop.law else False


def test_a_limited_command_does_not_wind_the_law_up() -> None:
    integrator = StateLaw(A=[[1.0]], B=[[-0.5]], C=[[1.0]], D=[[0.0]], G=[[1.0]], rate_hz=1e3)  # type: ignore[arg-type]
    z, y, most = 0.0, -1.0, 2.0
    for _ in range(50):
        w = float(integrator.C[0, 0]) * z
        u = min(w, most)
        z = float(integrator.A[0, 0]) * z + float(integrator.B[0, 0]) * y + float(integrator.windup[0, 0]) * (u - w)
    assert z == pytest.approx(most + 0.5)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"B": [[1.0], [2.0]]}, r"loop.A has shape \(1, 1\)"),
        ({"A": [[np.nan]]}, "not finite"),
        ({"rate_hz": 0.0}, "positive"),
        ({"C": [1.0]}, "1 dimensions"),
    ],
)
def test_matrices_that_do_not_fit_are_refused(change: dict[str, object], match: str) -> None:
    given: dict[str, object] = {"A": [[0.5]], "B": [[1.0]], "C": [[1.0]], "D": [[0.0]], "rate_hz": 1e3}
    with pytest.raises(ModelError, match=match):
        StateLaw(**{**given, **change})  # type: ignore[arg-type]


def test_another_rate_or_plant_is_refused(pair: tuple[Rig, Rig]) -> None:
    rig = pair[1]
    with pytest.raises(ModelError, match="design it again"):
        controller_of_loop(rig.loop or Loop(), rig.plant, 1.1 * float(rig.record.rate_hz or 0.0))
    axis = as_law(rig_of_preset(ambid.preset("rmit-axis"))).loop or Loop()
    rotor = rig_of_preset(ambid.preset("rmit"))
    with pytest.raises(ModelError, match="4 inputs"):
        controller_of_loop(axis, rotor.plant, float((axis.law and axis.law.rate_hz) or 0.0))


def test_gains_and_matrices_exclude_each_other(tmp_path: Path) -> None:
    text = rig_text(rig_of_preset(ambid.preset("rmit-axis")), tmp_path)
    loop = text[text.index("[loop]") : text.index("limits", text.index("[loop]"))]
    law = '[loop]\nkind = "state-space"\nrate_hz = 1000\nA = [[0.5]]\nB = [[1, 0]]\nC = [[1]]\nD = [[-1, 0]]\n'
    for old, new, match in (
        ('kind = "pid"', 'kind = "pid"\nA = [[1.0]]', "of a state-space law"),
        ('kind = "pid"', 'kind = "state-space"', "has no loop.A"),
        (loop, law.replace("[[0.5]]", "[[0.5], [1.0, 2.0]]"), "loop.A is no matrix"),
        (loop, law + "G = [[1.0], [1.0, 2.0]]\n", "loop.G is no matrix"),
    ):
        (tmp_path / "rig.toml").write_text(text.replace(old, new))
        with pytest.raises(RigError, match=match):
            load_rig(tmp_path / "rig.toml")
