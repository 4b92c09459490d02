import threading

import pytest

from ambid.errors import EstimationError
from ambid.tracking.gate import Operator


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
