"""What the functions of `ambid` are given wrongly from Python is refused on one line, as on the command line."""

from math import nan

import pytest

import ambid


@pytest.fixture(scope="module")
def estimate():
    record = ambid.simulate("rmit-axis", duration=0.5, seed=1)
    return ambid.identify(record, ambid.rig.rig_of_preset(ambid.preset("rmit-axis")))


EXPERIMENT = (
    {"seconds": "a"}, {"seconds": True}, {"period": [1]}, {"band": 5}, {"band": (nan, 10)}, {"band": (-1, 10)},
    {"lines": 2.5}, {"lines": None}, {"target": None}, {"use": "a"}, {"use": 1.5}, {"spread": None}, {"rate_hz": "a"},
    {"closed": "open"}, {"seed": -1}, {"seed": 2.5},
)  # fmt: skip
CONTROLLER = (
    {"goals": 5}, {"goals": "peak"}, {"limits": 5}, {"limits": {"peak": "a"}}, {"spread": 5},
    {"filters": -1}, {"plants": 2.5}, {"seed": -1}, {"rig": 5},
    {"speeds_rpm": (1,)}, {"form": [1]},
)  # fmt: skip
SIMULATION = (
    {"duration": "a"}, {"rate_hz": [1]}, {"amplitude": -1}, {"band": [1]}, {"periods": 2.5}, {"seed": "a"},
    {"closed": "open"}, {"position": "a"}, {"position": nan},
)  # fmt: skip


@pytest.mark.parametrize("given", EXPERIMENT, ids=str)
def test_an_experiment_refuses_what_is_no_setting(given):
    refused(lambda: ambid.design_experiment("prototype", **given))


@pytest.mark.parametrize("given", CONTROLLER, ids=str)
def test_a_controller_refuses_what_is_no_setting(given, estimate):
    refused(lambda: ambid.design_controller(estimate, **given))


@pytest.mark.parametrize("given", SIMULATION, ids=str)
def test_a_simulation_refuses_what_is_no_setting(given):
    refused(lambda: ambid.simulate("rmit-axis", **{"duration": 0.1, **given}))


@pytest.mark.parametrize(
    "call",
    [
        lambda: ambid.load(None),
        lambda: ambid.design_experiment(5),
        lambda: ambid.identify({"x [m]": [0.0]}, 5),
        lambda: ambid.frf(ambid.simulate("thesis", duration=0.1), input=5, output="current"),
        lambda: ambid.frf(ambid.simulate("thesis", duration=0.1), input="voltage", output="current", band=[1]),
        lambda: ambid.fit(ambid.simulate("thesis", duration=0.1), structure="arx", orders=5),
    ],
)
def test_what_is_no_file_name_or_order_is_refused(call):
    refused(call)


def refused(call):
    with pytest.raises(ambid.AmbidError) as told:
        call()
    assert "\n" not in str(told.value)
    assert len(str(told.value)) > 20
