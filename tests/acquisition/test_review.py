"""What a controller holds only roughly is said with its remedy; a sound rig gives no line."""

import pytest

from ambid.acquisition.review import review
from ambid.acquisition.settings import controller_settings, with_default_daq
from tests.acquisition.rigs import bench
from tests.acquisition.test_default_daq import of_preset


def lines(*changes, **options) -> tuple[str, ...]:
    rig = bench(*changes, **options)
    return review(rig, controller_settings(rig))


def test_a_sound_rig_gives_no_line():
    assert lines() == ()


@pytest.mark.parametrize("name", ["prototype", "unstable-bearing", "rmit-axis"])
def test_presets_are_stable_as_their_controllers_close_the_loop(name):
    rig = with_default_daq(of_preset(name))
    assert not [line for line in review(rig, controller_settings(rig)) if "stable" in line or "damps" in line]


@pytest.mark.parametrize(
    ("sound", "changed", "words"),
    [
        (
            "kp = 1.94e4",
            "kp = 5e3",
            "the loop is unstable on the rig's own plant at 2000 Hz with the controller's delay",
        ),
        ("kd = 92.6", "kd = 9.26", "the loop is unstable"),
        ("ki = 7.85e4", "ki = 3100.0", "loop.ki is 8.27 steps of the controller, rounded by 3.2%"),
        ("ki = 7.85e4", "ki = 2000.0", "the loop hardly damps the rig's own plant"),
        ('L = { value = 80.3, unit = "mH" }\n', "", "not be checked, because the rig has no value for L. A"),
        ("[daq]\n", "[daq]\nduty = [0, 800]\n", "daq.duty allows -12 to 12 V, beyond loop.limits"),
        (
            "[daq]\n",
            "[daq]\ntrip = { current = 0.01 }\n",
            "current at rest is 4 counts from its trip: noise may trip it",
        ),
        ("[daq]\n", "[daq]\ntrip = { position = 5e-5 }\n", "position has 40 counts between its trips: too coarse"),
        (
            "rate_hz = 2000.0",
            "rate_hz = 500.0",
            "at 500 Hz the controller only samples: its output works at 1000 to 2500 Hz only",
        ),
        ("kp = 1.94e4\nki = 7.85e4\nkd = 92.6\nkc = 33.8", "", "it can sample and drive, not levitate. Add [loop]"),
    ],
)
def test_what_is_rough_is_said(sound, changed, words):
    found = lines((sound, changed))
    assert any(words in line for line in found), found


def test_what_the_rig_does_not_know_is_lent_by_the_bench():
    rig = bench(('L = { value = 80.3, unit = "mH" }\n', ""))
    plant = {"m": 0.3, "k_x": -6702.0, "k_i": 20.1, "R": 6.0, "L": 80.3e-3, "c": 0.0}
    s = controller_settings(rig)
    assert review(rig, s, parameters=plant) == ()
    slower = review(rig, s, parameters=plant | {"L": 0.8, "k_x": -20_000.0})
    assert any("the loop is unstable on the rig's own plant with L of the bench" in line for line in slower), slower


def test_tables_are_told_where_they_end_and_where_they_bend(tmp_path):
    (tmp_path / "gap.csv").write_text("counts [1],gap [mm]\n20,2\n500,0.1\n600,-0.3\n1023,-1.2\n")
    change = ("gain = 2.44140625e-6\noffset = -1.25e-3", 'table = "gap.csv"')
    found = lines(change, path=tmp_path / "rig.toml")
    assert any("the table of channels.position covers 20 to 1023 of 0 to 1023 counts" in line for line in found), found
    assert any("the slope of channels.position.table changes by a factor 1.9" in line for line in found), found
