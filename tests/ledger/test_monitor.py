"""Alarms over years: found with cause and date, none without a fault, none from what is not usable; rules; telling."""

from dataclasses import replace

import numpy as np
import pytest

import ambid
from ambid.errors import AmbidError
from ambid.ledger import RecordRule, Rule, open_ledger, read_rules, watch, write_metrics
from tests.ledger.entries import BEGIN, DAY, entry, parameter
from tests.ledger.simulated import BEGIN as START
from tests.ledger.simulated import MONTH_S, YEARS, bearing, fleet, judge

END = START + YEARS * 12 * MONTH_S


@pytest.fixture(scope="module")
def bearings():
    return fleet(24, 3)


@pytest.fixture(scope="module")
def watched(bearings):
    return watch((b.history for b in bearings), now=bearings[0].history.estimates[-1].taken_at)


def test_faults_are_found_with_cause_and_date_and_nothing_else(bearings):
    score = judge(bearings)
    assert score.due >= 6
    assert (score.found, score.false, score.cause) == (score.due, 0, score.due), score.wrong
    assert score.dated >= score.due - 1, score.wrong


def test_what_is_not_usable_raises_and_clears_nothing(bearings):
    def without(h, bad):
        return replace(h, series={n: replace(s, value=np.where(bad, np.nan, s.value)) for n, s in h.series.items()})

    aged = next(b for b in bearings if b.fault == "ageing magnet").history
    (alarm, *_) = watch([aged], now=END).alarms
    bad = np.array([e.taken_at >= alarm.at_from - 60 * DAY for e in aged.estimates])
    unseen = watch([without(aged, bad)], now=END).alarms  # all that would raise it is not usable
    assert {a.kind for a in unseen} == {"unseen"}
    bad = np.array([e.taken_at > alarm.raised for e in aged.estimates])
    standing = [a for a in watch([without(aged, bad)], now=END).alarms if a.rule == alarm.rule]
    assert [a.cleared for a in standing] == [None]


def test_an_alarm_is_cleared_where_the_level_comes_back():
    h = bearing("B", "", np.random.default_rng(2)).history
    s = h.series["k_i"]
    low = (s.taken_at > h.estimates[120].taken_at) & (s.taken_at < h.estimates[200].taken_at)
    h = replace(h, series={**h.series, "k_i": replace(s, value=np.where(low, 0.85 * s.value, s.value))})
    (alarm,) = watch([h], now=END).alarms
    assert (alarm.parameter, alarm.kind) == ("k_i", "step")
    assert alarm.at_from <= h.estimates[121].taken_at <= alarm.at_to
    assert h.estimates[200].taken_at < alarm.cleared < h.estimates[210].taken_at
    assert "no single cause that is known does that" in alarm.cause
    assert (
        "k_i alone of m, k_x, k_i, R, L moved, which rules out the magnet's bias flux (would move k_x by -28 %)"
        in alarm.cause
    )
    assert watch([h], now=END).passed


def test_with_a_held_mass_a_sensor_moves_what_the_record_shows():
    """Where the motion fixes k_i, a position that reads too large moves k_i alone, a current k_i, R and L."""
    h = bearing("B", "", np.random.default_rng(2)).history
    held = {**h.series, "m": replace(h.series["m"], role="fixed")}
    late = h.series["k_i"].taken_at > h.estimates[120].taken_at

    def cause(**powers):
        names = {n: replace(held[n], value=np.where(late, 1.12**p * held[n].value, held[n].value))
                 for n, p in powers.items()}  # fmt: skip
        return {a.cause for a in watch([replace(h, series={**held, **names})], [rule]).alarms}

    rule = Rule(parameter="k_i", change=0.05)
    (alone,) = cause(k_i=1)
    assert alone.startswith(
        "the position sensor's gain stepped: exchanged or damaged; k_i alone of k_x, k_i, R, L moved"
    )
    rule = Rule(parameter="k_i", change=-0.05)
    assert cause(k_i=-1, R=-1, L=-1) == {"the current sensor's gain stepped: exchanged or damaged"}
    flux, position = "the magnet's bias flux stepped: cracked or demagnetised", "the position sensor's gain stepped"
    (alike,) = cause(k_i=-1, k_x=-2)  # where the induced voltage fixes k_i
    assert flux in alike
    assert position in alike
    assert "not clear" in alike


def test_what_is_near_zero_has_no_relative_change():
    h = bearing("B", "", np.random.default_rng(5)).history
    s = h.series["L"]
    offset = replace(s, value=s.value - np.nanmean(s.value))
    found = watch([replace(h, series={"L": offset})], now=END)
    assert (found.alarms, found.trends) == ((), ())


def test_what_drifts_and_when_it_reaches_the_limit_is_told_with_intervals(tmp_path):
    rng, n = np.random.default_rng(4), 60
    ages = [parameter("k_i", 80.0 * (1 - 0.0008 * k + 0.002 * rng.standard_normal()), 0.16) for k in range(n)]
    flat = [parameter("m", 0.3 * (1 + 0.002 * rng.standard_normal()), 6e-4, unit="kg") for _ in range(n)]
    with open_ledger(tmp_path / "l.db") as ledger:
        ledger.add([entry(k, day=15 * k, parameters=(a, b)) for k, (a, b) in enumerate(zip(ages, flat, strict=True))])
        found = watch([ledger.history("A")], [Rule(parameter="k_i", change=-0.06), Rule(parameter="k_i", change=-0.5)])
    trends = {t.parameter: t for t in found.trends}
    assert trends["m"].kind == "none"
    k_i = trends["k_i"]
    assert k_i.kind == "drift"
    assert abs(k_i.per_month + 0.0008 * MONTH_S / (15.0 * DAY)) < 3.0 * k_i.per_month_sd
    assert set(k_i.limits) == {"k_i -6 %"}  # the other is further ahead than the history is long
    due = BEGIN + 75 * 15 * DAY
    early, late = k_i.limits["k_i -6 %"]
    assert early < due < late
    assert late - early < 400 * DAY


def test_results_are_told_and_come_back_from_their_file(watched, tmp_path):
    text = watched.summary(width=500)
    assert "the magnet ages: bias flux" in text
    assert "the rig was changed then (controller.version 1 became 2); the position sensor's gain stepped" in text
    assert watched.verdict.word == "caution"
    watched.save(tmp_path / "a.json")
    again = ambid.load(tmp_path / "a.json")
    assert again.alarms == watched.alarms
    assert (again.rules, again.records, again.states) == (watched.rules, watched.records, watched.states)
    assert len(watched.to_dataframe()) == len(watched.alarms)
    assert len(watched.plot().axes) > len(again.plot().axes) == 1


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("alarm = 3", "must hold tables [[alarm]] and [[records]]"),
        ("[[alarms]]\nparameter = 'k_i'", "Did you mean 'alarm'?"),
        ("[[alarm]]\nparameter = 'k_i'\nchange = '5 %'", "must be signed and in percent"),
        ("[[alarm]]\nparameter = 'k_i'\nchange = -0.05", "must be signed and in percent"),
        ("[[alarm]]\nparameter = 'k_i'\nchange = '-5 %'\nconfidence = 99", "between 0.5 and 1"),
        ("[[alarm]]\nparameter = 'k_i'\nchange = '-5 %'\nsince = 'begin'", '"start", "rig" or a date'),
        ("[[alarm]]\nparameter = 'k_i'\nchang = '-5 %'", "Did you mean 'change'?"),
        ("[[alarm]]\nchange = '-5 %'", "parameter must be a name"),
        ("[[alarm", "cannot be read"),
        ("[[alarm]]\nparameter = 'k_i'\nchange = '-5 %'\n" * 2, "the same thing twice"),
    ],
)
def test_rules_that_are_none_are_refused(tmp_path, text, said):
    (tmp_path / "r.toml").write_text(text)
    with pytest.raises(AmbidError) as refused:
        read_rules(tmp_path / "r.toml")
    assert said in str(refused.value)


def test_rules_are_read_and_name_what_is_there(tmp_path, bearings):
    text = (
        "[[alarm]]\nparameter = 'k_i'\nchange = '-5 %'\nsince = 2026-03-01\n[[alarm]]\nparameter='R'\nchange='+10%'\n"
    )
    (tmp_path / "r.toml").write_text(text)
    a, b, records = read_rules(tmp_path / "r.toml")
    assert records == RecordRule()
    assert (a.change, a.since, b.change, b.since) == (-0.05, 1772323200.0, 0.1, "start")
    assert [str(a), str(b)] == ["k_i -5 % since 2026-03-01T00:00", "R +10 %"]
    with pytest.raises(AmbidError, match="no bearing has a parameter 'k_y'"):
        watch([bearings[0].history], [Rule(parameter="k_y", change=0.1)])


def test_metrics_are_those_of_prometheus(watched, tmp_path):
    parser = pytest.importorskip("prometheus_client.parser", reason="prometheus-client is not installed")
    write_metrics(watched, tmp_path / "a.prom")
    families = parser.text_string_to_metric_families((tmp_path / "a.prom").read_text())
    found = {f.name: f.samples for f in families}
    assert len(found["ambid_parameter"]) == 5 * len(watched.bearings)
    assert sum(x.value for x in found["ambid_alarm"]) == len(watched.open)
