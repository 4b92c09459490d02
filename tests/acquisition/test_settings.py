"""A rig in SI becomes whole numbers that do the same: the controller's law in counts, the loop's in volts."""

import math

import numpy as np
import pytest

from ambid.acquisition.protocol import table
from ambid.acquisition.scales import scale_of
from ambid.acquisition.settings import columns, controller_settings, in_si, realised, rest_of
from ambid.errors import DeviceError, RigError
from ambid.record.calibration import Calibration
from ambid.rig import Rig
from tests.acquisition.rigs import bench

TABLE = "counts [1],gap [mm]\n0,2\n200,1.2\n500,0.1\n600,-0.3\n1023,-2\n"


def falling_position() -> Rig:
    return bench(("gain = 2.44140625e-6\noffset = -1.25e-3", "gain = -2.44140625e-6\noffset = 1.25e-3"))


def falling_voltage() -> Rig:
    return bench(("gain = 0.03\noffset = -12.0", "gain = -0.03\noffset = 12.0"))


def from_a_table(tmp_path) -> Rig:
    (tmp_path / "gap.csv").write_text(TABLE)
    change = ("gain = 2.44140625e-6\noffset = -1.25e-3", 'table = "gap.csv"')
    return bench(change, path=tmp_path / "rig.toml")


def by_the_controller(s, x, i, excitation):
    """The control law of firmware/amb_daq/control.h in exact integers, unlimited."""
    integral = derivative = 0
    last, duty = x[0], []
    for position, current, added in zip(x.tolist(), i.tolist(), excitation.tolist(), strict=True):
        e = s.setpoint - position
        derivative = (s.pole * derivative >> 16) - s.kd * (position - last)
        last = position
        total = (
            4096 * (s.duty_bias + added) + s.kp * e + (integral >> 4) + derivative - s.kc * (current - s.current_rest)
        )
        duty.append(total / 4096)
        integral += s.ki * e
    return np.array(duty)


def by_the_loop(loop, rate_hz, x, i, rest):
    """The control law of ambid.physics.loop in SI, unlimited, without excitation."""
    period, tau = 1 / rate_hz, loop.filter_s
    integral = derivative = 0.0
    last, u = x[0], []
    for position, current in zip(x, i, strict=True):
        e = rest["position"] - position
        derivative = (tau * derivative - loop.kd * (position - last)) / (tau + period)
        last = position
        u.append(rest["voltage"] + loop.kp * e + integral + derivative - loop.kc * (current - rest["current"]))
        integral += loop.ki * period * e
    return np.array(u)


@pytest.mark.parametrize("which", ["straight", "falling position", "falling voltage", "table"])
def test_the_controller_does_what_the_loop_says(which, tmp_path):
    rig = {
        "straight": bench,
        "falling position": falling_position,
        "falling voltage": falling_voltage,
        "table": lambda: from_a_table(tmp_path),
    }[which]()
    s = controller_settings(rig)
    draw = np.random.default_rng(1)
    # within one piece of the table: 500 to 600 counts
    x = s.setpoint + draw.integers(-20, 21, 200)
    i = s.current_rest + draw.integers(-40, 41, 200)
    duty = by_the_controller(s, x, i, np.zeros(200, dtype=int))
    scales = {role: scale_of(rig, role) for role in ("position", "current", "voltage")}
    loop = realised(s, rig)
    rest = {
        "position": float(scales["position"].to_si(s.setpoint)),
        "current": float(scales["current"].to_si(s.current_rest)),
        "voltage": float(scales["voltage"].to_si(s.duty_bias)),
    }
    u = by_the_loop(loop, s.rate_hz, scales["position"].to_si(x), scales["current"].to_si(i), rest)
    np.testing.assert_allclose(duty, scales["voltage"].to_counts(u), atol=0.01)  # counts of up to a hundred
    assert np.ptp(duty) > 100
    wanted = by_the_loop(rig.loop, s.rate_hz, scales["position"].to_si(x), scales["current"].to_si(i), rest)
    np.testing.assert_allclose(u, wanted, atol=3e-3 * np.ptp(wanted))


def test_numbers_of_the_prototype_by_hand():
    s = controller_settings(bench())
    # 1 mm is 409.6 counts about 512, 90 % of it 368.64, rounded inwards; 1 A is 409.6 counts about 512
    assert (s.position_low, s.position_high) == (512 - 368, 512 + 368)
    assert (s.current_low, s.current_high) == (103, 921)
    assert (s.duty_low, s.duty_high, s.duty_off) == (20, 780, 400)  # 11.4 V of 12
    assert (s.setpoint, s.current_rest, s.duty_bias) == (512, 512, 400)
    assert (s.period, s.stream) == (10, 0b11011)
    assert s.kp == round(1.94e4 * 2.44140625e-6 / 0.03 * 4096)
    assert s.ki == round(7.85e4 / 2000 * 2.44140625e-6 / 0.03 * 65536)
    assert s.kc == round(33.8 * 2.44140625e-3 / 0.03 * 4096)
    tau = 1 / (2 * math.pi * 300)
    assert s.kd == round(92.6 / (tau + 5e-4) * 2.44140625e-6 / 0.03 * 4096)
    assert s.pole == round(tau / (tau + 5e-4) * 65536)


def test_settings_are_the_fields_of_the_messages():
    s = controller_settings(bench())
    for message in ("configure", "limits", "gains"):
        values = s.fields(message)
        names = [f.name for f in table().messages[message].fields if f.name != "id"]
        assert list(values) == names
        assert all(isinstance(v, int) for v in values.values())


def test_what_is_realised_is_near_what_was_wanted():
    rig = bench()
    loop = realised(controller_settings(rig), rig)
    for name in ("kp", "ki", "kd", "kc", "derivative_cutoff_hz"):
        assert getattr(loop, name) == pytest.approx(getattr(rig.loop, name), rel=3e-3), name
    assert loop.delay == pytest.approx(0.35)
    unfiltered = bench(("derivative_cutoff_hz = 300.0\n", ""))
    assert math.isinf(realised(controller_settings(unfiltered), unfiltered).derivative_cutoff_hz)


def test_rest_that_is_not_given_is_zero_and_its_voltage_follows_from_the_current():
    assert rest_of(bench()) == {"position": 0.0, "current": 0.0, "voltage": 0.0}
    current = ("[loop]", '[operating_point]\ncurrent = { value = 0.5, unit = "A" }\n[loop]')
    assert rest_of(bench(current)) == {"position": 0.0, "current": 0.5, "voltage": 3.0}
    s = controller_settings(bench(current))
    assert (s.current_rest, s.duty_bias) == (512 + 205, 500)


def test_columns_say_what_a_sample_carries():
    rig = bench(("[daq]\n", '[channels.reference]\ncolumn = "wanted"\n[daq]\nthird = "hall"\n'))
    s = controller_settings(rig)
    found = columns(rig, s)
    assert [c.name for c in found] == ["gap", "coil", "hall", "duty", "excitation", "wanted"]
    assert [c.role for c in found] == ["position", "current", "extra", "voltage", "excitation", "reference"]
    assert {c.unit for c in found} == {"1"}
    assert found[0].span == (0.0, 1023.0)
    assert found[3].span == (20.0, 780.0)
    assert [c.unit for c in columns(rig, s, si=True)] == ["m", "A", "1", "V", "V", "m"]
    assert columns(rig, s, si=True)[3].span == pytest.approx((-11.4, 11.4))


def test_counts_become_si_column_by_column():
    rig = bench()
    s = controller_settings(rig)
    values = in_si(rig, s, [[512, 512, 400, 0], [922, 922, 500, -10]])
    np.testing.assert_allclose(values, [[0.0, 0.0, 0.0, 0.0], [1.0009765625e-3, 1.0009765625, 3.0, -0.3]], atol=1e-12)


def test_the_third_input_is_scaled_where_it_is_a_channel():
    speed = '[channels.speed]\ncolumn = "tacho"\ngain = 0.5\n[daq]\nthird = "tacho"\n'
    rig = bench(("[daq]\n", speed))
    s = controller_settings(rig)
    assert columns(rig, s, si=True)[2].unit == "rad/s"
    assert in_si(rig, s, np.full((1, 5), 100.0))[0, 2] == 50.0


def test_a_coil_alone_has_no_position_and_no_loop():
    text = """schema = "ambid.rig/1"
model = "coil"
[channels.voltage]
gain = 0.03
offset = -12.0
[channels.current]
gain = 2.5e-3
offset = -1.28
[daq.trip]
current = 1.0
"""
    rig = bench(text=text)
    s = controller_settings(rig)
    assert (s.position_low, s.position_high, s.closed) == (0, 1023, False)
    assert [c.role for c in columns(rig, s)] == ["current", "voltage", "excitation"]
    assert [c.unit for c in columns(rig, s, si=True)] == ["A", "V", "V"]


def test_slow_ticks_only_sample():
    assert controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 1000.0"))).drives
    assert not controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 500.0"))).drives
    assert controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 2500.0"))).drives
    assert not controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 4000.0"))).drives


@pytest.mark.parametrize(
    ("sound", "changed", "words"),
    [
        ("[daq]\nrate_hz = 2000.0\n", "", "has no section [daq]"),
        (
            "gain = 0.03\noffset = -12.0",
            "",
            "channels.voltage has no calibration; the controller gives counts (0 to 800)",
        ),
        ("gain = 2.44140625e-6\noffset = -1.25e-3", "", "channels.position has no calibration"),
        ("gain = 2.44140625e-6\n", 'unit = "mV"\ngain = 1e-3\n', "channels.position is calibrated from [mV]"),
        ("gain = 2.44140625e-6\n", "", "channels.position is calibrated from [m]"),
        (
            "gain = 0.03\n",
            "gain = 24.0\n",
            "the loop needs at least 16. By channels.voltage, 0 to 800 counts are -12 to",
        ),
        ("[daq]\n", "[daq]\nduty = [0, 801]\n", "daq.duty is [0, 801]; a pulse width is 0 to 800 counts"),
        ("[daq]\n", "[daq]\nduty_off = 500\n", "daq.duty_off is 500 counts, 3 V by channels.voltage"),
        ("[daq]\n", "[daq]\nduty_off = 900\n", "daq.duty_off is 900; a pulse width is 0 to 800"),
        ("offset = -12.0", "offset = 1.0", "the pulse width nearest to 0 V is 0 counts, 1 V"),
        (", current = 1.0, position = 1e-3", "", "has neither daq.trip.current nor loop.limits.current"),
        (
            "current = 1.0,",
            "current = 1.3,",
            "the trip of current, -1.3 to 1.3, is not inside the range of the converter",
        ),
        ("position = 1e-3", "position = 2e-3", "the trip of position, -0.0018 to 0.0018, is not inside"),
        ("[daq]\n", '[operating_point]\nposition = { value = 1, unit = "mm" }\n[daq]\n', "position at rest is 0.001"),
        (
            "[daq]\n",
            '[operating_point]\nvoltage = { value = 12, unit = "V" }\n[daq]\n',
            "outside the pulse widths allowed",
        ),
        ("kp = 1.94e4", "kp = 1e10", "loop.kp is 3.333e+09 steps of the controller, whose limit is 524288:"),
        ("ki = 7.85e4", "ki = 500.0", "loop.ki is 1.3 steps of the controller, fewer than 3"),
        (
            "derivative_cutoff_hz = 300.0",
            "derivative_cutoff_hz = 1e-3",
            "loop.derivative_cutoff_hz is 0.001 Hz, too low",
        ),
        ("rate_hz = 2000.0", "rate_hz = 2000.0\nbaud = 115200", "exceed daq.baud = 115200 bit/s, which carries 655"),
    ],
)
def test_what_cannot_be_held_is_refused_in_one_line(sound, changed, words):
    with pytest.raises(RigError) as refused:
        controller_settings(bench((sound, changed)))
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_rotor_driven_by_a_current_is_refused():
    with pytest.raises(RigError, match="model 'rotor' is not a coil driven by a voltage"):
        controller_settings(bench(text='schema = "ambid.rig/1"\nmodel = "rotor"\n[daq]\n'))


def test_a_rate_without_a_tick_names_the_nearest():
    with pytest.raises(DeviceError, match=r"nearest rates: 2857\.142857 or 3333\.333333 Hz"):
        controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 3000.0")))
    assert controller_settings(bench(("rate_hz = 2000.0", "rate_hz = 3333.333333"))).period == 6


def test_a_table_that_rises_and_falls_is_refused(tmp_path):
    (tmp_path / "gap.csv").write_text("counts [1],gap [mm]\n0,-2\n600,2\n1023,1\n")
    with pytest.raises(RigError, match=r"channels\.position\.table is not monotonic"):
        controller_settings(
            bench(("gain = 2.44140625e-6\noffset = -1.25e-3", 'table = "gap.csv"'), path=tmp_path / "r.toml")
        )


def test_a_voltage_table_has_to_cover_the_pulse_widths(tmp_path):
    (tmp_path / "duty.csv").write_text("duty [1],voltage [V]\n0,-12\n600,6\n")
    change = ("gain = 0.03\noffset = -12.0", 'table = "duty.csv"')
    with pytest.raises(RigError, match=r"runs from 0 to 600 counts; the pulse width from 20 to 780"):
        controller_settings(bench(change, path=tmp_path / "r.toml"))


def test_a_current_sensor_of_one_sign_trips_on_that_side():
    unipolar = (
        ("gain = 2.44140625e-3\noffset = -1.25", "gain = 2.44140625e-3\noffset = 0.0"),
        ("gain = 0.03\noffset = -12.0", "gain = 0.015\noffset = 0.0"),
        ("voltage = 11.4, current = 1.0", "voltage = [0, 12], current = [-0.05, 2.0]"),
        ("[loop]", '[operating_point]\ncurrent = { value = 0.5, unit = "A" }\n[loop]'),
    )
    s = controller_settings(bench(*unipolar))
    assert (s.current_low, s.current_high) == (0, 819)
    assert (s.duty_low, s.duty_high, s.duty_off) == (0, 800, 0)


def test_scales_go_both_ways(tmp_path):
    for rig in (bench(), falling_position(), from_a_table(tmp_path)):
        scale = scale_of(rig, "position")
        counts = np.array([-10.0, 0.0, 150.0, 500.0, 550.0, 1023.0, 1100.0])
        np.testing.assert_allclose(scale.to_counts(scale.to_si(counts)), counts, atol=1e-9)
    bent = scale_of(from_a_table(tmp_path), "position")
    assert bent.slope(550) == pytest.approx(-4e-6)
    assert bent.slope(500) == pytest.approx(-(1.1e-3 / 300 + 4e-6) / 2)
    assert bent.slopes(210, 590) == pytest.approx((1.1e-3 / 300, 4e-6))


def test_a_scale_reads_counts_as_the_record_does(tmp_path):
    from ambid.record import Channel

    for rig in (bench(), from_a_table(tmp_path)):
        of = rig.channel("position").calibration
        assert isinstance(of, Calibration)
        counts = np.arange(0.0, 1024.0)
        read = of.apply(Channel(name="gap", unit=of.unit_in, values=counts))
        np.testing.assert_allclose(scale_of(rig, "position").to_si(counts), read.values, atol=1e-15)


def test_a_single_transistor_may_rest_without_any_pulse():
    """Its line through the pulses may miss 0 V at no pulse; that it is off there is no question of the line."""
    stage = (
        ("gain = 0.03\noffset = -12.0", "gain = 0.015\noffset = -0.66"),
        ("voltage = 11.4", "voltage = [0.0, 11.4]"),
    )
    assert controller_settings(bench(*stage)).duty_off == 44
    assert controller_settings(bench(*stage, ("[daq]\n", "[daq]\nduty_off = 0\n"))).duty_off == 0
    far = (("gain = 0.03\noffset = -12.0", "gain = 0.015\noffset = -3.0"), ("voltage = 11.4", "voltage = [0.0, 8.0]"))
    rig = bench(*far, ("[daq]\n", "[daq]\nduty_off = 0\n"))
    with pytest.raises(RigError, match=r"daq\.duty_off is 0 counts, -3 V"):
        controller_settings(rig)
