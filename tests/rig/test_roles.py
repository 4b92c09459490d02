"""Which column is which role: by what the columns hold, beside their units and names."""

import numpy as np
import pytest

from ambid.physics.presets import preset
from ambid.record import Channel, Record, read_record
from ambid.rig import default_rig, draft_rig, load_rig
from ambid.rig.roles import close, rank_roles
from tests.bearing.benches import run
from tests.measured import ABSENT, MAGLEV

measured = pytest.mark.skipif(not MAGLEV.is_dir(), reason=ABSENT)


@pytest.fixture(scope="module")
def bench():
    found = run("bearing", 6000, 11)
    x, i = found.signals.y.T
    return {"voltage": ("V", found.signals.u[:, 0]), "current": ("A", i), "position": ("m", x)}


def of(**columns):
    return Record(rate_hz=2e4, channels=tuple(Channel(name=n, unit=u, values=c) for n, (u, c) in columns.items()))


def chosen(record):
    return {role: found[0].channel.name if found else None for role, found in rank_roles(record).items()}


def test_of_two_currents_the_one_of_the_coil_is_taken(bench):
    rng = np.random.default_rng(2)
    idle = ("A", 0.05 * rng.standard_normal(6000))
    other = ("A", np.cumsum(rng.standard_normal(6000)))  # a signal, but of another coil
    found = rank_roles(of(current_a=idle, current_b=other, current_c=bench["current"], coil_d=("A", np.zeros(6000)),
                          **{k: bench[k] for k in ("voltage", "position")}))  # fmt: skip
    names = [c.channel.name for c in found["current"]]
    assert names[0] == "current_c"
    assert not close(found["current"])
    why = {c.channel.name: c.why for c in found["current"]}
    assert "a coil model with voltage explains 100.0 % (R about 1.6 ohm, L about 0.026 H)" in why["current_c"]
    assert "no signal, noise alone" in why["current_a"] or "only" in why["current_a"]
    assert "never changes" in why["coil_d"]


def test_resistance_and_inductance_come_out_and_a_reversed_sign_is_told(bench):
    truth = dict(preset("unstable-bearing").parameters)
    why = rank_roles(of(**bench))["current"][0].why
    assert f"R about {truth['R']:.2g} ohm, L about {truth['L']:.2g} H" in why
    turned = of(**{**bench, "voltage": ("V", -bench["voltage"][1])})
    assert "one of the two reversed" in rank_roles(turned)["voltage"][0].why


def test_columns_without_units_and_names_are_told_by_what_they_do(bench):
    record = of(a=("1", bench["position"][1]), b=("1", bench["current"][1]), c=("1", bench["voltage"][1]))
    assert chosen(record) == {"voltage": "c", "current": "b", "position": "a"}
    assert 'column = "c"' in draft_rig(record)


def test_two_that_are_as_likely_are_close(bench):
    found = rank_roles(of(**bench, position_b=("m", bench["position"][1] * 1.01)))
    assert close(found["position"])
    assert not close(found["voltage"])


def test_a_plain_record_is_drafted_as_before(bench, rig_file):
    assert load_rig(rig_file(draft_rig(of(**bench)))).parameters == default_rig().parameters


@measured
@pytest.mark.parametrize("name", ["stairs_a", "stairs_b", "updown_c", "sine_d", "sine_e"])
def test_the_levitated_balls_coil_is_found_in_every_record(name, rig_file):
    found = load_rig(rig_file(draft_rig(read_record(MAGLEV / f"levitate_{name}.csv"))))
    assert found.model == "one-axis"
    assert [c.column for c in found.channels] == ["duty_upper", "position", "current_upper"]


@measured
@pytest.mark.parametrize("name", ["1", "2", "3", "4", "20mm"])
def test_a_rotor_that_is_held_makes_a_coil(name, rig_file):
    found = load_rig(rig_file(draft_rig(read_record(MAGLEV / f"coil_steps_{name}.csv"))))
    assert found.model == "coil"
    assert [c.column for c in found.channels] == ["duty_upper", "current_upper"]


def test_the_voltage_of_a_sensor_stands_behind_that_of_the_coil(bench):
    sensor = ("V", 1e4 * bench["position"][1])
    coil, others = bench["voltage"], {k: bench[k] for k in ("current", "position")}
    voltage = rank_roles(of(**{"sensor voltage": sensor, "coil voltage": coil, **others}))["voltage"]
    assert [(c.channel.name, c.named) for c in voltage] == [("coil voltage", 1.0), ("sensor voltage", 0.9)]
