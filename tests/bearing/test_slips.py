"""Slips of commissioning: units, signs and columns that are not what the rig says are named, and sound records pass."""

import re
from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.columns import check_lag, lag_of, refuse_mistaken, refuse_silent, without_lag
from ambid.bearing.linear import Signals, greybox
from ambid.bearing.sizes import SIZES, check_units
from ambid.errors import EstimationError
from ambid.job import identify, simulate
from ambid.physics.linear_model import Parameter, model
from ambid.physics.loop import Noise
from ambid.physics.presets import preset
from ambid.record import Channel, Record
from ambid.rig import default_rig
from ambid.signals import excitation
from ambid.simulation import simulate_preset
from tests.bearing.benches import parameters, run
from tests.conventions.sources import ROOT

# m, k_x, k_i, R, L, and the largest voltage, current and travel: grams to tons, and the presets
BENCHES = {
    "micro": ((4e-3, -400.0, 0.8, 12.0, 2.4e-3), (2.6, 0.16, 49e-6)),
    "ball": ((0.06, -118.0, -1.24, 4.2, 0.117), (12.4, 1.11, 0.3e-3)),
    "thesis": ((0.1, 587.2, -310.1, 1.25, 59.6e-3), (3.9, 0.09, 0.77e-3)),
    "prototype": ((0.3, -6700.0, 20.1, 6.0, 0.06), (11.0, 0.9, 0.4e-3)),
    "pump": ((1.2, -6e4, 45.0, 3.0, 40e-3), (17.0, 0.4, 0.25e-3)),
    "bearing": ((4.0, -1.29e5, 55.7, 0.8, 13e-3), (16.7, 1.1, 0.25e-3)),
    "spindle": ((15.0, -2.5e6, 180.0, 1.2, 17e-3), (43.0, 5.0, 0.6e-3)),
    "compressor": ((400.0, -2e7, 600.0, 0.4, 25e-3), (166.0, 46.0, 0.5e-3)),
}
NAMES = ("m", "k_x", "k_i", "R", "L")
SLIPS = [(c, f) for c in ("voltage", "current", "position") for f in (1e3, 1e-3, 1e6, 1e-6)]


def signals(voltage, current, travel):
    """Two samples that reach these largest values."""
    return Signals(u=np.array([[voltage], [-voltage]]), y=np.array([[travel, current], [0.0, -current]]), rate_hz=1e4)


TIME = {"L": 1, "k_i": 1, "k_x": 1, "m": 3}  # powers of a time that is too long


def mistimed(name, factor):
    """Parameters and signals of a bench whose times are too long by a factor."""
    values, largest = BENCHES[name]
    found = {k: value * factor ** TIME.get(k, 0) for k, value in zip(NAMES, values, strict=True)}
    return found, replace(signals(*largest), rate_hz=1e4 / factor)


def slipped(name, channel, factor):
    """Parameters and signals of a bench as an identification gives them with one channel too large by a factor."""
    values, largest = BENCHES[name]
    s = dict.fromkeys(("voltage", "current", "position"), 1.0) | {channel: factor}
    v, i, x = s.values()
    power = v * i / x**2
    scale = {"m": power, "k_x": power, "k_i": v / x, "R": v / i, "L": v / i}
    return {k: value * scale[k] for k, value in zip(NAMES, values, strict=True)}, signals(
        *(a * b for a, b in zip(largest, s.values(), strict=True))
    )


@pytest.mark.parametrize("name", BENCHES)
def test_every_size_of_a_sound_bench_is_usual(name):
    assert check_units(*slipped_free(name, "voltage", 1.0)).passed


def slipped_free(name, channel, factor):
    values, seen = slipped(name, channel, factor)
    return values, (), seen


@pytest.mark.parametrize("name", BENCHES)
def test_a_slip_of_one_unit_is_named(name):
    for channel, factor in SLIPS:
        check = check_units(*slipped_free(name, channel, factor))
        assert not check.passed
        assert check.values[f"{channel}_factor"] == factor, (channel, factor, check.detail)
        assert next(iter(check.values)) == f"{channel}_factor"  # the most likely comes first
        assert f"channels.{channel}.gain" in check.detail


@pytest.mark.parametrize("name", BENCHES)
@pytest.mark.parametrize(("factor", "words"), [(1e3, "a rate in kHz read as Hz"), (1e-3, "times in s read as ms")])
def test_a_wrong_unit_of_time_is_named(name, factor, words):
    values, seen = mistimed(name, factor)
    check = check_units(values, (), seen)
    assert not check.passed
    assert check.values["time_factor"] == factor
    assert words in check.detail
    assert "give rate_hz" in check.detail


def test_a_rate_ten_times_wrong_is_named_where_a_mass_is_known():
    values, seen = mistimed("pump", 10.0)
    assert check_units(values, (), seen).passed
    weighed = Parameter(name="m", unit="kg", role="fixed", value=1.2)
    check = check_units(values, (weighed,), seen)
    assert check.values["time_factor"] == 10.0
    assert "the sampling rate is ten times what was said" in check.detail


def test_an_inductance_within_a_sample_is_no_size():
    values, seen = slipped("pump", "voltage", 1.0)
    assert check_units({**values, "L": 1e-12}, (), seen).passed
    assert not check_units({**values, "L": 1e-12}, (), replace(seen, rate_hz=1e15)).passed


COIL_SLIPS = [("voltage", 1e3), ("current", 1e3), ("voltage", 1e-3), ("current", 1e6)]


@pytest.mark.parametrize(("channel", "factor"), COIL_SLIPS)
def test_the_coil_alone_has_its_units_checked(channel, factor):
    R, L, s = 1.6, 1.8e-3, {"voltage": 1.0, "current": 1.0} | {channel: factor}
    seen = Signals(u=s["voltage"] * np.array([[5.0], [-5.0]]), y=s["current"] * np.array([[2.0], [-1.0]]), rate_hz=1e4)
    values = {"R": R * s["voltage"] / s["current"], "L": L * s["voltage"] / s["current"]}
    check = check_units(values, (), seen, model("coil"))
    assert not check.passed
    assert check.values[f"{channel}_factor"] == factor


@pytest.mark.parametrize(("channel", "factor"), [("current", 1e3), ("position", 1e3), ("time", 1e3)])
def test_the_rotor_alone_has_its_units_checked(channel, factor):
    s = dict.fromkeys(("current", "position", "time"), 1.0) | {channel: factor}
    i, x, t = s.values()
    seen = Signals(u=i * np.array([[1.0], [-1.0]]), y=x * np.array([[2e-4], [0.0]]), rate_hz=1e4 / t)
    values = {"m": 4.0, "k_x": -1.29e5 / t**2, "k_i": 55.7 * x / i / t**2}
    known = Parameter(name="m", unit="kg", role="fixed", value=4.0)
    assert check_units({"m": 4.0, "k_x": -1.29e5, "k_i": 55.7}, (known,), RMIT_SEEN, model("rotor")).passed
    check = check_units(values, (known,), seen, model("rotor"))
    assert check.values[f"{channel}_factor"] == factor


RMIT_SEEN = Signals(u=np.array([[1.0], [-1.0]]), y=np.array([[2e-4], [0.0]]), rate_hz=1e4)


@pytest.mark.parametrize("resistance", [0.8, 80.0])
def test_columns_are_not_called_swapped_against_their_means(resistance):
    """The fit after the change has 0.8 ohm: the changed record's mean voltage over mean current has to say so."""
    bench = run("bearing", 3000, 3)
    fit = greybox(bench.model, bench.signals, parameters(bench))
    swapped = bench.signals.y[:, ::-1] + np.array([1.0, 100.0 / resistance])
    signals = replace(bench.signals, u=bench.signals.u + 100.0, y=swapped)
    asked = (bench.model, signals, parameters(bench), 0.0, np.inf, lambda _: fit)
    if resistance < 1.0:
        with pytest.raises(EstimationError, match="are swapped"):
            refuse_mistaken(*asked)
    else:
        refuse_mistaken(*asked)


def test_a_coils_sign_and_order_are_named():
    bench = run("coil", 3000, 3)
    v, i = bench.signals.u, bench.signals.y
    swapped_both = replace(bench.signals, u=i, y=v)
    for changed, words in ((replace(bench.signals, u=-v), "'voltage' is reversed"), (swapped_both, "are swapped")):
        with pytest.raises(EstimationError, match=words):
            greybox(bench.model, changed, parameters(bench))
    with pytest.raises(EstimationError, match="channel 'current' is reversed"):  # a current of one sign tells which
        greybox(bench.model, replace(bench.signals, y=-i - 10.0 * i.std()), parameters(bench))


def test_a_known_mass_shows_a_slip_that_sizes_alone_do_not():
    values, _, seen = slipped_free("pump", "position", 1 / 0.0254)
    assert check_units(values, (), seen).passed
    weighed = Parameter(name="m", unit="kg", role="fixed", value=1.2)
    check = check_units(values, (weighed,), seen)
    assert "inches" in check.detail
    assert check.values["position_factor"] == 1 / 0.0254


def test_what_no_unit_explains_is_refused_only_where_it_is_impossible():
    values, _, seen = slipped_free("pump", "voltage", 1.0)
    odd = check_units({**values, "L": 50.0}, (), seen)
    assert odd.passed
    assert "no wrong unit of one channel explains it" in odd.detail
    assert not check_units({**values, "L": 5e4}, (), seen).passed


def test_sizes_scale_as_the_model_does():
    """The exponents of every size against the model: the same trajectory in other units."""
    theta = dict(zip(NAMES, BENCHES["pump"][0], strict=True))
    moved, _ = slipped("pump", "voltage", 2.0)
    for channel, s in (("voltage", (2.0, 1.0, 1.0)), ("current", (1.0, 2.0, 1.0)), ("position", (1.0, 1.0, 2.0))):
        moved, _ = slipped("pump", channel, 2.0)
        # m x'' = k_i i - k_x x and V = R i + L i' + k_i x' hold for x s_x, i s_i, V s_v with the moved parameters
        v, i, x = s
        assert moved["k_i"] / moved["m"] * i / x == pytest.approx(theta["k_i"] / theta["m"])
        assert moved["k_x"] / moved["m"] == pytest.approx(theta["k_x"] / theta["m"])
        for k, beside in (("R", i), ("L", i), ("k_i", x)):
            assert moved[k] * beside / v == pytest.approx(theta[k])
    late, _ = mistimed("pump", 2.0)
    # m x'' = k_i i - k_x x and V = R i + L i' + k_i x' hold for the same samples twice as long apart
    assert late["k_i"] / late["m"] * 4.0 == pytest.approx(theta["k_i"] / theta["m"])
    assert late["k_x"] / late["m"] * 4.0 == pytest.approx(theta["k_x"] / theta["m"])
    assert (late["L"] / 2.0, late["k_i"] / 2.0, late["R"]) == pytest.approx((theta["L"], theta["k_i"], theta["R"]))
    for size in SIZES:
        low, high = size.usual
        assert size.possible[0] < low < high < size.possible[1]


@pytest.mark.parametrize("name", ["thesis", "unstable-bearing", "rmit-axis", "levitated-ball", "prototype"])
def test_the_presets_lie_inside_the_usual_ranges(name):
    bench = preset(name)
    largest = signals(bench.limits.voltage[1], bench.limits.current[1], bench.limits.position[1])
    check = check_units(bench.parameters, (), largest)
    assert check.passed
    assert "all sizes" in check.detail


def reversed_voltage(s):
    return replace(s, u=-s.u)


def reversed_current(s):
    return replace(s, y=s.y * [1.0, -1.0])


def swapped(s):
    return replace(s, u=s.y[:, 1:], y=np.hstack([s.y[:, :1], s.u]))


def swapped_outputs(s):
    return replace(s, y=s.y[:, ::-1].copy())


def silent(role):
    def change(s):
        rng = np.random.default_rng(3)
        dead = 1e-3 * rng.standard_normal(len(s.u))
        y = s.y.copy()
        y[:, ("position", "current").index(role)] = dead
        return replace(s, y=y)

    return change


def twice(s):
    return replace(s, y=np.column_stack([2.0 * s.y[:, 1], s.y[:, 1]]))


def set_point(s):
    n = len(s.u)
    return replace(s, y=np.column_stack([1e-4 * np.sin(2 * np.pi * 7 * np.arange(n) / 2e4), s.y[:, 1]]))


MISTAKEN = [
    (reversed_voltage, "channel 'voltage' is reversed"),
    (reversed_current, "reversed (or 'current' is)"),
    (twice, "channels 'position' and 'current' hold the same signal"),
    (swapped, "channels 'voltage' and 'current' are swapped"),
    (set_point, "channel 'position' has no noise and is not moved by the others"),
    (swapped_outputs, "channels 'position' and 'current' are swapped"),
    (silent("current"), "channel 'current' is unrelated to voltage and position"),
    (silent("position"), "channel 'position' is unrelated to voltage and current"),
]


@pytest.mark.parametrize(("change", "words"), MISTAKEN, ids=[w for _, w in MISTAKEN])
def test_a_mistaken_column_is_named(change, words):
    bench = run("bearing", 6000, 11)
    with pytest.raises(EstimationError, match=re.escape(words)):
        greybox(bench.model, change(bench.signals), parameters(bench, fixed=("c",)))


def test_a_weak_or_spoiled_signal_is_still_a_signal():
    """A position 20 dB below its noise, and a current with glitches: what they hold is little, but not nothing."""
    bench, rng = run("bearing", 20_000, 11), np.random.default_rng(1)
    x, i = bench.signals.y.T
    noisy = replace(bench.signals, y=np.column_stack([x + 10.0 * x.std() * rng.standard_normal(len(x)), i]))
    spoiled = i.copy()
    spoiled[rng.integers(0, len(i), 6)] += 100.0 * i.std()
    for changed in (noisy, replace(bench.signals, y=np.column_stack([x, spoiled]))):
        refuse_silent(bench.model, changed)
    with pytest.raises(EstimationError, match="'position' is unrelated"):
        refuse_silent(bench.model, replace(noisy, y=np.column_stack([rng.standard_normal(len(x)), i])))


@pytest.mark.parametrize(("j", "role"), [(0, "position"), (1, "current")])
def test_a_channel_that_stands_still_where_the_record_is_busiest_is_unrelated(j, role):
    bench = run("bearing", 3000, 1)
    y = bench.signals.y.copy()
    y[:, j] = 0.0
    with pytest.raises(EstimationError, match=f"'{role}' is unrelated"):
        refuse_silent(bench.model, replace(bench.signals, y=y))


def late(role, samples):
    """One channel logged some samples later than the others."""

    def change(s):
        y = s.y.copy()
        column = ("position", "current").index(role)
        y[:, column] = np.concatenate([np.full(samples, y[0, column]), y[:-samples, column]])
        return replace(s, y=y)

    return change


@pytest.mark.parametrize("role", ["position", "current"])
def test_a_channel_that_lags_is_named_with_its_lag(role):
    bench = run("bearing", 6000, 11)
    with pytest.raises(EstimationError, match=rf"channel '{role}' lags behind .*channels\.{role}\.delay = 5"):
        greybox(bench.model, late(role, 5)(bench.signals), parameters(bench, fixed=("c",)))


def test_the_lag_is_measured_to_a_fraction_of_a_sample():
    for name in ("bearing", "thesis"):
        signals = run(name, 6000, 11).signals
        found = {n: lag_of(late("position", n)(signals) if n else signals) for n in (0, 1, 7)}
        for n, lag in found.items():
            assert lag.samples == pytest.approx(n, abs=max(0.1, 4 * lag.sd))
            assert lag.shown == (n > 0)
        assert lag_of(late("current", 2)(signals)).samples == pytest.approx(-2, abs=0.2)
        assert lag_of(without_lag(late("position", 7)(signals), found[7])).samples == pytest.approx(0, abs=0.2)


def test_the_lag_of_a_sound_record_is_within_what_is_said():
    """Over 24 sound records of half a second its root mean square is that of its standard deviation; none is named."""
    found = []
    for seed in range(24):
        record = simulate("unstable-bearing", duration=0.5, seed=seed)
        v, x, i = (record[role].values for role in ("voltage", "position", "current"))
        found.append(lag_of(Signals(u=v[:, None].copy(), y=np.column_stack([x, i]), rate_hz=record.rate_hz)))
    off = [lag.samples / lag.sd for lag in found if lag.share > 0.7]
    assert len(off) > 20
    assert 0.6 < np.sqrt(np.mean(np.square(off))) < 1.4
    assert not any(lag.shown for lag in found)


def test_motion_of_one_resonance_is_not_taken_for_a_lag():
    """Half of its period later the current explains as much with the other sign; the least lag is the one."""
    rate = 10_000.0
    flat = np.tile(excitation("schroeder", 5000, rate, amplitude=0.1, band=(2.0, 2000.0)), 4)
    u = flat + 0.05 * np.sin(2.0 * np.pi * 638.0 * np.arange(flat.size) / rate)
    noise = Noise(position=1e-5, current=1.5e-3)
    for seed in range(6):
        record = simulate_preset(preset("thesis"), u, seed=seed, closed=False, noise=noise).record
        v, x, i = (record[role].values for role in ("voltage", "position", "current"))
        found = lag_of(Signals(u=v[:, None], y=np.column_stack([x, i]), rate_hz=rate))
        assert abs(found.samples) < 0.5


def test_swapped_columns_are_not_taken_for_a_lag():
    record, rig = simulate("levitated-ball", duration=0.6, seed=1), default_rig()
    columns = {"voltage [V]": "current", "current [A]": "voltage", "position [m]": "position"}
    weighed = tuple(replace(p, value=0.077, role="fixed") if p.name == "m" else p for p in rig.parameters)
    with pytest.raises(EstimationError, match="'voltage' and 'current' are swapped"):
        identify(
            {name: record[role].values for name, role in columns.items()},
            replace(rig, parameters=weighed),
            rate_hz=record.rate_hz,
        )


def test_an_estimate_with_a_lag_of_one_sample_is_not_to_be_used():
    bench = run("bearing", 6000, 11)
    check = check_lag(late("position", 1)(bench.signals))
    assert not check.passed
    assert check.values["samples"] == pytest.approx(1, abs=0.2)
    assert "lags behind current by" in check.detail
    assert check_lag(bench.signals).passed
    still = replace(bench.signals, y=bench.signals.y * [0.0, 1.0])
    assert "too little" in check_lag(still).detail


@pytest.mark.parametrize(("name", "factor", "power"), [("m", 1e3, 3), ("R", 1e-3, -3)])
def test_a_value_of_the_rig_in_another_unit_is_named(name, factor, power):
    values, _, seen = slipped_free("pump", "voltage", 1.0)
    known = Parameter(name=name, unit="", role="fixed", value=factor * values[name])
    check = check_units(values, (known,), seen)
    assert not check.passed
    assert f"{name} = " in check.detail
    assert f"in the rig is about 10^{power} times the value from the data" in check.detail


def test_a_sign_is_named_in_a_long_record_too(monkeypatch):
    monkeypatch.setattr("ambid.bearing.multistart._REGRESSED", 3000)
    bench = run("bearing", 6000, 11)
    with pytest.raises(EstimationError, match="channel 'voltage' is reversed"):
        greybox(bench.model, reversed_voltage(bench.signals), parameters(bench, fixed=("c",)))
    assert greybox(bench.model, bench.signals, parameters(bench, fixed=("c",))).status == "converged"


def test_a_current_of_one_sign_says_which_channel_is_reversed():
    bench = run("bearing", 6000, 11)
    offset = bench.signals.y + np.array([0.0, 3.0 * np.ptp(bench.signals.y[:, 1])])
    changed = reversed_current(replace(bench.signals, y=offset))
    with pytest.raises(EstimationError, match=r"channel 'current' is reversed"):
        greybox(bench.model, changed, parameters(bench, fixed=("c",)))


@pytest.mark.parametrize("mass", ["free", "fixed"])
def test_an_estimate_names_a_current_in_another_unit(mass):
    bench = run("bearing", 6000, 11)
    v, (x, i) = bench.signals.u[:, 0], bench.signals.y.T
    columns = (("voltage", "V", v), ("current", "A", 1e3 * i), ("position", "m", x))
    record = Record(rate_hz=2e4, channels=tuple(Channel(name=n, unit=u, values=c) for n, u, c in columns))
    rig = replace(default_rig(), parameters=tuple(parameters(bench, fixed=("c", "m") if mass == "fixed" else ("c",))))
    check = identify(record, rig).checks["units"]
    assert not check.passed
    assert check.values["current_factor"] == 1e3
    assert "current is a thousand times too large (values in mA read as A)" in check.detail


def test_the_page_on_checks_lists_every_size_with_its_ranges_and_source():
    page = (ROOT / "docs" / "checks.md").read_text(encoding="utf-8")
    rows = {row.split(" [")[0].removeprefix("| "): row for row in page.splitlines() if row.startswith("| ")}
    for size in SIZES:
        cells = [cell.strip() for cell in rows[size.name].split("|")]
        low, high = (float(number) for number in cells[2].split(" … "))
        assert (low, high) == size.usual
        assert tuple(float(number) for number in cells[3].split(" … ")) == size.possible
        assert cells[4] == size.source
