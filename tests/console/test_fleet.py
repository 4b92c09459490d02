"""The page of a fleet, in headless Chromium."""

import time

import pytest

from ambid.console.runs import Runs
from tests.console.browser import NEEDED, SIZES, chromium
from tests.console.pages import console
from tests.ledger.entries import BEGIN, DAY, entry, parameter

pytest.importorskip("uvicorn", reason="the extra [console] is not installed")
pytest.importorskip("sqlalchemy", reason="the extra [fleet] is not installed")
pytestmark = NEEDED


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from ambid.ledger import open_ledger

    made, today = tmp_path_factory.mktemp("fleet"), (time.time() - BEGIN) / DAY
    with open_ledger(made / "works.db") as ledger:
        for name, last_d, worst in (("good", 0.1, "usable"), ("late", 9.0, "usable"), ("ill", 0.1, "unusable")):
            ledger.add(
                [entry(k, name, verdict="usable" if k < 7 else worst, day=today - last_d - 7 + k) for k in range(8)]
            )
        steps = [parameter("k_i", 80.0 - 8.0 * (k > 14) + 0.05 * (-1) ** k, 0.3) for k in range(30)]
        ledger.add([entry(k, "worn", parameters=(p,), day=today - 29.5 + k) for k, p in enumerate(steps)])
    with open_ledger(made / "empty.db"):
        pass
    return made


@pytest.fixture(scope="module")
def page(folder):
    with console(folder) as served, chromium() as browser:
        opened = browser.open(served.link)
        yield opened
        assert opened.wrong == []


def test_a_fleet_is_sorted_filtered_and_leads_to_histories(page, folder):
    page.click("[data-tab=fleet]")
    page.put("#fleet-form [name=ledger]", "works.db")
    page.until("document.querySelectorAll('#fleet-view tbody tr').length === 4")
    order = "[...document.querySelectorAll('#fleet-view tbody tr')].map((r) => r.cells[0].innerText)"
    assert page.evaluate(order) == ["worn", "ill", "late", "good"]  # the gravest first
    assert "9 d, stale" in page.text("#fleet-view")
    assert "rule k_i -5 %" in page.text("#fleet-view")
    page.click("[data-sort='0']")
    assert page.evaluate(order) == ["good", "ill", "late", "worn"]
    page.click("[data-sort='0']")
    assert page.evaluate(order)[0] == "worn"
    page.put("#fleet-form [name=state]", "stale")
    assert page.evaluate(order) == ["late"]
    page.put("#fleet-form [name=state]", "all")
    page.put("#fleet-form [name=find]", "nothing of that name")
    assert page.text("#fleet-view [role=status]").startswith("0 of 4 bearings")
    page.put("#fleet-form [name=find]", "wo")
    for size in SIZES:
        page.resize(*size)
        assert page.wide() == 0
    page.resize(*SIZES[2])
    page.click("#fleet-view tbody td:nth-child(3)")
    page.with_text("#history-view h2", "worn: Usable")
    assert not Runs(folder).all()  # a look is no run


def test_an_empty_ledger_has_words(page):
    page.click("[data-tab=fleet]")
    page.put("#fleet-form [name=ledger]", "empty.db")
    page.with_text("#fleet-view", "The ledger has no bearing yet")
    page.click("#fleet-form .go")
    page.with_text("#fleet-view", "The ledger has no bearing yet")
    assert page.count("#fleet-view table") == 0
