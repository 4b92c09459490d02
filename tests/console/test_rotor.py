"""A rotor live on the page, in headless Chromium, and what tells its orbits."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.acquisition.devices.rotor import RotorDevice
from ambid.console.rotor_view import Orbits
from ambid.physics.presets import preset
from ambid.record import read_record, write_record
from ambid.rig import rig_of_preset, write_rig
from tests.console.browser import NEEDED, SIZES, chromium
from tests.console.pages import console

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
RIG = rig_of_preset(preset("spindle"))
LONG_S = 120.0


class Heard:
    """A feed that only listens."""

    def __init__(self):
        self.said = []

    def tell(self, kind, content, **_):
        self.said.append((kind, content))


def test_an_orbit_is_that_of_the_unbalance():
    """What turns with the rotor is the bench's answer to its unbalance: with the run alone, no excitation."""
    quiet = replace(RIG, noise=None)
    feed, n = Heard(), 0
    with RotorDevice(quiet) as device:
        device.start("levitate")
        orbits = Orbits(feed, quiet, device.info)
        while n < 40_000:
            block = device.read(0.1).block
            n += len(block.values)
            orbits.take(block.values, n / 20_000)
    (_, about), (_, last) = feed.said[0], feed.said[-1]
    assert about == {"bearings": {"A": ["ax", "ay"], "B": ["bx", "by"]}, "rpm": pytest.approx(30_000.0), "turns": 2.0,
                     "stop": 2e-4}  # fmt: skip
    for name in "AB":
        x, y = (np.array(v) for v in last["of"][name])
        size = np.hypot(*last["turning"][name][:2])
        assert math.isclose(size, np.abs(x).max(), rel_tol=0.01)
        assert np.hypot(x, y).std() < 0.01 * size  # its stiffness is alike in all directions: a circle
    assert len(feed.said) == 1 + 10  # every 0.2 s


def test_where_a_rotor_stands_is_no_part_of_what_turns_with_it():
    """Seven turns and a half in the window, and a mean twenty times as large as the orbit."""
    feed, device = Heard(), RotorDevice(RIG)
    orbits, t = Orbits(feed, RIG, device.info), np.arange(22_000) / 20_000
    angle = 2.0 * np.pi * 7.5 * t
    values = {"position": 1e-4 + 5e-6 * np.cos(angle), "angle": angle}
    rows = np.column_stack([values.get(c.role.rpartition("_")[2], 0.0 * t) for c in device.info.columns])
    for k in range(0, t.size, 200):
        orbits.take(rows[k : k + 200], float(t[k]) + 0.01)
    real, imaginary, *_ = feed.said[-1][1]["turning"]["A"]
    assert math.isclose(math.hypot(real, imaginary), 5e-6, rel_tol=0.05)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("rotor")
    write_rig(RIG, made / "rotor.toml")
    write_rig(replace(RIG, loop=None), made / "bare.toml")
    write_rig(replace(RIG, loop=replace(RIG.loop, kp=0.3 * RIG.loop.kp)), made / "weak.toml")
    record = ambid.simulate(RIG, duration=5.0, periods=5, seed=1)
    write_record(record, made / "played.h5")
    ambid.identify(record, RIG).save(made / "start.json")
    return made


@pytest.fixture(scope="module")
def page(folder):
    with console(folder) as served, chromium() as browser:
        opened = browser.open(served.link)
        yield opened
        assert opened.wrong == []


def start(page, out, *, rig="rotor.toml", port="simulated", estimate="start.json", excitation="multisine", **more):
    page.evaluate("ambidConsole.refresh()")
    page.click("[data-tab=live]")
    fields = {
        "rig": rig,
        "port": port,
        "estimate": estimate,
        "excitation": excitation,
        "out": out,
        "seconds": "60",
        "amplitude": "",
    }
    for name, value in {**fields, **more}.items():
        page.put(f"#live-form [name={name}]", value)
    before = page.evaluate("ambidConsole.feed?.id ?? ''")
    page.click("#live-form button.go")
    page.until(f"ambidConsole.feed && ambidConsole.feed.id !== {before!r}")


INK = """[...document.querySelectorAll("#orbit canvas")].every((c) => {
  const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  return d.some((v, k) => k % 4 === 3 && v > 0 && Math.abs(d[k - 3] - 0x1f) < 9 && Math.abs(d[k - 1] - 0xa8) < 9);
})"""


class TestPage:
    pytestmark = NEEDED

    @pytest.fixture(autouse=True)
    def stopped(self, page):
        yield
        if page.evaluate("ambidConsole.feed && !ambidConsole.feed.over"):  # a run that a failed test left
            page.click("#stop")
            page.until("ambidConsole.feed.over")

    def test_a_rotor_is_levitated_followed_and_stopped(self, page, folder):
        start(page, "followed")
        page.with_text("#events li", "dealt out to the axes", LONG_S)
        page.until("document.querySelectorAll('#loop tbody tr').length === 5", LONG_S)
        assert page.count("#orbit canvas") == 2
        page.until(INK)
        assert page.count("#strips .chart") == 10  # position and current of each axis
        page.until("ambidConsole.feed.lines.length > 1", LONG_S)
        shown = page.evaluate("Object.keys(ambidConsole.feed.lines.at(-1).values)")
        assert {f"{axis}.{q}" for axis in RIG.rotor.axes for q in ("k_i", "k_x", "R")} <= set(shown)
        assert "Measured at the excited lines" in page.text("#loop")
        assert page.evaluate("$('speed').value") == "30000"
        assert page.count("[data-say]:disabled") == 4  # a rotor's tracker is led by nobody
        for size in SIZES:
            page.resize(*size)
            page.until(
                "document.documentElement.scrollWidth === document.documentElement.clientWidth"
            )  # once charts have followed
        page.resize(*SIZES[2])
        page.click("#stop")
        page.until("ambidConsole.feed.over")
        assert page.text("#lost") == "0 lost"
        kept = read_record(folder / "followed.h5")
        assert {
            f"{axis}_{q}" for axis in RIG.rotor.axes for q in ("voltage", "current", "position", "reference")
        } < set(kept.names)

    def test_without_an_excitation_the_sensitivity_is_predicted(self, page):
        start(page, "quiet", excitation="none")
        page.with_text("#loop", "Predicted: by the estimate", LONG_S)
        page.with_text("#events li", "not periodic", LONG_S)
        assert page.count("#parameters .chart") == 0
        page.click("#stop")
        page.until("ambidConsole.feed.over")

    def test_a_touch_down_ends_the_run_with_its_reason(self, page):
        start(page, "touched", amplitude="58")
        page.with_text("#events li", "fault", LONG_S)
        page.until("ambidConsole.feed.over", LONG_S)
        assert "the controller tripped" in page.text("#events")

    @pytest.mark.parametrize(("rig", "why"), [("bare", "has no [loop] with a gain"), ("weak", "unstable")])
    def test_what_cannot_levitate_is_refused(self, page, folder, rig, why):
        start(page, f"not-{rig}", rig=f"{rig}.toml")
        page.with_text("#events li", why, LONG_S)
        assert not (folder / f"not-{rig}.h5").exists()

    def test_a_recorded_rotor_is_replayed(self, page):
        start(page, "again", port="replay:played.h5", excitation="none")
        page.until("ambidConsole.feed.lines.length > 0", LONG_S)
        page.until("ambidConsole.feed.over", LONG_S)
        assert page.count("#loop tbody tr") == 5
        page.until(INK)
