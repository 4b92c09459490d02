"""Every example of the documentation runs, and the numbers it returns are those it promises."""

from __future__ import annotations

import numpy as np
import pytest

from tests.examples.conftest import EXAMPLES, example

IN_99_9 = 3.29  # standard deviations of a 99.9 % interval


def test_every_example_is_tested():
    text = (EXAMPLES.parents[1] / "tests" / "examples" / "test_examples.py").read_text(encoding="utf-8")
    assert [p.stem for p in sorted(EXAMPLES.glob("*.py")) if f'example("{p.stem}")' not in text] == []


@pytest.fixture(scope="module")
def thesis():
    return example("thesis_reproduction").main()


def test_corrected_table_4_1_gives_the_printed_matrices(thesis):
    printed = example("thesis_reproduction").PRINTED_4_10
    for name, value in printed.items():
        assert thesis["entries"][name] == pytest.approx(value, rel=2e-4), name  # the print has four digits


def test_matrix_4_11_holds_the_parameters_of_the_theory_page(thesis):
    # the theory page: what the entries printed in (4.11) amount to
    expected = {"m": 0.0976, "k_x": 608.1, "k_i": -320.0, "R": 1.138, "L": 60.2e-3}
    for name, value in expected.items():
        assert thesis["thesis"][name] == pytest.approx(value, rel=1e-3), name


def test_thesis_rig_is_recovered(thesis):
    for name, limit in {"m": 0.005, "k_i": 0.005, "R": 0.005, "L": 0.005, "k_x": 0.03}.items():
        true, found = thesis["truth"][name], thesis["ambid"][name]
        assert abs(found / true - 1) < limit, name
        assert abs(found - true) < IN_99_9 * thesis["sd"][name], name
        assert abs(found / true - 1) < abs(thesis["thesis"][name] / true - 1), f"{name}: no better than the thesis"


def test_thesis_coil_is_recovered():
    found = example("coil").main()
    assert found["likelihood"]["gain"] == pytest.approx(550.0, rel=0.005)
    assert found["likelihood"]["pole"] == pytest.approx(860.0, rel=0.005)
    assert found["thesis (4.3)"]["pole"] == pytest.approx(812.5)


def test_three_blocks_are_recovered_and_print_their_limit(capsys):
    three = example("three_blocks")
    corrected, found = three.main()
    assert corrected["L"] == pytest.approx(1.530e-3, abs=5e-7)
    assert corrected["k_x"] == pytest.approx(0.00886, abs=5e-6)
    truth = three.block_parameters(three.BENCH)[0]
    for p, true in zip(found.details["parameters"].values(), truth, strict=True):
        assert abs(p["value"] - true) < IN_99_9 * p["sd"]
        assert p["sd"] < 0.1 * abs(true)
    assert found.details["limit"] in " ".join(capsys.readouterr().out.split())


def test_unstable_bearing_is_recovered_in_closed_loop():
    result = example("unstable_bearing").main()
    truth, estimate = result.simulation.truth, result.estimate
    assert result.simulation.within_limits
    assert estimate.status == "converged"
    assert max(estimate.continuous.poles.real) > 0.0
    assert estimate.fit["position"].simulation is None  # it would run away
    for p in estimate.parameters:
        if p.role == "free":
            assert abs(p.value / truth[p.name] - 1) < 0.02, p.name
            assert abs(p.value - truth[p.name]) < IN_99_9 * p.sd, p.name
    assert estimate.delay["voltage"].samples == truth["delay"]
    assert estimate.passed


def test_the_laguerre_operator_keeps_the_condition():
    result = example("laguerre_condition").main()
    assert result.orders.tolist() == list(range(2, 21))
    assert result.with_operator.max() < 10.0
    assert result.without[-1] > 1e8
    assert np.all(result.without[1:] / result.without[:-1] > 2.0)


def test_a_change_is_found_while_the_rotor_levitates():
    result = example("online_change").main()
    assert [change.parameter for change in result.track.totals.changes] == ["k_i"]
    assert 0.0 < result.detected_s < 0.02
    assert result.detected_s < result.found_s < 0.25
    last = result.track.lines[-1]
    assert last.state == "tracking"
    assert abs(last.parameters["k_i"].value - result.k_i) < IN_99_9 * last.parameters["k_i"].sd
    assert last.parameters["k_i"].value == pytest.approx(result.k_i, rel=0.01)


def test_real_maglev_agrees_with_gravity():
    module = example("real_maglev")
    results = module.main()
    if not results:
        pytest.skip(f"no maglev records in {module.DATA}")
    good, poor = results["levitate_stairs_a"], results["levitate_sine_e"]
    assert good.estimate.values["R"] == pytest.approx(4.17, rel=0.07)  # measured
    assert good.estimate.values["L"] == pytest.approx(0.117, rel=0.07)  # that laboratory's fit at 10 mm, 0.95 A
    assert good.estimate.delay["voltage"].samples == 1
    assert good.ratio == pytest.approx(good.balance, rel=0.20)
    for result in results.values():  # the interval covers the balance, or the parameter is flagged
        k_i = result.estimate.parameter("k_i")
        assert abs(result.ratio - result.balance) * module.MASS < IN_99_9 * k_i.sd or not k_i.identifiable
    # the poor record says that it is poor
    assert not poor.estimate.passed
    assert poor.estimate.warnings
    # least squares depends on the filter in front of it, by more than any honest interval
    assert np.ptp(list(poor.least_squares.values())) > 10.0


def test_real_maglev_says_that_its_records_are_missing(tmp_path, capsys):
    assert example("real_maglev").main(tmp_path) == {}
    assert "maglev records are not in" in capsys.readouterr().out
