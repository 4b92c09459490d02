"""Stop in a browser: whatever is open, frozen, dead or full, it is clicked, and says whether the run took it."""

import json
import os
import shutil
import signal
import time

import pytest

from ambid.console.runs import Runs
from ambid.job import acquire, identify
from tests.console.browser import NEEDED, SIZES, chromium
from tests.console.pages import LIVE, console, over, pid_of, prototype_rig, until

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytestmark = NEEDED
WISH = {**LIVE, "estimate": "start.json"}


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def estimate(tmp_path_factory):
    """What tracking starts from at once; without one it takes the first five seconds."""
    made = tmp_path_factory.mktemp("start")
    prototype_rig(made)
    words = {"seconds": 5.0, "excitation": "multisine", "amplitude": 1.4}
    record = acquire("simulated", made / "rig.toml", made / "start.h5", **words).record
    identify(record, made / "rig.toml").save(made / "start.json")
    return made / "start.json"


@pytest.fixture
def folder(tmp_path, estimate):
    prototype_rig(tmp_path)
    shutil.copy(estimate, tmp_path)
    return tmp_path


def live(folder, name="run.h5", **more):
    run = Runs(folder).start({**WISH, "out": name, **more})
    assert until(run, "line")
    return run


def following(browser, link, *size):
    """A page that shows a run that tracks."""
    page = browser.open(link, *size)
    page.until("feed?.following && feed.lines.length > 5")
    return page


def pressed(page, press):
    """Press Stop; what the page says first of what became of it. `bench/console_faults.py` measures how soon."""
    page.place("#stop")
    page.evaluate(
        """(() => { window.said = null; const host = $("delivery");
        new MutationObserver(() => { if (["good", "bad"].includes(host.className)) said ??= host.textContent; })
        .observe(host, { attributes: true, childList: true }); })()"""
    )
    press()
    return page.until("window.said", 5.0)


PRESSES = {
    "mouse": lambda page: page.click("#stop"), "touch": lambda page: page.click("#stop", tap=True),
    "ctrl and point": lambda page: page.key(".", ctrl=True),
    "escape twice": lambda page: [page.key("Escape") for _ in range(2)],
    "enter": lambda page: (page.evaluate("$('stop').focus()"), page.key("Enter")),
}  # fmt: skip


@pytest.mark.parametrize("size", SIZES, ids=[f"{w}x{h}" for w, h in SIZES])
def test_stop_is_clicked_beside_every_question(browser, folder, size):
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link, size)
        page.click("[data-say=accept]")
        page.until("!$('ask').hidden")
        assert page.wide() == 0
        page.click("[data-say=hold]")  # the page goes on beside the question
        page.with_text("#events li", "order: hold")
        assert "± " in page.text("#question table")
        if size[0] < 800:
            page.resize(*size, touch=True)
        said = pressed(page, lambda: page.click("#stop", tap=size[0] < 800))
        assert said.startswith("Stop delivered after")
        assert over(run)
        assert page.wrong == []
        browser.close(page)


@pytest.mark.parametrize("press", PRESSES)
def test_stop_is_pressed_in_every_way_while_a_commissioning_asks(browser, folder, press):
    run = Runs(folder).start({"job": "commission", "rig": "rig.toml", "port": "simulated", "seconds": 4.0, "out": "c"})
    with console(folder) as served:
        page = browser.open(served.link)
        page.with_text("#question", "Next step: polarity")
        page.evaluate("$('yes').focus()")
        said = pressed(page, lambda: PRESSES[press](page))
        assert said.startswith("Stop delivered after"), said
        assert over(run)
        assert page.evaluate("$('ask').hidden")
        assert page.wrong == []
        browser.close(page)


def test_stop_says_that_a_frozen_run_did_not_take_it_and_that_it_did_later(browser, folder):
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link)
        os.kill(pid_of(run), signal.SIGSTOP)
        try:
            said = pressed(page, lambda: page.click("#stop"))
            page.with_text("#banner", "OLD: the run has been silent")
        finally:
            os.kill(pid_of(run), signal.SIGCONT)
        assert "NOT DELIVERED: use the emergency stop" in said
        page.with_text("#delivery", "Stop delivered after")
        assert over(run)
        browser.close(page)


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
def test_stop_says_that_a_server_does_not_answer(browser, folder, blow):
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link)
        served.process.send_signal(blow)
        said = pressed(page, lambda: page.click("#stop"))
        assert "NOT DELIVERED: use the emergency stop" in said
        page.with_text("#banner", "OLD: the console does not answer")
        browser.close(page)
    run.say("stop")
    assert over(run)


def test_stop_is_delivered_where_the_disk_takes_no_order_and_samples_are_lost(browser, folder):
    resource = pytest.importorskip("resource", reason="the system has no limits of a process")
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link)
        page.evaluate(  # as envelopes of a run that lost seven samples are
            "(() => { const show = feed.envelope.bind(feed); feed.envelope = (data, at) => { "
            "new DataView(data).setBigUint64(at + 8, 7n, true); show(data, at); }; })()"
        )
        page.until("$('lost').textContent === '7 samples LOST'")
        page.click("[data-say=hold]")  # a lost sample takes no control away
        page.with_text("#events li", "order: hold")
        resource.prlimit(served.process.pid, resource.RLIMIT_FSIZE, (8192, 8192))  # the lease alone may be written
        with (run.place / "control.jsonl").open("ab") as file:
            file.write(b" " * 9000)
        page.click("[data-say=track]")
        page.with_text("#banner", "track: nothing was done: the folder of the runs cannot be written: the disk is full")
        said = pressed(page, lambda: page.click("#stop"))
        assert said.startswith("Stop delivered after")
        assert over(run)
        browser.close(page)


def test_stop_is_not_taken_for_delivered_by_what_an_old_run_tells_and_its_end_is_awaited(browser, folder):
    old = live(folder, "old.h5")
    old.say("stop")
    assert over(old)
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link)
        os.kill(pid_of(run), signal.SIGSTOP)
        try:
            page.evaluate(f"stopAll(); watch(state.runs.find((r) => r.id === '{old.id}'))")
            page.until("feed.over")
            page.with_text("#delivery", "NOT DELIVERED: use the emergency stop")
        finally:
            os.kill(pid_of(run), signal.SIGCONT)
        assert over(run)
        for off, alive, words in ((False, True, "took Stop"), (False, False, "is over"), (True, True, None)):
            run = {"id": "1", "alive": alive, "off": off, "spec": {"job": "live"}}
            page.evaluate(
                "window.fetch = async (path) => Response.json(path === '/api/stop' ? { runs: ['1'], delivered: true } "
                f": {{ runs: [{json.dumps(run)}] }}); stopAll()"
            )
            lacks = (
                f"The run {words}, and its device has not confirmed that its output is off. If the rotor still moves"
            )
            page.with_text("#delivery", "output off after" if off else lacks)
        browser.close(page)


def test_stop_while_a_run_is_about_to_begin_stops_it(browser, folder):
    with console(folder) as served:
        page = browser.open(served.link)
        page.until("document.querySelector('#live-form [name=rig]').options.length > 0")
        page.evaluate("document.querySelector('#live-form button.go').click(); stopAll()")
        page.with_text("#delivery", "Stop delivered after")
        (run,) = Runs(folder).all()
        assert over(run)
        assert not (folder / run.spec["out"]).exists()
        browser.close(page)


def test_old_pages_order_nothing_and_a_run_that_wakes_refuses_what_waited(browser, folder):
    run = live(folder)
    with console(folder) as served:
        page = following(browser, served.link)
        page.click("[data-say=accept]")
        os.kill(pid_of(run), signal.SIGSTOP)
        try:
            beat = page.evaluate("feed.beat")
            run.say("accept", beat=beat, until=time.monotonic() + 0.6)  # as a page that has not noticed yet
            page.with_text("#banner", "OLD:")
            assert page.evaluate("$('yes').disabled")
            assert page.count("[data-say]:disabled") == 4
        finally:
            os.kill(pid_of(run), signal.SIGCONT)
        seen = until(run, "order")
        assert [(m["word"], m["done"]) for m in seen if m["kind"] == "order"] == [("accept", False)]
        page.with_text("#events li", "refused: accept")
        page.until("!$('yes').disabled")
        page.click("#yes")
        page.with_text("#events li", "accepted: the present estimate")
        page.until("(window.n ??= feed.lines.length) + 4 < feed.lines.length")
        page.click("[data-say=revert]")
        page.until("$('question').innerText.includes('after revert') && !$('yes').disabled")
        page.click("#yes")
        page.with_text("#events li", "reverted: by order of the operator")
        said = pressed(page, lambda: page.click("#stop"))
        assert "delivered" in said
        assert over(run)
        assert page.wrong == []
        browser.close(page)


def test_two_pages_share_one_right_that_is_taken_over_told_and_given_back(browser, folder):
    run = live(folder)
    with console(folder) as one, console(folder) as two:
        first, second = browser.open(one.link), browser.open(two.link)
        for page in (first, second):
            page.until("feed?.following && feed.lines.length > 5")
        first.click("[data-say=hold]")
        first.with_text("#driver", "this page orders the run")
        second.with_text("#driver", f"of the console at {one.host} orders the run")
        assert second.count("[data-say]:disabled") == 4
        second.click("#driver button")
        second.until("$('question').innerText.includes('Take over?')")
        second.click("#yes")
        first.with_text("#banner", f"of the console at {two.host} took over")
        assert first.count("[data-say]:disabled") == 4
        second.click("[data-say=track]")
        first.with_text("#events li", "order: track")
        browser.close(second)
        began = time.monotonic()
        first.with_text("#driver", "no page orders the run")
        assert time.monotonic() - began < 4.0
        first.click("[data-say=hold]")
        first.with_text("#driver", "this page orders the run")
        said = pressed(first, lambda: first.click("#stop"))
        assert said.startswith("Stop delivered")
        assert over(run)
        assert first.wrong == []
        browser.close(first)
