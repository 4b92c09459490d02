"""Plots of the page in a real browser: what is read off, zoomed, exported and overlaid is what was measured."""

import json
import re
import time

import numpy as np
import pytest

from ambid.console.runs import Runs
from ambid.record import Channel, Record, read_csv, write_record
from tests.console.browser import NEEDED, chromium
from tests.console.pages import LIVE, console, over, prototype_rig, until

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytestmark = NEEDED
# what is written in the pictures
WORDS = """(() => { const draw = CanvasRenderingContext2D.prototype.fillText; window.words = [];
  CanvasRenderingContext2D.prototype.fillText = function (text, ...where) { words.push(text);
    return draw.call(this, text, ...where); }; })()"""
RATE, HZ, SIZE_M, SIZE_A = 2000.0, 4.0, 1e-4, 0.3
IDLE = "!document.querySelector('progress')"
# what a chart's button would save, as text; the last one
CAUGHT = """(() => { URL.createObjectURL = (blob) => { window.saved = null; blob.arrayBuffer().then((b) => {
  window.saved = { type: blob.type, text: new TextDecoder().decode(b), size: b.byteLength,
    head: [...new Uint8Array(b.slice(0, 4))] }; });
  return "#"; }; HTMLAnchorElement.prototype.click = () => {}; })()"""


def sine(share=1.0, start_s=0.0):
    t = np.arange(20_000) / RATE
    return Record(
        rate_hz=RATE, start_s=start_s,
        channels=(
            Channel(name="position", unit="m", values=share * SIZE_M * np.sin(2 * np.pi * HZ * t)),
            Channel(name="current", unit="A", values=share * SIZE_A * np.cos(2 * np.pi * HZ * t)),
        ),
    )  # fmt: skip


def ramp():
    """A rotor that runs up from 10 to 60 turns a second, its unbalance in two axes."""
    t = np.arange(20_000) / RATE
    phase = 2 * np.pi * (10 * t + 2.5 * t**2)
    names = {"x": ("m", 2 * SIZE_M * np.cos(phase)), "y": ("m", SIZE_M * np.sin(phase)),
             "speed": ("rad/s", 2 * np.pi * (10 + 5 * t))}  # fmt: skip
    return Record(rate_hz=RATE, channels=tuple(Channel(name=n, unit=u, values=v) for n, (u, v) in names.items()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("plots")
    prototype_rig(made)
    metres = re.sub(
        r"(?m)^(gain|offset) += [-.\de]+",
        lambda m: f"{m[1]} = {float(m[1] == 'gain')}",
        (made / "rig.toml").read_text(),
    )
    (made / "metres.toml").write_text(metres)  # its columns are what they stand for
    for name, record in (("sine", sine()), ("half", sine(0.5, 3.0)), ("ramp", ramp())):
        write_record(record, made / f"{name}.csv")
    return made


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.fixture
def page(browser, folder):
    with console(folder) as served:
        opened = browser.open(served.link)
        yield opened
        assert opened.wrong == []
        browser.close(opened)


def shown(page, name, charts):
    page.evaluate(CAUGHT)
    page.click(page.with_text("#list tr", name))
    page.until(f"document.querySelectorAll('#detail .chart').length >= {charts} && {IDLE}", 60.0)


def chart(title):
    every = "[...document.querySelectorAll('#detail .chart')]"
    return f"{every}.find((c) => c.querySelector('h3').textContent.startsWith('{title}'))"


def place(page, title):
    """Left edge, top, width and height of the plane of a chart."""
    page.evaluate(f"{chart(title)}.scrollIntoView({{ block: 'center' }})")
    return page.evaluate(
        f"(() => {{ const b = {chart(title)}.querySelector('.u-over').getBoundingClientRect(); "
        "return [b.left, b.top, b.width, b.height]; })()"
    )


def mouse(page, kind, x, y, **more):
    page.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1, **more)


def click(page, title, share):
    left, top, width, height = place(page, title)
    for kind in ("mousePressed", "mouseReleased"):
        mouse(page, kind, left + share * width, top + height / 2)


def drag(page, title, begin, end, **more):
    left, top, width, height = place(page, title)
    for kind, at in (("mouseMoved", begin), ("mousePressed", begin), ("mouseMoved", end), ("mouseReleased", end)):
        mouse(page, kind, left + at * width, top + height / 2, **more)


def saved(page, title, what="CSV"):
    page.evaluate(f"window.saved = null; [...{chart(title)}.querySelectorAll('.tools button')]"
                  f".find((b) => b.textContent === '{what}').click()")  # fmt: skip
    return page.until("window.saved")


def read_back(page, title, tmp_path):
    (tmp_path / "saved.csv").write_text(saved(page, title)["text"], encoding="utf-8")
    return read_csv(tmp_path / "saved.csv")


def seconds(page, title):
    """Ends of what is shown, by the CSV."""
    rows = saved(page, title)["text"].splitlines()[2:]
    return float(rows[0].split(",")[0]), float(rows[-1].split(",")[0])


def settled(page):
    """Wait until the samples of what is shown have come."""
    time.sleep(0.4)
    page.until(IDLE)


def test_two_cursors_tell_time_and_value_between_them(page, folder):
    shown(page, "sine.csv", 4)
    click(page, "position", 0.3)
    click(page, "position", 0.34)
    text = page.until(f"{chart('position')}.querySelector('.cursors').innerText")
    a, b = (float(x) for x in re.findall(r"[AB] ([\d.]+) s:", text))
    assert b - a == pytest.approx(0.4, abs=0.03)  # of ten seconds
    gap = re.search(r"Δt ([\d.]+) (m?)s \(1/Δt ([\d.]+) Hz\), Δy (-?[\d.]+) µm", text)
    assert float(gap[1]) * (1e-3 if gap[2] else 1.0) == pytest.approx(b - a, abs=2e-4)
    assert float(gap[3]) == pytest.approx(1.0 / (b - a), rel=1e-3)
    each = int(re.search(r"(\d+) samples each", saved(page, "position")["text"])[1])
    of = [sine()["position"].values[each * round(t * RATE / each) :][:each] for t in (a, b)]
    middle = [(x.min() + x.max()) / 2 for x in of]
    assert float(gap[4]) * 1e-6 == pytest.approx(middle[1] - middle[0], abs=1e-3 * SIZE_M)
    assert "Δt" in page.evaluate(f"{chart('current')}.querySelector('.cursors').innerText")  # of the group
    page.evaluate(f"{chart('position')}.querySelector('.plot').focus()")
    page.key("ArrowRight")
    assert page.evaluate(f"{chart('position')}.querySelector('.cursors').innerText") != text
    page.key("Delete")
    assert page.evaluate(f"{chart('position')}.querySelector('.cursors').hidden")


def test_zoom_and_pan_by_mouse_touch_and_keys_show_the_samples_and_all_again(page, folder, tmp_path):
    shown(page, "sine.csv", 4)
    drag(page, "position", 0.5, 0.55)
    page.until(f"{IDLE} && {chart('position')}.querySelector('.value').textContent.length > 0")
    settled(page)
    first, last = seconds(page, "position")
    assert (first, last) == pytest.approx((5.0, 5.5), abs=0.05)
    found = read_back(page, "position", tmp_path)
    assert found.rate_hz == pytest.approx(RATE)
    assert found["position low"].values == pytest.approx(SIZE_M * np.sin(2 * np.pi * HZ * found.time_s), abs=1e-9)
    assert np.array_equal(found["position low"].values, found["position high"].values)
    drag(page, "position", 0.5, 0.25, modifiers=8)  # Shift: moved, not zoomed
    settled(page)
    moved = seconds(page, "position")
    assert moved == pytest.approx((first + 0.125, last + 0.125), abs=0.02)
    page.evaluate(f"{chart('position')}.querySelector('.plot').focus()")
    page.key("+")
    assert np.diff(seconds(page, "position")) == pytest.approx(0.25, abs=0.01)
    page.key("Home")
    settled(page)
    assert np.diff(seconds(page, "position")) == pytest.approx(10.0, abs=0.01)
    page.resize(1366, 768, touch=True)
    left, top, width, height = place(page, "position")
    y, at = top + height / 2, [left + 0.45 * width, left + 0.55 * width]
    page.send(
        "Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": x, "y": y, "id": k} for k, x in enumerate(at)]
    )
    wide = [left + 0.3 * width, left + 0.7 * width]
    for part in (0.25, 0.5, 0.75, 1.0):
        points = [{"x": a + part * (b - a), "y": y, "id": k} for k, (a, b) in enumerate(zip(at, wide, strict=True))]
        page.send("Input.dispatchTouchEvent", type="touchMove", touchPoints=points)
    page.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    assert np.diff(seconds(page, "position")) == pytest.approx(2.5, abs=0.4)  # a quarter
    page.resize(1366, 768)


def test_what_is_saved_is_what_is_shown_with_its_units(page, folder, tmp_path):
    shown(page, "sine.csv", 4)
    page.put("#detail select", "in one picture")
    page.until("document.querySelectorAll('#detail .names b').length >= 2")
    text = saved(page, "signals")["text"].splitlines()
    assert text[1] == "time [s],position low [m],position high [m],current low [A],current high [A]"
    assert "smallest and largest of" in text[0]
    found = read_back(page, "signals", tmp_path)
    assert found["position high"].values.max() == pytest.approx(SIZE_M, rel=1e-5)
    assert found["current low"].values.min() == pytest.approx(-SIZE_A, rel=1e-5)
    labels = page.evaluate("[...document.querySelectorAll('#detail .chart:first-child .u-axis')].length")
    assert labels == 3  # time, m, A
    picture = saved(page, "signals", "PNG")
    assert picture["head"] == [0x89, 0x50, 0x4E, 0x47]
    assert picture["size"] > 5000


def test_a_spectrum_tells_the_amplitude_what_kind_it_is_and_the_resolution(page, folder):
    shown(page, "sine.csv", 4)
    head = f"{chart('Spectrum of position')}.querySelector('h3').innerText"
    assert "peak, Hann window, resolution 150.0 mHz" in page.evaluate(head)
    assert "largest 100.0 µm at 4.000 Hz" in page.evaluate(head)
    page.evaluate(f"{chart('Spectrum of position')}.querySelector('.tools button').click()")
    assert "largest 70.71 µm at 4.000 Hz" in page.evaluate(head)
    assert "Spectrum of position, rms" in page.evaluate(head)
    page.put("#detail [aria-label='speed of the rotor']", "240")
    rows = saved(page, "Spectrum of position")["text"].splitlines()
    assert rows[1] == "frequency [Hz],position [m]"
    top = max((float(r.split(",")[1] or 0), float(r.split(",")[0])) for r in rows[2:])
    assert top == pytest.approx((SIZE_M / np.sqrt(2.0), HZ), rel=1e-3)
    drag(page, "Spectrum of position", 0.35, 0.45)
    settled(page)
    ends = seconds(page, "Spectrum of position")
    assert 0.05 < ends[0] < ends[1] < 20.0


def test_a_waterfall_follows_the_speed_and_an_orbit_has_equal_scales(page, folder):
    shown(page, "ramp.csv", 6)
    rows = saved(page, "Waterfall of x")["text"].splitlines()[1:]
    hz = [float(h.split()[0]) for h in rows[0].split(",")[1:]]
    table = np.array([[float(v or 0) for v in r.split(",")] for r in rows[1:]])
    assert rows[0].startswith("time [s],")
    assert np.abs(np.array(hz)[table[:, 1:].argmax(axis=1)] - (10 + 5 * table[:, 0])).max() < 12.0
    choose(page, "rotor speed")
    page.until(f"{chart('Waterfall of x')}.querySelector('h3').innerText.includes('over speed')")
    fast = saved(page, "Waterfall of x")["text"].splitlines()[1:]
    assert fast[0].startswith("speed [rpm],")
    speed = np.array([[float(v or 0) for v in r.split(",")] for r in fast[1:]])
    assert (speed[0, 0], speed[-1, 0]) == pytest.approx((600.0, 3600.0), rel=0.05)
    assert np.abs(np.array(hz)[speed[:, 1:].argmax(axis=1)] - speed[:, 0] / 60).max() < 12.0
    left, top, width, height = place(page, "Orbit")
    reads = []
    for x, y in ((0.4, 0.5), (0.6, 0.5), (0.5, 0.3), (0.5, 0.7)):
        mouse(page, "mouseMoved", left + x * width, top + y * height)
        text = page.evaluate(f"{chart('Orbit')}.querySelector('.value').textContent")
        reads.append([float(v) * (1e-6 if u == "µ" else 1e-9) for v, u in re.findall(r"(-?[\d.]+) ([µn])m", text)])
    across = (reads[1][0] - reads[0][0]) / (0.2 * width)
    up = (reads[2][1] - reads[3][1]) / (0.4 * height)
    assert across == pytest.approx(up, rel=0.03)
    assert "x across, y up; 400.0 µm by 200.0 µm" in saved_head(page, "Orbit")


def saved_head(page, title):
    page.send("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=300)
    return page.until(f"{chart(title)}.querySelector('.value').textContent")


def test_records_lie_over_each_other_from_their_starts(page, folder, tmp_path):
    shown(page, "sine.csv", 4)
    choose(page, "half.csv")
    page.until(f"{chart('position')}.querySelectorAll('.names b').length === 2 && {IDLE}", 60.0)
    assert [page.evaluate(f"{chart('position')}.querySelectorAll('.names b')[{k}].textContent") for k in (0, 1)] == [
        "sine.csv [m]", "half.csv [m]",
    ]  # fmt: skip
    colours = page.evaluate(
        f"[...{chart('position')}.querySelectorAll('.names b')].map((b) => getComputedStyle(b).color)"
    )
    assert len(set(colours)) == 2
    found = read_back(page, "position", tmp_path)
    assert found["half.csv high"].values == pytest.approx(0.5 * found["sine.csv high"].values, abs=1e-8)
    assert found.start_s == 0.0


def test_limits_of_a_rig_are_drawn_in_the_units_of_the_record(page, folder):
    shown(page, "sine.csv", 4)
    page.evaluate(WORDS)
    choose(page, "metres.toml")
    page.until("words.some((w) => w.includes('trip'))", 60.0)
    assert {"↑ trip 900.0 µm", "↓ trip -900.0 µm", "↑ limit of the coil 1.000 A"} <= set(page.evaluate("words"))


def choose(page, text):
    """Choose an option of that text in the list of the view that has it."""
    page.evaluate(
        "((text) => { const of = (s) => [...s.options].find((o) => o.text === text); "
        "const s = [...document.querySelectorAll('#detail .bar select')].find(of); s.value = of(s).value; "
        "s.onchange(); })"
        f"({json.dumps(text)})"
    )


def live_plots_are_read(page):
    """Cursors in a picture that stands still, marks with their words, limits and meanings."""
    page.evaluate(WORDS)
    page.put("#span", "5 min")
    page.click("#freeze")
    page.evaluate("feed.redraw()")
    page.until("words.some((w) => w.startsWith('limit: position passed'))")
    assert {"↑ trip 900.0 µm", "↑ limit of the amplifier 11.40 V"} <= set(page.evaluate("words"))
    box = "document.querySelector('#strips .u-over').getBoundingClientRect()"
    left, top, width = page.evaluate(f"[{box}.left, {box}.top, {box}.width]")
    for share in (0.4, 0.6):
        for kind in ("mousePressed", "mouseReleased"):
            mouse(page, kind, left + share * width, top + 30)
    text = page.until("(document.querySelector('#strips .cursors').innerText.match(/.*Δt.*/) ?? [''])[0]")
    a, b = (float(x) for x in re.findall(r"[AB] ([\d.]+) s", text))
    span = page.evaluate("[feed.strips[0].plot.scales.x.min, feed.strips[0].plot.scales.x.max]")
    assert b - a == pytest.approx(0.2 * (span[1] - span[0]), abs=3 * (span[1] - span[0]) / width)  # three pixels
    assert "± " in page.text("#parameters .chart .cursors")
    assert page.evaluate("document.querySelector('#parameters h3').title") == "mass of the rotor on this axis"
    page.evaluate("document.querySelector('#spectrum details').open = true")
    page.until("feed.fall.plot.data[0].length > 1")
    page.click("#freeze")


def test_alarms_are_filtered_and_acknowledged_for_all_pages_and_stay(browser, folder):
    run = Runs(folder).start({**LIVE, "out": "alarms.h5"})
    assert until(run, "line")
    with console(folder) as one, console(folder) as two:
        first, second = browser.open(one.link), browser.open(two.link)
        for page in (first, second):
            page.until("feed?.following && feed.lines.length > 3", 60.0)
            page.evaluate("feed.event(1.5, 'limit', 'position passed 0.0009 m: trip')")  # as the run tells it
            page.with_text("#events li", "limit: position passed")
            assert page.text(".alarms [role=status]") == "1 not acknowledged"
        live_plots_are_read(first)
        first.put(".alarms select", "alarms")
        assert first.evaluate(
            "[...document.querySelectorAll('#events li')].every((l) => l.textContent.includes('limit'))"
        )
        first.click("#events li button")
        first.with_text("#events li", "acknowledged")
        second.with_text("#events li", "acknowledged", 10.0)
        assert f"of the console at {one.host}" in second.text("#events")
        log = [json.loads(line) for line in (run.place / "orders.jsonl").read_text().splitlines()]
        (noted,) = [x for x in log if x["word"] == "acknowledge"]
        assert noted["keys"] == ["limit|1.5|position passed 0.0009 m: trip"]
        assert one.host in noted["by"]
        assert noted["at"] > 1.7e9
        run.say("stop")
        assert over(run)
        second.reload()
        second.click("[data-tab=files]")
        second.click(second.with_text("#runs tr", "live"))
        second.until("feed?.over")
        second.evaluate("feed.event(1.5, 'limit', 'position passed 0.0009 m: trip')")
        second.with_text("#events li", "acknowledged")
        assert second.text(".alarms [role=status]") == "no open alarm"
        for page in (first, second):
            browser.close(page)
