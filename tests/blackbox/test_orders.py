"""Orders are read by one set of rules: every structure refuses the same things in the same words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.blackbox.data import check_length, check_order_names, compact_order, left_open, order_per_input, single_order
from ambid.blackbox.fit import STRUCTURES, Structure
from ambid.errors import EstimationError
from tests.blackbox import systems

ALL = list(STRUCTURES.values())
_PER_INPUT = ("nb", "nf", "nk")


def refusal(s: Structure, orders: dict[str, object]) -> str:
    data = systems.open_loop(inputs=s.inputs)
    with pytest.raises(EstimationError) as caught:
        s.estimator(data, orders)
    return str(caught.value)


def usual(s: Structure) -> dict[str, object]:
    return dict(systems.orders_for(s.name, s.orders))


@pytest.mark.parametrize("s", ALL, ids=[s.name for s in ALL])
def test_every_structure_refuses_what_is_no_order(s: Structure) -> None:
    one = s.orders[0]
    for wrong in (-1, 1.5, True, "later"):
        said = refusal(s, {**usual(s), one: wrong})
        assert said.split(":")[0] in STRUCTURES  # its own name, or that of the one it starts from
        assert f"{one} = {wrong!r}; it must be a whole number of at least" in said
    said = refusal(s, {**usual(s), "nz": 1})
    assert f": order 'nz' is unknown; it takes {one}" in said
    assert "Did you mean" in said


NEEDY = [s for s in ALL if s.kind != "state space"]


@pytest.mark.parametrize("s", NEEDY, ids=[s.name for s in NEEDY])
def test_every_structure_names_a_missing_order_and_one_that_it_cannot_choose(s: Structure) -> None:
    for name in s.orders:
        if name == "nk":
            continue
        rest = {k: v for k, v in usual(s).items() if k != name}
        assert f"{s.name}: order {name} is missing; it takes {', '.join(s.orders)}. Give {name}=1" in refusal(s, rest)
        said = refusal(s, {**rest, name: "auto"})
        assert f"{name} = 'auto'" in said
        assert "cannot choose it; give a number" in said


COUNTED = [
    (s, name) for s in ALL for name in s.orders if name in _PER_INPUT and (s.kind, name) != ("transfer function", "nf")
]


@pytest.mark.parametrize(("s", "name"), COUNTED, ids=[f"{s.name} {name}" for s, name in COUNTED])
def test_every_structure_counts_the_numbers_for_its_inputs(s: Structure, name: str) -> None:
    assert f"order {name} has 2 numbers for 1 input." in refusal(s, {**usual(s), name: (1, 1)})


def test_a_delay_may_be_left_open_in_two_ways() -> None:
    assert left_open({}, "nk")
    assert left_open({"nk": "auto"}, "nk")
    assert not left_open({"nk": 0}, "nk")


def test_numbers_are_spread_over_inputs_and_shown_as_one_where_they_agree() -> None:
    assert order_per_input("arx", {"nb": 2}, "nb", 1, 3) == (2, 2, 2)
    assert order_per_input("arx", {"nb": (1, np.int64(2))}, "nb", 1, 2) == (1, 2)  # type: ignore[dict-item]
    assert order_per_input("frf-ml", {"nf": 0}, "nf", 0, 1, each="pair") == (0,)
    assert single_order("arx", {"na": (2, 2)}, "na", 0) == 2
    assert compact_order((2, 2)) == 2
    assert compact_order((1, 2)) == (1, 2)
    with pytest.raises(EstimationError, match="must be one whole number"):
        single_order("arx", {"na": (1, 2)}, "na", 0)
    with pytest.raises(EstimationError, match=r"na = 0; it must be a whole number of at least 1\. Raise it"):
        single_order("arx", {"na": 0}, "na", 1, remedy="Raise it")


def test_known_orders_may_be_left_out() -> None:
    check_order_names("pbsid", {}, ("n",))
    with pytest.raises(EstimationError, match=r"Did you mean 'nf'\? Omit it"):
        check_order_names("oe", {"nff": 1}, ("nb", "nf", "nk"), ("nb",))


def test_records_that_are_too_short_or_stand_still_are_refused() -> None:
    data = systems.open_loop(inputs=True)
    check_length("iv4", data, 40, 10)
    with pytest.raises(EstimationError, match="at least 44 rows are needed and 40 are left"):
        check_length("iv4", data, 40, 11)
    with pytest.raises(EstimationError, match="at least 20 rows are needed and 0 are left"):
        check_length("iv4", data, -3, 1)
    with pytest.raises(EstimationError, match="is constant; it carries no information"):
        check_length("iv4", replace(data, u=np.ones_like(data.u)), 100, 2)
