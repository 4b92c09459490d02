"""Laws of lower order: the promised error, what is kept, and the loop that they close."""

import numpy as np
import pytest

from ambid.control.knobs import Family
from ambid.control.lqg import lqg, reduced
from ambid.errors import ModelError
from tests.control.test_lqg import of_preset, weights_of


@pytest.fixture(scope="module")
def flexible():
    bench, plant = of_preset("utrc")
    weights = weights_of(bench)
    law = lqg(plant, weights, bench.noise).law
    return plant, law, np.tile([weights.position, weights.current], len(plant.axes)), weights.command


def error(a, b, largest, command):
    f = np.concatenate([np.geomspace(0.1, 9990.0, 300), np.linspace(100.0, 3000.0, 300)])
    return np.max(np.linalg.norm((a.response(f) - b.response(f)) * largest / command, ord=2, axis=(1, 2)))


@pytest.mark.parametrize("order", [36, 30, 20])
def test_error_is_within_its_bound(flexible, order):
    _, law, largest, command = flexible
    small, bound = reduced(law, order, largest, command)
    assert small.order == order
    found = error(law, small, largest, command)
    assert found <= bound * (1.0 + 1e-6) + 1e-9
    integrals = np.sort(np.abs(np.linalg.eigvals(small.A) - 1.0))[:4]
    assert np.max(integrals) < 1e-9  # of the four axes


def test_commands_on_their_way_cost_no_state(flexible):
    plant, law, largest, command = flexible
    small, bound = reduced(law, law.order - 4, largest, command)
    assert bound < 1e-6
    family = Family(plants=(plant,))
    assert np.max(family.peaks(small)) == pytest.approx(np.max(family.peaks(law)), rel=1e-5)
    assert family.poles(small)[0] == pytest.approx(family.poles(law)[0], abs=1e-8)


def test_a_loop_with_a_third_fewer_states_is_nearly_the_same(flexible):
    plant, law, largest, command = flexible
    small, _ = reduced(law, 26, largest, command)
    family = Family(plants=(plant,))
    assert family.poles(small)[0] < 1.0
    assert np.max(family.peaks(small)) < 1.1 * np.max(family.peaks(law))


def test_integrals_are_not_left_out(flexible):
    _, law, largest, command = flexible
    with pytest.raises(ModelError, match="4 integrals and growing modes"):
        reduced(law, 3, largest, command)
    assert reduced(law, 99, largest, command) == (law, 0.0)
