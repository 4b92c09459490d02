"""The whole way in a browser, headless Chromium: a record, its rig, identification; a live bench; commissioning."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from ambid.console.runs import Runs
from ambid.job import identify, load
from ambid.physics.presets import preset
from ambid.rig import preset_text
from tests.console.pages import console, prototype_rig

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
pytestmark = [
    pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed"),
    pytest.mark.skipif(os.environ.get("CI") == "true", reason="browsers are for machines of people"),
]
LONG_MS = 60_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from ambid import simulate
    from ambid.record import write_record

    made = tmp_path_factory.mktemp("page")
    prototype_rig(made)
    write_record(simulate("thesis", duration=0.5, seed=1), made / "rec.csv")
    return made


@pytest.fixture(scope="module")
def page(folder):
    with playwright.sync_playwright() as started, console(folder) as served:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        opened = browser.new_context(viewport={"width": 1366, "height": 768}).new_page()
        opened.wrong = []
        opened.on("pageerror", lambda error: opened.wrong.append(str(error)))
        opened.on("console", lambda said: said.type == "error" and opened.wrong.append(said.text))
        opened.set_default_timeout(LONG_MS)
        opened.goto(served.link)
        yield opened
        assert opened.wrong == []
        browser.close()


# whether the first strip has a colour
DRAWN = """(colour) => {
  const canvas = document.querySelector("#strips canvas");
  const bytes = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  for (let k = 0; k < data.length; k += 4) if (bytes.every((b, j) => Math.abs(data[k + j] - b) < 3)) return true;
  return false;
}"""


def until(page, holds):
    """Wait for something to hold; the page's policy forbids the browser's own way of it."""
    end = time.monotonic() + LONG_MS / 1000
    while not page.evaluate(holds):
        assert time.monotonic() < end, holds
        time.sleep(0.1)


def wide(page):
    """By how much the page is wider than its window, px."""
    return page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")


def test_a_record_becomes_an_estimate(page, folder):
    page.focus("#list tbody tr[tabindex='0']")
    page.keyboard.press("End")
    assert page.locator("#list tbody tr[tabindex='0']").count() == 1  # one stop of Tab, whatever the number of files
    assert page.evaluate("document.activeElement.rowIndex") == len(page.locator("#list tbody tr").all())
    page.click("#list tr:has-text('rec.csv')")
    page.click("button:text-is('Identify')")
    page.wait_for_selector("#detail h2.usable, #detail h2.caution, #detail h2.unusable")
    assert page.locator(f"#detail h2.{load(folder / 'rec-estimate.json').verdict.word}").count() == 1
    assert (folder / "rec-rig.toml").exists()
    assert page.locator("#detail a:has-text('rec-estimate.html')").count() == 1
    assert wide(page) == 0


def test_a_live_bench_is_watched_held_frozen_and_stopped(page, folder):
    page.click("[data-tab=live]")
    page.select_option("#live-form [name=rig]", label="rig.toml")
    page.fill("#live-form [name=amplitude]", "1.4")
    page.fill("#live-form [name=out]", "watched")
    page.click("#live-form button.go")
    page.wait_for_selector("#parameters .chart:nth-child(5)")
    until(page, "ambidConsole.feed.lines.length > 3")
    until(page, "!document.querySelector('[data-say=hold]').disabled")
    page.click("[data-say=hold]")
    page.wait_for_selector("#state:text-is('hold')")
    page.click("[data-say=accept]")
    page.click("dialog button[value=no]")
    page.click("#freeze")
    page.evaluate("(() => { const back = document.getElementById('back'); back.value = 300; back.oninput(); })()")
    assert page.evaluate("ambidConsole.feed.window()[1] <= ambidConsole.feed.t.at(-1)")
    strip = page.locator("#strips .u-over").first.bounding_box()
    page.mouse.move(strip["x"] + 60, strip["y"] + 20)
    page.mouse.down()
    page.mouse.move(strip["x"] + 180, strip["y"] + 20, steps=3)
    page.mouse.up()
    shown = "(() => { const f = ambidConsole.feed, s = f.error.plot.scales.x; return [s.min, s.max, ...f.zoom]; })()"
    until(page, f"{shown}[0] === {shown}[2] && {shown}[1] === {shown}[3]")  # parameters over the same stretch
    page.emulate_media(color_scheme="dark")
    until(page, f"({DRAWN})('#2b343c') && ({DRAWN})('#6ea8e6') && !({DRAWN})('#e3e7eb')")
    page.emulate_media(color_scheme="light")
    until(page, f"({DRAWN})('#e3e7eb') && !({DRAWN})('#2b343c')")
    page.dblclick("#strips .u-over >> nth=0")
    assert page.evaluate("ambidConsole.feed.zoom") is None
    page.keyboard.press("Control+.")
    until(page, "ambidConsole.feed.over")
    assert (folder / "watched.h5").exists()
    assert page.inner_text("#lost") == "0 lost"
    assert wide(page) == 0


def test_a_change_is_found_and_accepted(page, folder):
    """A record of 20 kHz replayed as it was taken: k_i falls by 15 % after two seconds."""
    rig, record = folder / "unstable.toml", folder / "change.h5"
    rig.write_text(preset_text(preset("unstable-bearing")), encoding="utf-8")
    words = ["simulate", "unstable-bearing", "--scenario", "change", "-o", str(record), "--seed", "1"]
    subprocess.run([sys.executable, "-m", "ambid", *words], check=True, capture_output=True)
    found = identify(record, rig, to_s=1.5)
    found.save(folder / "before.json")
    page.reload()
    page.wait_for_selector("#list tr:has-text('unstable.toml')", state="attached")
    page.click("[data-tab=live]")
    page.select_option("#live-form [name=rig]", label="unstable.toml")
    page.select_option("#live-form [name=estimate]", label="before.json")
    page.select_option("#live-form [name=excitation]", label="none")
    page.fill("#live-form [name=port]", "replay:change.h5")
    page.fill("#live-form [name=out]", "followed")
    page.click("#live-form button.go")
    page.wait_for_selector("#events li:has-text('change: k_i changed')")
    page.wait_for_selector("#events li:has-text('accepted: k_i')")
    until(page, "ambidConsole.feed.over")
    value = page.evaluate("ambidConsole.feed.lines.at(-1).values.k_i[0]")
    assert value == pytest.approx(0.85 * found["k_i"].value, rel=0.01)


def test_a_bearing_of_a_ledger_is_drawn_over_time_in_chosen_colours(page, folder):
    pytest.importorskip("sqlalchemy", reason="the extra [fleet] is not installed")
    from ambid.ledger import open_ledger
    from tests.ledger.entries import entry

    with open_ledger(folder / "works.db") as ledger:
        ledger.add(entry(k, name, verdict="unusable" if k == 2 else "usable") for k in range(4) for name in "AB")
    page.click("[data-tab=files]")
    page.click("#list tr:has-text('works.db')")
    page.wait_for_selector("#history-view h2:has-text('A: Usable')")
    page.select_option("#history-form [name=bearing]", "B")
    page.wait_for_selector("#history-view h2:has-text('B: Usable')")
    assert page.locator("#history-charts .chart").count() == 2
    assert page.inner_text("#history-charts .chart:has-text('k_i') h3 span") == "79.70 ± 0.50 N/A, 2026-01-04"
    page.hover("#history-charts .u-over >> nth=0", position={"x": 300, "y": 40})
    page.select_option("#theme", "dark")
    page.reload()
    assert page.evaluate("document.documentElement.hasAttribute('data-dark') && $('history').hidden === false")
    page.select_option("#theme", "")
    page.focus("[data-tab=history]")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    assert page.locator("#commission").is_visible()
    assert wide(page) == 0


EMULATED = [
    pytest.mark.long, pytest.mark.skipif(shutil.which("avr-gcc") is None, reason="no avr-gcc: apt-get install gcc-avr")
]  # fmt: skip


@pytest.mark.parametrize("port", ["simulated", pytest.param("emulated", marks=EMULATED)])
def test_commissioning_asks_and_ends_with_its_report(page, folder, port):
    until(page, "!state.runs.some((r) => r.alive)")
    page.click("[data-tab=commission]")
    page.select_option("#commission-form [name=rig]", label="rig.toml")
    page.fill("#commission-form [name=seconds]", "4")
    page.fill("#commission-form [name=port]", port)
    page.fill("#commission-form [name=out]", port)
    page.click("#commission-form button.go")
    if port == "emulated":  # a controller of its own, as far as the page knows
        page.click("dialog[open] button:text-is('Start')")
    page.wait_for_selector("dialog[open] p:has-text('Next step: polarity')")
    assert page.locator("[data-say]:disabled").count() == 4
    (process,) = [r.place / "process.json" for r in Runs(folder).all() if r.alive]
    number = json.loads(process.read_text(encoding="utf-8"))["pid"]
    os.kill(number, signal.SIGSTOP)
    try:
        page.wait_for_selector("#banner:has-text('OLD: the run has been silent')")
    finally:
        os.kill(number, signal.SIGCONT)
    page.wait_for_selector("#banner", state="hidden")
    page.click("dialog[open] button[value=go]")
    page.wait_for_selector("#steps a:has-text('report.html')", timeout=4 * LONG_MS)
    assert page.locator("#steps > li .usable").count() >= 7
    assert "null" not in page.inner_text("#steps")
    assert page.locator("#commission-form").is_visible()  # which gave its room while it ran
    assert (folder / port / "report.html").exists()
