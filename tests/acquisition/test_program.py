"""Excitations are played as the protocol defines them, lie in the band asked for, and are refused with the nearest."""

from dataclasses import dataclass

import numpy as np
import pytest

from ambid.acquisition.device import Program
from ambid.acquisition.program import MASKS, amplitude_counts, elements_of, expected, period_ticks, program
from ambid.errors import DeviceError
from ambid.signals.excitations import crest_factor
from tests.acquisition.rigs import bench

RATE = 2000.0


def made(name, **options):
    settings = {"amplitude_v": 2.0, "rate_hz": RATE, "seconds": 20.0, "seed": 1, **options}
    return program(name, **settings)


@dataclass
class Content:
    """What is in one period of an excitation as it is really played."""

    rms_v: float
    peak_v: float
    frequency_hz: np.ndarray  # of the lines up to half the rate, without 0
    line_v: np.ndarray  # peak of each

    def share(self, band):
        """Return the share of the power that lies in a band, ends included."""
        inside = (self.frequency_hz >= band[0] * (1 - 1e-9)) & (self.frequency_hz <= band[1] * (1 + 1e-9))
        power = self.line_v**2
        return power[inside].sum() / power.sum()


def played(p, rate_hz, *, counts=None, volts_per_count=1.0):
    """Return what is in one period; with `counts` as amplitude, rounded to counts."""
    period = period_ticks(p)
    x = expected(p, period, counts=counts) * (1.0 if counts is None else volts_per_count)
    lines = np.fft.rfft(x) / period
    size = 2.0 * np.abs(lines[1:])
    if period % 2 == 0:
        size[-1] /= 2.0
    frequency_hz = np.arange(1, lines.size) * rate_hz / period
    return Content(float(np.sqrt(np.mean(x**2))), float(np.abs(x).max()), frequency_hz, size)


@pytest.mark.parametrize("bits", sorted(MASKS))
def test_every_register_runs_through_all_its_states(bits):
    x = elements_of(Program(kind="prbs", amplitude=1.0, length=bits, seed=1))
    n = 2**bits - 1
    assert x.size == n
    assert x.sum() == 1.0  # one more + than -
    assert np.unique(x).tolist() == [-1.0, 1.0]
    # periodic autocorrelation of two values: n, and -1 at every other lag
    spectrum = np.abs(np.fft.fft(x)) ** 2
    np.testing.assert_allclose(spectrum[1:], n + 1.0, rtol=1e-9 * n)
    assert len({x[k : k + bits].tobytes() for k in range(n - bits + 1)}) == n - bits + 1


def test_a_register_is_shifted_as_the_protocol_says():
    # n = 4, mask 0x3, from 0b0001: bit 0 of 1, 8, 4, 2, 9, 12, 6, 11, 5, 10, 13, 14, 15, 7, 3
    bits = [1, 0, 0, 0, 1, 0, 0, 1, 1, 0, 1, 0, 1, 1, 1]
    wanted = [1.0 if b else -1.0 for b in bits]
    assert elements_of(Program(kind="prbs", length=4, seed=1)).tolist() == wanted
    assert elements_of(Program(kind="prbs", length=4, seed=0x31)).tolist() == wanted  # the lower bits only
    for bad in (Program(kind="prbs", length=4, seed=0x30), Program(kind="prbs", length=16, seed=1)):
        with pytest.raises(DeviceError, match="Give another length or seed"):
            elements_of(bad)


def test_a_square_wave_begins_with_plus_and_ends_after_its_cycles():
    p = Program(kind="step", amplitude=3.0, hold=2, length=2, cycles=1)
    assert expected(p, 7).tolist() == [3.0, 3.0, -3.0, -3.0, 0.0, 0.0, 0.0]
    assert expected(p, 7, counts=5).tolist() == [5.0, 5.0, -5.0, -5.0, 0.0, 0.0, 0.0]
    assert expected(Program(kind="none"), 3).tolist() == [0.0, 0.0, 0.0]


def test_a_table_is_rounded_to_whole_counts_away_from_zero():
    values = (127, -127, 64, -64, 1, -1, 0)
    p = Program(kind="table", amplitude=2.0, length=7, table=values)
    np.testing.assert_allclose(expected(p, 7), 2.0 * np.array(values) / 127)
    for counts in (1, 10, 100, 799):
        exact = [(abs(v) * counts * 2 + 127) // 254 * np.sign(v) for v in values]
        assert expected(p, 14, counts=counts).tolist() == [*exact, *exact]
    held = Program(kind="table", amplitude=2.0, hold=3, length=2, table=(127, 0))
    assert expected(held, 8, counts=4).tolist() == [4, 4, 4, 0, 0, 0, 4, 4]


@pytest.mark.parametrize("name", ["multisine", "schroeder"])
def test_a_multisine_lies_in_its_band_with_low_peaks(name):
    p = made(name, band=(4.0, 400.0))
    assert (p.kind, p.hold, p.length, p.cycles, len(p.table)) == ("table", 1, 1000, 0, 1000)
    assert max(map(abs, p.table)) == 127
    x = expected(p, 1000, counts=67)
    assert crest_factor(x) < (1.75 if name == "multisine" else 1.85)
    content = played(p, RATE, counts=67, volts_per_count=0.03)
    assert content.share((4.0, 400.0)) > 0.999
    lines = content.line_v[(content.frequency_hz >= 4.0) & (content.frequency_hz <= 400.0)]
    assert lines.size == 199
    assert lines.min() > 0.85 * lines.max()
    assert content.peak_v == pytest.approx(67 * 0.03)
    assert content.rms_v == pytest.approx(float(np.sqrt(np.mean(x**2))) * 0.03)


def test_a_low_line_holds_the_elements():
    p = made("multisine", band=(0.5, 200.0))
    assert (p.hold, p.length) == (4, 1000)
    assert played(p, RATE).frequency_hz[0] == pytest.approx(0.5)
    assert played(p, RATE).share((0.5, 200.0)) > 0.8  # the rest is in the images of the holding


def test_a_short_record_gets_a_short_table():
    p = made("multisine", seconds=1.0)
    assert (p.hold, p.length) == (1, 500)
    assert period_ticks(p) * 4 == 2000


def test_the_same_seed_gives_the_same_table_and_another_another():
    assert made("multisine", band=(4.0, 400.0)) == made("multisine", band=(4.0, 400.0))
    assert made("multisine", band=(4.0, 400.0)).table != made("multisine", band=(4.0, 400.0), seed=2).table
    assert made("prbs", seed=1) == made("prbs", seed=1)
    assert made("prbs", seed=1).seed != made("prbs", seed=2).seed


@pytest.mark.parametrize("band", [(2.0, 300.0), (0.1, 200.0), (1.0, 880.0), (0.5, 50.0)])
def test_a_prbs_has_half_its_power_density_at_the_top_and_a_line_at_the_bottom(band):
    p = made("prbs", band=band)
    content = played(p, RATE)
    assert content.frequency_hz[0] <= band[0]
    assert content.frequency_hz[0] > band[0] / 2.1
    density = content.line_v**2
    top = density[np.searchsorted(content.frequency_hz, band[1])]
    assert top > 0.45 * density[0]
    if p.hold > 1:
        # a hold more and the top would be hardly over half
        slower = Program(kind="prbs", amplitude=2.0, hold=p.hold + 1, length=p.length, seed=p.seed)
        held = played(slower, RATE)
        assert held.line_v[np.searchsorted(held.frequency_hz, band[1])] ** 2 < 0.53 * held.line_v[0] ** 2
    assert content.rms_v == content.peak_v == 2.0


def test_a_prbs_without_a_band_repeats_four_times_in_the_record():
    for seconds, bits in ((20.0, 13), (1.0, 8), (1000.0, 15)):
        p = made("prbs", seconds=seconds)
        assert (p.hold, p.length) == (1, bits)
        assert period_ticks(p) * 4 <= seconds * RATE


def test_steps_fill_the_record_four_times():
    assert made("steps").hold == 5000
    long = made("steps", seconds=3600.0)
    assert long.hold <= 65535
    assert long.hold * 2 * round(3600.0 * RATE / (2 * long.hold)) == pytest.approx(3600.0 * RATE, rel=0.02)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("chirp", {}, "The nearest is 'multisine' in the same band; give that"),
        ("gaussian", {}, "The nearest is 'prbs' in the same band; give that"),
        ("sine", {}, "excitation 'sine' is unknown; a controller plays steps, prbs, multisine, schroeder"),
        ("prbs", {"amplitude_v": 0.0}, "excitation amplitude 0.0 V; it must be a positive number"),
        ("prbs", {"band": (10.0, 1500.0)}, "it must lie between 0 and 1000 Hz, low end first"),
        ("prbs", {"seconds": 0.0}, "has fewer than two ticks"),
        ("steps", {"band": (1.0, 2.0)}, "excitation 'steps' has no band"),
        (
            "prbs",
            {"band": (0.01, 1000.0)},
            "needs a register of 18 bits; the controller has 15. For the same upper end it can start at 0.061 Hz",
        ),
        ("prbs", {"band": (0.1, 200.0), "seconds": 10.0}, "has a period of 16.38 s, longer than the record of 10 s"),
        ("multisine", {"band": (0.5, 400.0)}, "from 0.5 Hz it reaches 200 Hz, and for 400 Hz it must start at 1 Hz"),
        (
            "multisine",
            {"band": (4.0, 400.0), "seconds": 0.5},
            "from 4 Hz needs 1 s for 4 periods; the record has 0.5 s",
        ),
        ("multisine", {"seconds": 0.01}, "for 4 periods; the record has 0.01 s. Record longer"),
    ],
)
def test_what_a_controller_cannot_play_is_refused_with_the_nearest(name, options, words):
    with pytest.raises(DeviceError) as refused:
        made(name, **options)
    assert words in str(refused.value)


def test_the_nearest_that_is_named_can_be_played():
    assert made("multisine", band=(0.5, 200.0)).kind == "table"
    assert made("multisine", band=(1.0, 400.0)).kind == "table"
    assert made("prbs", band=(0.0611, 1000.0)).length == 15


def test_volts_become_counts_that_leave_room():
    rig = bench()
    p = made("prbs")
    assert amplitude_counts(p, rig, 400, (20, 780)) == 67
    for volts in (0.01, 11.5):
        with pytest.raises(DeviceError, match=r"1 to 380 are possible, 0\.03 to 11\.4 V"):
            amplitude_counts(made("prbs", amplitude_v=volts), rig, 400, (20, 780))
