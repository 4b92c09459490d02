"""The frequency-domain job as a script calls it: what comes out is the simulated bearing, within its intervals."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import freqz, lfilter

from ambid.bearing.measured import model_responses
from ambid.errors import EstimationError
from ambid.job import frf
from ambid.physics.presets import preset
from ambid.record import Channel, Record, write_record
from ambid.rig import default_rig
from tests.job.loops import loop_record, odd_record

BEARING = preset("unstable-bearing")
FREE = ("m", "k_x", "k_i", "R", "L")
BOTH = {"input": "voltage", "output": ["position", "current"], "reference": "excitation"}
LATE = 1.0 / BEARING.rate_hz


@pytest.fixture(scope="module")
def record():
    return loop_record()


@pytest.fixture(scope="module")
def physical(record):
    return frf(record, reference="excitation", rig=default_rig())


def test_physical_parameters_of_a_levitated_bearing_lie_in_their_intervals(physical):
    assert physical.passed
    assert physical.estimate.delay.samples + physical.estimate.delay.fraction == pytest.approx(1.0, abs=0.02)
    for name in FREE:
        p = physical.estimate.parameter(name)
        assert abs(p.value - BEARING.parameters[name]) < 3.3 * p.sd, name
        assert p.sd < 0.02 * abs(p.value), name
    assert not any("biased" in w for w in physical.response.warnings)


def test_all_models_of_one_response_agree_within_their_uncertainty(record, physical):
    found = frf(record, **BOTH, orders={"nf": 3, "nb": 3}, delay=LATE)
    states = frf(record, **BOTH, state_space=3, delay=LATE)
    assert found.passed
    assert states.passed
    f = np.geomspace(6.0, 300.0, 40)
    (truth,), (rational,), (space,) = (model_responses(x, f) for x in (physical, found, states))
    for m in (rational, space):
        # in units of the spread of what has more coefficients: its standard deviation covers the difference
        z = np.log(m.G / truth.G)
        assert np.all(np.abs(z.real) < 4.0 * m.log_sd + 1e-6), m.source
        assert np.all(np.abs(z.imag) < 4.0 * m.phase_sd + 1e-6), m.source


@pytest.mark.parametrize("more", [
    {"state_space": 3, "delay": LATE}, {"state_space": 3, "delay": LATE, "domain": "z"},
    {"orders": {"nf": 4}}, {"orders": {"nf": 3, "nb": 1}, "domain": "s", "delay": LATE},
], ids=lambda x: "-".join(map(str, x)) + str(x.get("domain", "")))  # fmt: skip
def test_what_is_drawn_is_what_was_fitted(record, more):
    """The cost of a fit, computed from the response that its figure shows."""
    found = frf(record, **BOTH, band=(5.0, 400.0), **more)
    (m,) = model_responses(found, found.response.frequency_hz)
    e = (found.response.G - m.G).reshape(m.frequency_hz.size, -1, 1)
    cost = np.real(np.conj(np.swapaxes(e, 1, 2)) @ np.linalg.solve(found.response.covariance, e)).sum()
    assert cost == pytest.approx(found.fit.details["cost"], rel=1e-4)
    assert np.all(m.log_sd > 0)


def test_the_spread_of_a_sampled_state_space_is_that_of_the_discrete_one(record):
    f = np.geomspace(6.0, 300.0, 20)
    one, other = (model_responses(frf(record, **BOTH, state_space=3, delay=LATE, domain=d), f)[0] for d in "sz")
    np.testing.assert_allclose(one.G, other.G, rtol=1e-6)
    np.testing.assert_allclose(one.log_sd, other.log_sd, rtol=1e-3)
    np.testing.assert_allclose(one.phase_sd, other.phase_sd, rtol=1e-3)


def test_distortion_is_told_from_noise_where_lines_are_left_free():
    """A linear bearing shows none; the nonlinear one distorts more the harder it is driven."""
    sizes = []
    for made in (odd_record(nonlinear=False), odd_record(nonlinear=True, rms=1.5), odd_record(nonlinear=True, rms=3.0)):
        found = frf(made, **BOTH)
        assert found.distortion_sd is not None
        low = found.response.frequency_hz < 60
        variance = found.response.distortion_variance[low, 1, 0] / found.response.magnitude[low, 1, 0] ** 2
        noise = found.response.noise_sd[low, 1, 0] / found.response.magnitude[low, 1, 0]
        sizes.append(float(np.mean(variance) / np.mean(noise**2)))
    assert abs(sizes[0]) < 1.5
    assert sizes[2] > 4 * sizes[1] > 0


def test_a_file_and_its_record_give_the_same(record, physical, tmp_path):
    write_record(record, tmp_path / "loop.csv")
    found = frf(tmp_path / "loop.csv", reference="excitation", rig=default_rig())
    np.testing.assert_allclose(found.response.G, physical.response.G, rtol=1e-9)
    assert found.record["file"] == "loop.csv"


def test_the_rig_s_delay_and_fixed_values_are_obeyed(record):
    rig = default_rig()
    known = tuple(
        replace(p, role="fixed", value=BEARING.parameters["m"]) if p.name == "m" else p for p in rig.parameters
    )
    given = tuple(replace(c, delay=1) if c.role == "voltage" else c for c in rig.channels)
    found = frf(record, reference="excitation", rig=replace(rig, parameters=known, channels=given)).estimate
    assert found.delay.how == "given"
    assert found.parameter("m").value == BEARING.parameters["m"]
    assert found.parameter("m").sd == 0.0
    assert abs(found.parameter("k_i").value - BEARING.parameters["k_i"]) < 3.3 * found.parameter("k_i").sd


def test_an_operating_point_is_the_records_and_a_response_does_not_claim_it(record):
    found = frf(record, **BOTH, orders={"nf": 4})
    assert found.fit.offsets.y == pytest.approx([record["position"].values.mean(), record["current"].values.mean()])
    assert "do not" in found.fit.details["offsets"] or "does not" in found.fit.details["offsets"]


def test_several_inputs_and_a_direct_path_in_open_loop():
    rng, n, a = np.random.default_rng(1), 6000, [1.0, -1.6, 0.8]
    b = (([0.0, 0.5], [0.0, 0.2, 0.1]), ([0.3, 0.1], [0.0, 0.4]))
    u = rng.normal(size=(n, 2))
    y = np.stack([sum(lfilter(f, a, x) for f, x in zip(row, u.T, strict=True)) for row in b], axis=1)
    y += 0.05 * rng.normal(size=(n, 2))
    columns = {"u1": u[:, 0], "u2": u[:, 1], "y1": y[:, 0], "y2": y[:, 1]}
    made = Record(rate_hz=1000.0, channels=tuple(Channel(name=k, unit="V", values=v) for k, v in columns.items()))
    found = frf(made, input=["u1", "u2"], output=["y1", "y2"], open_loop=True, method="random",
                state_space=4, feedthrough=True, domain="z")  # fmt: skip
    assert found.response.method.startswith("H1")
    assert pytest.approx(np.array([[0.0, 0.0], [0.3, 0.0]]), abs=0.01) == found.fit.model.D
    w = np.linspace(0.02, 0.45, 30)
    (m,) = model_responses(found, 1000.0 * w)
    for j, k in np.ndindex(2, 2):
        truth = freqz(b[j][k], a, 2 * np.pi * w)[1]
        assert np.max(np.abs(m.G[:, j, k] - truth)) < 0.02 * np.max(np.abs(truth))


def test_a_constant_reference_is_refused(record):
    still = replace(record, channels=tuple(
        replace(c, values=np.ones(record.n_samples)) if c.name == "excitation" else c for c in record.channels
    ))  # fmt: skip
    with pytest.raises(EstimationError, match="constant"):
        frf(still, **BOTH)
