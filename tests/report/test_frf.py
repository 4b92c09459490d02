"""Table and figure of a measured response: medians, 80 columns, levels, bands and phases where they belong."""

from dataclasses import replace

import numpy as np
import pytest

from ambid.bearing.measured import Measured, model_responses
from ambid.job import frf
from ambid.job.presentation import text as frf_text
from ambid.report.document import part_lines
from ambid.report.numbers import response_unit
from ambid.report.response import frf_figure, pair_parts, warnings_of
from ambid.rig import default_rig
from ambid.signals.response import FrequencyResponse
from tests.job.loops import loop_record, odd_record


def drawn(n=40, noise=None, **changes):
    f = np.linspace(5.0, 200.0, n)
    G = 1e-4 / (1 + 1j * f / 50)[:, None, None]
    variance = (0.02 * np.abs(G)) ** 2 + 0j
    settings = {
        "frequency_hz": f, "G": G, "covariance": variance, "noise_covariance": noise, "method": "drawn",
        "inputs": ("voltage",), "outputs": ("position",), "units": {"voltage": "V", "position": "m"},
        "rate_hz": 1000.0, "degrees_of_freedom": np.inf,
    }  # fmt: skip
    return FrequencyResponse(**{**settings, **changes})


@pytest.fixture(scope="module")
def both():
    return frf(loop_record(), reference="excitation", rig=default_rig(), orders={"nf": 4})


def pair_lines(measured):
    return [line for part in pair_parts(measured) for line in part_lines(part, 80)]


def test_pairs_are_told_by_their_medians():
    frame = drawn()
    (_, line, *about) = pair_lines(Measured(response=frame))
    assert line.split()[:3] == ["voltage", "→", "position"]
    assert "2 %" in line
    assert "um/V" in line
    assert "not separated" in " ".join(about)
    split = drawn(noise=(0.01 * np.abs(frame.G)) ** 2 + 0j, coherence=np.full((40, 1), 0.9876))
    (_, line, *_) = pair_lines(Measured(response=split))
    assert [x for x in line.split() if x[0].isdigit()][2:] == ["2", "1", "1.7", "0.9876"]


def test_noise_alone_is_not_called_told_apart():
    frame = drawn()
    assert Measured(response=replace(frame, noise_covariance=frame.covariance)).distortion_sd is None


@pytest.mark.parametrize(
    ("above", "below", "unit"),
    [("m", "V", "m/V"), ("m", "1", "m"), ("1", "V", "1/V"), ("A", "A", "1"), ("m", "m/s", "m/(m/s)")],
)
def test_units_of_a_response(above, below, unit):
    assert response_unit({"y": above, "u": below}, "y", "u") == unit


def test_long_names_still_fit_80_columns():
    names = {"inputs": ("voltage_of_the_upper_coil",), "outputs": ("position_at_the_far_sensor",)}
    lines = frf_text(Measured(response=drawn(**names, units={}))).splitlines()
    assert max(map(len, lines)) <= 80


def test_a_shared_denominator_and_its_poles_stand_once(both):
    text = frf_text(both)
    assert max(map(len, text.splitlines())) <= 80
    assert "den[0,0]z0" in text
    assert "den[1,0]z0" not in text
    assert "num[1,0]z0" in text
    assert sum("unstable" in line for line in text.splitlines()) == 1
    assert " 0.000000000000" not in text  # a numerator in metres is small, and has digits all the same


def test_a_warning_stands_once(both):
    again = replace(both, fit=replace(both.fit, warnings=both.response.warnings))
    assert len(set(warnings_of(again))) == len(warnings_of(again)) >= 1


def test_distortion_levels_are_shown_beside_their_noise():
    text = frf_text(frf(odd_record(nonlinear=True, rms=3.0), input="voltage", output="current",
                        reference="excitation"))  # fmt: skip
    assert "at lines without excitation" in text
    (line,) = [x for x in text.splitlines() if x.startswith("current ")]
    even, of_even, odd, of_odd = (float(x) for x in line.replace("dB", "").split()[1:])
    assert odd > of_odd + 3
    assert even < 0
    assert of_even < 0


def test_the_figure_has_levels_bands_and_both_models(both):
    page = frf_figure(both)
    assert len(page.axes) == 4
    _, labels = page.axes[0].get_legend_handles_labels()
    assert {"measured", "measured, 95 %", "frf-ml", "physical parameters of one-axis"} <= set(labels)
    # the plant is levitated: position opposes voltage at 0 Hz, and both curves and lines lie on the same side of ±180°
    phase = page.axes[2] if len(page.axes[2].lines) else page.axes[1]
    starts = [float(line.get_ydata()[0]) for line in phase.lines]
    assert max(starts) - min(starts) < 30
    assert all(150 < abs(x) < 190 for x in starts)


def test_measured_phases_follow_the_model_where_noise_would_make_them_jump(both):
    phase = next(a for a in frf_figure(both).axes if a.get_ylabel().startswith("phase"))
    model_line, *_, measured = (line for line in phase.lines)
    (m, *_) = model_responses(both, both.response.frequency_hz)
    turn = np.rad2deg(np.unwrap(np.angle(m.G[:, 0, 0])))
    turn += 360 * np.round((model_line.get_ydata()[0] - turn[0]) / 360)
    assert np.all(np.abs(measured.get_ydata() - turn) <= 180.5)


def test_many_pairs_are_counted_and_a_single_line_is_drawn():
    one = drawn(n=2).between(5.0, 6.0)
    assert frf_figure(Measured(response=one)).axes
    n_y = 4
    f = np.linspace(5.0, 100.0, 10)
    wide = FrequencyResponse(
        frequency_hz=f, G=np.ones((10, n_y, 2), dtype=complex), covariance=np.tile(0.01 * np.eye(8) + 0j, (10, 1, 1)),
        method="drawn", inputs=("a", "b"), outputs=("p", "q", "r", "s"), rate_hz=1000.0, degrees_of_freedom=20.0,
    )  # fmt: skip
    page = frf_figure(Measured(response=wide))
    assert "6 of 8 pairs" in page.get_suptitle()


def test_a_phase_that_noise_hides_does_not_walk_out_of_its_axis():
    rng = np.random.default_rng(5)
    f = np.linspace(5.0, 2000.0, 400)
    G = 1.0 / (1 + 1j * f / 50) ** 3
    noise = 1e-3 * (rng.standard_normal(400) + 1j * rng.standard_normal(400))
    frame = drawn(400, frequency_hz=f, G=(G + noise)[:, None, None], covariance=np.full((400, 1, 1), 2e-6 + 0j))
    (phase,) = (a for a in frf_figure(Measured(response=frame)).axes if a.get_ylabel().startswith("phase"))
    (points,) = (np.asarray(x.get_ydata()) for x in phase.lines if x.get_marker() == ".")
    low, high = phase.get_ylim()
    assert low <= points.min() <= points.max() <= high
    assert high - low < 800
    np.testing.assert_allclose(points[:40], -3 * np.rad2deg(np.arctan(f[:40] / 50)), atol=5.0)
