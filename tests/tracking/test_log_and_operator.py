import threading

import pytest

from ambid.errors import EstimationError
from ambid.recursive.lines import Event
from ambid.tracking.gate import DecisionLog, Operator


def event(t, kind="accepted"):
    return Event(kind=kind, t=t, why="because")


def test_the_log_counts_all_and_tells_them_on():
    heard = []
    log = DecisionLog(listener=heard.append)
    for k in range(10):
        log.add(event(float(k), "accepted" if k % 2 else "refused"))
    assert dict(log.counts) == {"accepted": 5, "refused": 5}
    assert [e.t for e in heard] == [float(k) for k in range(10)]


def test_the_log_takes_events_of_many_threads():
    log = DecisionLog()
    threads = [threading.Thread(target=lambda: [log.add(event(0.0)) for _ in range(500)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert log.counts["accepted"] == 2000


def test_flags_are_states_and_orders():
    operator = Operator()
    assert not operator.holding
    assert operator.set("hold", 1.5, "maintenance").why == "operator sets hold: maintenance"
    assert operator.holding
    assert "already" in operator.set("hold").why
    operator.set("track")
    assert not operator.holding
    ordered = operator.set("accept", 2.0)
    assert (ordered.kind, ordered.t) == ("operator", 2.0)
    assert operator.waiting == "accept"
    assert operator.take() == "accept"
    assert operator.take() is None


def test_wrong_and_opposite_flags_are_refused():
    operator = Operator()
    with pytest.raises(EstimationError, match=r"'holt'.*Did you mean 'hold'"):
        operator.set("holt")
    operator.set("revert")
    operator.set("revert")
    with pytest.raises(EstimationError, match="'revert' is still pending"):
        operator.set("accept")
    assert operator.take() == "revert"
    operator.set("accept")
    assert operator.waiting == "accept"


def test_an_order_is_taken_once_by_many_threads():
    operator, taken = Operator(), []
    for _ in range(50):
        operator.set("accept")
        threads = [threading.Thread(target=lambda: taken.append(operator.take())) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert sum(order == "accept" for order in taken) == 50
