"""The whole way in a browser, headless Chromium: a record, its rig, identification; a live bench; commissioning."""

import json
import os
import shutil
import signal
import subprocess
import sys

import pytest

from ambid import simulate
from ambid.console.runs import Runs
from ambid.job import identify, load
from ambid.physics.presets import preset
from ambid.record import write_record
from ambid.rig import preset_text
from tests.console.browser import NEEDED, SIZES, chromium
from tests.console.pages import console, prototype_rig

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytestmark = NEEDED
LONG_S = 90.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    made = tmp_path_factory.mktemp("page")
    prototype_rig(made)
    write_record(simulate("thesis", duration=0.5, seed=1), made / "rec.csv")
    return made


@pytest.fixture(scope="module")
def page(folder):
    with console(folder) as served, chromium() as browser:
        opened = browser.open(served.link)
        yield opened
        assert opened.wrong == []


# rows of tables: name, meaning, and the other cells
ROWS = """[...document.querySelectorAll("#detail .table tbody tr")].map((r) => [r.firstChild.firstChild.textContent,
r.firstChild.title, ...[...r.children].slice(1).map((c) => c.textContent)])"""

# whether the first strip has a colour
DRAWN = """((colour) => {
  const canvas = document.querySelector("#strips canvas");
  const bytes = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16));
  const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  for (let k = 0; k < data.length; k += 4) if (bytes.every((b, j) => Math.abs(data[k + j] - b) < 3)) return true;
  return false;
})"""


def test_a_record_becomes_an_estimate(page, folder):
    page.evaluate("document.querySelector('#list tbody tr[tabindex=\"0\"]').focus()")
    page.key("End")
    assert page.count("#list tbody tr[tabindex='0']") == 1  # one stop of Tab, whatever the number of files
    assert page.evaluate("document.activeElement.rowIndex") == page.count("#list tbody tr")
    page.click(page.with_text("#list tr", "rec.csv"))
    page.click(page.with_text("#detail button", "Identify"))
    assert page.evaluate("$('work').getBoundingClientRect().bottom <= innerHeight")  # wherever the form was
    page.until("document.querySelector('#detail h2:is(.usable, .caution, .unusable)')", LONG_S)
    assert page.text("#detail .report") == "rec-estimate.json is written; its report is being drawn."
    assert page.count("#detail .report a") == 0
    found = load(folder / "rec-estimate.json")
    assert page.count(f"#detail h2.{found.verdict.word}") == 1
    row = page.evaluate(f"{ROWS}.find((r) => r[0] === 'R')")
    assert row[1].startswith("coil resistance")  # where the pointer rests
    assert row[2:] == ["free", *row[3:6], "identified"]
    assert float(row[3].split(" ± ")[0]) == pytest.approx(found["R"].value, rel=1e-3)
    assert row[4].endswith(" ohm")
    assert "± is one standard deviation; intervals and bands are 95 %" in page.text("#detail")
    assert (folder / "rec-rig.toml").exists()
    address = page.until("document.querySelector('#detail .report a[href*=proof]')?.href", LONG_S)
    assert page.evaluate(f"fetch({json.dumps(address)}).then((a) => a.status)") == 200
    assert page.wide() == 0
    page.until("!$('work').childElementCount")
    page.click(page.with_text("#detail button", "Identify"))  # again: under the next name, and with the time left
    page.with_text("#work", "left", LONG_S)
    page.with_text("#detail .report", "rec-estimate-2", LONG_S)
    page.until("document.querySelector('#detail .report a') && !$('work').childElementCount", LONG_S)
    assert page.count("pre") == 0


def test_what_lies_in_the_folder_is_opened_by_a_click(page, folder):
    page.until("state.files.some((f) => f.name === 'rec-estimate.html')", LONG_S)
    page.click(page.with_text("#list tr", "rec-estimate.json"))
    page.with_text("#detail h2.result", "Usable", LONG_S)
    assert page.evaluate(f"{ROWS}.map((r) => r[0]).includes('k_x')")
    page.with_text("#detail .hint", "A design writes a rig")
    assert page.evaluate("[...document.querySelectorAll('#detail select option')].map((o) => o.text)[0]") == "rig.toml"
    rig = "([...document.querySelectorAll('#list tr')].find((r) => r.cells[0].textContent === 'rig.toml'))"
    page.click(rig)
    page.with_text("#detail h3", "channels.position")
    assert page.evaluate(f"{ROWS}.some((r) => r[0] === 'kp' && r[2] === '19415.0')")
    before = len(page.tabs())
    page.click(page.with_text("#list tr", "rec-estimate.html"))
    page.with_text("#detail a", "Open rec-estimate.html")
    page.wait(lambda: len(page.tabs()) == before + 1)
    page.send("Page.bringToFront")
    assert page.count("pre") == 0


def test_the_loop_of_an_estimate_is_judged_and_a_better_one_designed(page, folder):
    (folder / "axis.toml").write_text(preset_text(preset("rmit-axis")), encoding="utf-8")
    write_record(simulate("rmit-axis", duration=0.5, seed=1), folder / "axis.csv")
    identify(folder / "axis.csv", folder / "axis.toml").save(folder / "axis-known.json")
    page.until("state.files.some((f) => f.name === 'axis-known.json')", LONG_S)
    page.click(page.with_text("#list tr", "axis-known.json"))
    rigs = "[...document.querySelector('#detail select').options].find((o) => o.text === 'axis.toml')"
    page.until(rigs)
    page.evaluate(f"document.querySelector('#detail select').value = {rigs}.value")
    page.click(page.with_text("#detail button", "Margins"))
    page.with_text("#detail .report", "axis-known-margins", LONG_S)
    assert page.evaluate(f"{ROWS}.some((r) => r[2]?.endsWith(' dB'))")
    page.until("document.querySelector('#detail .report a') && document.querySelector('#detail img')", LONG_S)
    page.until("!$('work').childElementCount", LONG_S)
    page.click(page.with_text("#detail button", "Design a better loop"))
    page.with_text("#detail .report", "axis-known-design", 2 * LONG_S)
    page.until("document.querySelector('#detail .report a')", 2 * LONG_S)
    page.with_text("#list tr", "axis-known-design.toml")
    assert page.count("pre") == 0
    assert page.wide() == 0


def test_a_record_without_time_is_read_with_a_rate(page, folder):
    lines = (folder / "rec.csv").read_text(encoding="utf-8").splitlines()
    head = next(k for k, x in enumerate(lines) if x.startswith("time"))
    (folder / "untimed.csv").write_text("\n".join(x.partition(",")[2] for x in lines[head:]), encoding="utf-8")
    page.click(page.with_text("#list tr", "untimed.csv"))
    page.with_text("#detail .refused", "or give Rate", LONG_S)
    page.put("#detail input[type=number]", "5000")
    page.click(page.with_text("#detail button", "Read again"))
    page.with_text("#detail button", "Identify", LONG_S)
    assert "rate_hz = 5000" in page.evaluate("document.querySelector('#detail textarea').value")


def test_a_live_bench_is_watched_held_frozen_and_stopped(page, folder):
    page.click("[data-tab=live]")
    page.put("#live-form [name=rig]", "rig.toml")
    page.put("#live-form [name=amplitude]", "1.4")
    page.put("#live-form [name=out]", "watched")
    page.click("#live-form button.go", times=2)  # a double click is one run
    page.until("document.querySelector('#parameters .chart:nth-child(5)')", LONG_S)
    page.until("ambidConsole.feed.lines.length > 3")
    page.click("[data-say=hold]")
    page.until("$('state').textContent === 'hold'")
    page.click("[data-say=accept]")
    page.click("#no")
    assert len([r for r in Runs(folder).all() if r.spec["job"] == "live"]) == 1
    page.click("#freeze")
    page.evaluate("(() => { const back = document.getElementById('back'); back.value = 300; back.oninput(); })()")
    assert page.evaluate("ambidConsole.feed.window()[1] <= ambidConsole.feed.t.at(-1)")
    page.drag("#strips .u-over", 60, 180)
    shown = "(() => { const f = ambidConsole.feed, s = f.error.plot.scales.x; return [s.min, s.max, ...f.zoom]; })()"
    page.until(f"{shown}[0] === {shown}[2] && {shown}[1] === {shown}[3]")  # parameters over the same stretch
    page.dark(on=True)
    page.until(f"{DRAWN}('#2b343c') && {DRAWN}('#6ea8e6') && !{DRAWN}('#e3e7eb')")
    page.dark(on=False)
    page.until(f"{DRAWN}('#e3e7eb') && !{DRAWN}('#2b343c')")
    page.click("#strips .u-over", times=2)
    page.until("ambidConsole.feed.zoom === null")
    page.key(".", ctrl=True)
    page.until("ambidConsole.feed.over")
    assert (folder / "watched.h5").exists()
    assert page.text("#lost") == "0 lost"
    assert page.wide() == 0


def test_a_change_is_found_and_accepted(page, folder):
    """A record of 20 kHz replayed as it was taken: k_i falls by 15 % after two seconds."""
    rig, record = folder / "unstable.toml", folder / "change.h5"
    rig.write_text(preset_text(preset("unstable-bearing")), encoding="utf-8")
    words = ["simulate", "unstable-bearing", "--scenario", "change", "-o", str(record), "--seed", "1"]
    subprocess.run([sys.executable, "-m", "ambid", *words], check=True, capture_output=True)
    identify(record, rig, to_s=1.5).save(folder / "before.json")
    page.reload()
    page.with_text("#list tr", "unstable.toml")
    page.click("[data-tab=live]")
    page.put("#live-form [name=rig]", "unstable.toml")
    page.put("#live-form [name=estimate]", "before.json")
    page.put("#live-form [name=excitation]", "none")
    page.put("#live-form [name=port]", "replay:change.h5")
    page.put("#live-form [name=out]", "followed")
    page.click("#live-form button.go")
    page.with_text("#events li", "change: k_i changed", LONG_S)
    page.with_text("#events li", "accepted: k_i", LONG_S)
    page.until("ambidConsole.feed.over", LONG_S)
    value = page.evaluate("ambidConsole.feed.lines.at(-1).values.k_i[0]")
    assert value == pytest.approx(0.85 * load(folder / "before.json")["k_i"].value, rel=0.01)


def test_a_bearing_of_a_ledger_is_drawn_over_time_in_chosen_colours(page, folder):
    pytest.importorskip("sqlalchemy", reason="the extra [fleet] is not installed")
    from ambid.ledger import open_ledger
    from tests.ledger.entries import entry

    with open_ledger(folder / "works.db") as ledger:
        ledger.add([entry(k, name, verdict="unusable" if k == 2 else "usable") for k in range(4) for name in "AB"])
    page.reload()
    page.click("[data-tab=files]")
    page.click(page.with_text("#list tr", "works.db"))
    page.with_text("#history-view h2", "A: Usable")
    page.put("#history-form [name=bearing]", "B")
    page.with_text("#history-view h2", "B: Usable")
    assert page.count("#history-charts .chart") == 2
    latest = page.with_text("#history-charts .chart h3", "k_i") + ".querySelector('.value').textContent"
    assert page.evaluate(latest) == "79.70 ± 0.50 N/A, 2026-01-04"
    page.hover("#history-charts .u-over", 300, 40)
    page.put("#theme", "◐ dark")
    page.reload()
    assert page.evaluate("document.documentElement.hasAttribute('data-dark') && $('history').hidden === false")
    page.put("#theme", "◐ auto")
    page.evaluate("document.querySelector('[data-tab=history]').focus()")
    page.key("ArrowLeft")
    page.key("Enter")
    page.until("!$('commission').hidden")
    assert page.wide() == 0


EMULATED = [
    pytest.mark.long, pytest.mark.skipif(shutil.which("avr-gcc") is None, reason="no avr-gcc: apt-get install gcc-avr")
]  # fmt: skip


@pytest.mark.parametrize("port", ["simulated", pytest.param("emulated", marks=EMULATED)])
def test_commissioning_asks_and_ends_with_its_report(page, folder, port):
    page.until("!state.runs.some((r) => r.alive)")
    page.click("[data-tab=commission]")
    page.put("#commission-form [name=rig]", "rig.toml")
    page.put("#commission-form [name=seconds]", "4")
    page.put("#commission-form [name=port]", port)
    page.put("#commission-form [name=out]", port)
    page.click("#commission-form button.go")
    if port == "emulated":  # a controller of its own, as far as the page knows
        page.click("#yes")
    page.with_text("#question p", "Next step: polarity", LONG_S)
    assert page.count("[data-say]:disabled") == 4
    (process,) = [r.place / "process.json" for r in Runs(folder).all() if r.alive]
    number = json.loads(process.read_text(encoding="utf-8"))["pid"]
    os.kill(number, signal.SIGSTOP)
    try:
        page.with_text("#banner", "OLD: the run has been silent")
        assert page.evaluate("$('yes').disabled")
    finally:
        os.kill(number, signal.SIGCONT)
    page.until("$('banner').hidden")
    page.click("#yes")
    page.with_text("#work", "of 9", LONG_S)  # in view, of the whole run
    page.with_text("#steps a", "report.html", 3 * LONG_S)
    assert page.count("#steps > li .usable") >= 7
    assert "null" not in page.text("#steps")
    assert page.evaluate("[...document.querySelectorAll('#steps td')].some((c) => / dB$/.test(c.textContent))")
    assert page.count("pre") == 0
    page.until("!$('commission-form').hidden && !$('work').childElementCount")  # which gave its room while it ran
    assert (folder / port / "report.html").exists()


# texts that stand out too little from what is behind them, with the ratio of WCAG 2.2
FAINT = """(() => {
  const light = (c) => c.map((v) => v / 255).map((v) => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, k) => sum + [0.2126, 0.7152, 0.0722][k] * v, 0);
  const rgb = (text) => text.match(/[\\d.]+/g).map(Number), behind = (e) => {
    for (; e; e = e.parentElement) {
      const [r, g, b, a = 1] = rgb(getComputedStyle(e).backgroundColor);
      if (a > 0.99) return [r, g, b];
    }
    return [255, 255, 255];
  };
  return [...document.querySelectorAll("body *")].filter((e) => !e.closest(":disabled") && e.checkVisibility()
    && [...e.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim())).map((e) => {
    const [low, high] = [light(rgb(getComputedStyle(e).color).slice(0, 3)), light(behind(e))].sort((a, b) => a - b);
    return [e.textContent.trim().slice(0, 40), (high + 0.05) / (low + 0.05)];
  }).filter(([, ratio]) => ratio < 4.5);
})()"""


@pytest.mark.parametrize("on", [False, True], ids=["light", "dark"])
def test_every_page_can_be_read_in_four_sizes(page, on):
    page.dark(on=on)
    try:
        for width, height in SIZES:
            page.resize(width, height)
            for tab in ("files", "live", "commission", "history"):
                page.evaluate(f"show('{tab}')")
                assert page.evaluate(FAINT) == []
                assert page.wide() == 0
    finally:
        page.dark(on=False)
        page.resize(1366, 768)


def test_a_report_that_fails_is_told_beside_the_result(page):
    content = {"verdict": "usable", "reasons": [], "title": "rec", "subtitle": "", "warnings": [], "sections": [],
               "spread": ""}  # fmt: skip
    frames = [{"kind": "result", "name": "rec", "content": content}, {"kind": "report", "why": "no room for a legend"}]
    page.evaluate("show('files')")
    page.evaluate(
        "import('/static/files.js').then(({ results }) => { for (const m of "
        f"{json.dumps(frames)}) results(m, $('detail')); }})"
    )
    page.with_text("#detail .report.caution", "no room for a legend")
    assert page.text("#detail h2") == "Usable"


def test_an_empty_folder_says_what_is_to_be_done(tmp_path):
    with console(tmp_path) as served, chromium() as browser:
        page = browser.open(served.link)
        page.with_text("#list td", "Copy a record into it")
        page.with_text("#runs td", "Nothing was started here yet")
        page.evaluate("show('commission')")
        assert page.text("#commission-form [name=rig]") == "no rig with [loop] yet"
        assert page.evaluate("$('commission-form').elements.redesign.disabled")  # on a simulated bench
        page.put("#commission-form [name=port]", "emulated")
        assert not page.evaluate("$('commission-form').elements.redesign.disabled")
        assert page.wrong == []
