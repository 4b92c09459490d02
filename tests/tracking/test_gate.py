import dataclasses

import numpy as np
import pytest

from ambid.errors import EstimationError
from ambid.tracking.gate import Gate
from tests.tracking.evidences import evidence, triangle

P5 = tuple(f"q{i}" for i in range(5))
J = triangle(5, 1, condition=100.0)
INFORMATION = J.T @ J  # of one block


def estimate(truth, blocks, rng):
    """What a fit to so many blocks gives, with its covariance."""
    P = np.linalg.inv(blocks * INFORMATION)
    return truth + np.linalg.cholesky(P) @ rng.normal(size=5), P


def gate_at(truth, rng, blocks=200, **settings):
    q, P = estimate(truth, blocks, rng)
    return Gate(P5, start=q, covariance=P, **settings)


def judged(gate, truth, rng, n=400, *, J=J, noise=1.0):
    """The first event that is not None, and how many blocks it took."""
    for k in range(n):
        event = gate.judge(evidence(J, truth, k, rng, noise=noise), 0.005 * k)
        if event is not None:
            return event, k + 1
    return None, n


def moved(size):
    """A truth that is `size` standard deviations of four blocks away, in information."""
    d = np.array([1.0, -0.5, 0.3, 0.8, 0.1])
    return d * size / np.sqrt(4 * d @ INFORMATION @ d)


def share(n, run):
    return np.mean([run(np.random.default_rng(seed)) for seed in range(n)])


def test_a_right_candidate_passes():
    """Refused by two tests of 0.5 % each: 400 runs give at most 2.5 % in all but one case of ten thousand."""

    def refused(rng):
        truth = moved(12.0)
        gate = gate_at(np.zeros(5), rng)
        gate.propose(*estimate(truth, 20, rng), 1.0, "after a change")
        event, _ = judged(gate, truth, rng)
        assert (event.kind == "refused") == (gate.accepted.why == "at the start")
        return event.kind == "refused"

    assert share(400, refused) <= 0.025


def test_a_refinement_passes_although_it_is_not_told_from_the_accepted_numbers():
    def refused(rng):
        gate = gate_at(np.zeros(5), rng)
        gate.propose(*estimate(np.zeros(5), 400, rng), 1.0, "refined")
        return judged(gate, np.zeros(5), rng)[0].kind == "refused"

    assert share(400, refused) <= 0.025


@pytest.mark.parametrize("size", [8.0, 15.0, 100.0])
def test_a_wrong_candidate_does_not(size):
    """It claims a change with a small covariance; the data after it show none."""

    def accepted(rng):
        gate = gate_at(np.zeros(5), rng)
        gate.propose(estimate(moved(size), 400, rng)[0], np.linalg.inv(400 * INFORMATION), 1.0, "a claim")
        event, _ = judged(gate, np.zeros(5), rng)
        assert event.why.startswith("a claim: ")
        return event.kind == "accepted"

    assert share(300, accepted) <= 0.02


def test_a_candidate_that_is_better_and_wrong_all_the_same_is_refused_in_absolute_terms():
    rng = np.random.default_rng(1)
    truth = moved(60.0)
    gate = gate_at(np.zeros(5), rng)
    gate.propose(0.7 * truth, np.linalg.inv(400 * INFORMATION), 1.0, "on the way")
    event, _ = judged(gate, truth, rng)
    assert event.kind == "refused"
    assert "lack of fit" in event.why
    assert gate.last.gain > 0
    assert gate.last.misfit == event.values["misfit"]


def test_a_claim_has_to_predict_better_than_what_it_replaces():
    """The truth lies nearer to the accepted numbers: a loss of 11, where a right claim gains 36 with an sd of 12."""
    claim, rng = moved(6.0), np.random.default_rng(0)
    gate = Gate(P5, start=np.zeros(5), covariance=np.linalg.inv(200 * INFORMATION))
    gate.propose(claim, np.linalg.inv(400 * INFORMATION), 1.0, "a claim")
    event, _ = judged(gate, 0.35 * claim, rng, noise=0.0)
    assert event.kind == "refused"
    assert gate.last.gain == pytest.approx(-10.8, rel=1e-6)
    assert "predict better" in event.why


def test_a_claim_that_quiet_data_cannot_judge_waits_and_is_refused():
    rng = np.random.default_rng(2)
    gate = gate_at(np.zeros(5), rng, longest=50)
    gate.propose(*estimate(moved(12.0), 20, rng), 1.0, "a claim")
    event, n = judged(gate, moved(12.0), rng, J=J / 1000)
    assert (event.kind, n) == ("refused", 50)
    assert "do not distinguish" in event.why


def test_overdispersion_widens_what_chance_allows():
    def refused(rng, factor):
        gate = gate_at(np.zeros(5), rng, overdispersion=factor)
        gate.propose(*estimate(moved(25.0), 20, rng), 1.0, "after a change")
        worse = 2.0 * rng.normal(size=(50, 5))
        for k in range(50):
            e = evidence(J, moved(25.0), k, rng)
            event = gate.judge(dataclasses.replace(e, r=e.r + worse[k]), 0.0)
            if event is not None:
                return event.kind == "refused"
        raise AssertionError("no decision")

    assert share(100, lambda rng: refused(rng, 1.0)) > 0.3
    assert share(100, lambda rng: refused(rng, 5.0)) < 0.05


def test_a_wrong_acceptance_is_rolled_back():
    for seed in range(30):
        rng = np.random.default_rng(seed)
        gate = gate_at(np.zeros(5), rng)
        first = gate.accepted
        gate.propose(*estimate(moved(12.0), 20, rng), 1.0, "wrong")
        assert gate.accept(1.0).kind == "accepted"  # by order: the test does not stop it
        assert gate.on_probation
        event, n = judged(gate, np.zeros(5), rng)
        assert event.kind == "reverted"
        assert "predict better" in event.why
        assert n <= 32
        assert gate.accepted is first
        assert not gate.on_probation


def test_a_right_acceptance_is_not_rolled_back():
    def reverted(rng):
        gate = gate_at(np.zeros(5), rng)
        gate.propose(*estimate(np.zeros(5), 300, rng), 1.0, "refined")
        gate.accept(1.0)
        event, _ = judged(gate, np.zeros(5), rng, 250)
        assert not gate.on_probation
        return event is not None

    assert share(200, reverted) <= 0.01


def test_probation_goes_on_through_small_steps_and_reverts_to_what_was_before_all():
    rng = np.random.default_rng(3)
    gate = gate_at(np.zeros(5), rng)
    first = gate.accepted
    for step in range(1, 4):
        gate.propose(moved(6.0 * step), np.linalg.inv(20 * INFORMATION), float(step), "step")
        gate.accept(float(step))
    assert len(gate.history) == 4
    event, _ = judged(gate, np.zeros(5), rng)
    assert event.kind == "reverted"
    assert gate.accepted is first
    assert len(gate.history) == 1


def test_numbers_on_probation_that_moved_far_are_doubted_together_with_those_before_them():
    rng = np.random.default_rng(4)
    gate = gate_at(np.zeros(5), rng)
    before, (q, P) = gate.accepted, estimate(moved(12.0), 20, rng)
    far = (q - before.values) ** 2 > 9.0 * np.diag(before.covariance)
    assert 0 < far.sum() < 5
    gate.propose(q, P, 1.0, "after a change")
    gate.accept(1.0)
    np.testing.assert_allclose(gate.doubt(), far * (q - before.values), rtol=1e-12)
    np.testing.assert_allclose(gate.accepted.covariance, P + np.diag(far * (q - before.values) ** 2), rtol=1e-12)
    gate.restart()
    assert not gate.doubt().any()


def test_revert_goes_back_one_by_one_and_history_is_bounded():
    rng = np.random.default_rng(4)
    gate = gate_at(np.zeros(5), rng, kept=3, probation=0)
    assert gate.revert(0.5).kind == "refused"
    for step in range(6):
        gate.propose(np.full(5, float(step)), np.eye(5), float(step), f"step {step}")
        gate.accept(float(step))
    assert [a.t for a in gate.history] == [3.0, 4.0, 5.0]
    assert [gate.revert(9.0).kind for _ in range(3)] == ["reverted", "reverted", "refused"]
    assert gate.accepted.values == pytest.approx(np.full(5, 3.0))
    assert gate.revert().t == 3.0


def test_refinements_do_not_crowd_out_what_can_be_gone_back_to():
    rng = np.random.default_rng(9)
    gate, P = gate_at(np.zeros(5), rng, kept=4), np.linalg.inv(1000 * INFORMATION)
    start, n_accepted = gate.accepted, 0
    for k in range(2000):  # ten seconds, a decision every 20 ms; the truth moves after five
        truth = moved(15.0) if k >= 1000 else np.zeros(5)
        if not gate.pending:
            gate.propose(truth, P, 0.005 * k, "refined" if k != 1000 else "changed")
        event = gate.judge(evidence(J, truth, k, rng), 0.005 * (k + 1))
        if event is not None:
            assert event.kind != "reverted"
            n_accepted += event.kind == "accepted"
    assert n_accepted > 450
    times = np.array([a.t for a in gate.history])
    assert len(times) == 4
    assert times[-1] == pytest.approx(10.0, abs=0.1)
    assert np.all(np.diff(times)[:-1] >= 0.9)
    assert start not in gate.history
    # of a chain of refinements longer than what is kept, probation still goes back to what was before all of them
    gate = gate_at(np.zeros(5), rng, kept=4, apart_s=0.0)
    start = gate.accepted
    for step in range(1, 11):
        gate.propose(moved(2.0 * step), P, float(step), "step")
        gate.accept(float(step))
    assert start not in gate.history
    assert judged(gate, np.zeros(5), rng)[0].kind == "reverted"
    assert gate.accepted is start
    assert len(gate.history) == 1


def test_a_newer_candidate_takes_the_place_of_one_that_waits():
    rng = np.random.default_rng(5)
    gate = gate_at(np.zeros(5), rng)
    assert gate.propose(*estimate(np.zeros(5), 300, rng), 1.0, "first") is None
    gate.judge(evidence(J, np.zeros(5), 0, rng), 1.0)
    event = gate.propose(*estimate(np.zeros(5), 300, rng), 1.1, "second")
    assert (event.kind, event.t) == ("refused", 1.1)
    assert "first" in event.why
    assert judged(gate, np.zeros(5), rng)[0].why.startswith("second")
    assert not gate.pending


def test_the_comparison_is_that_of_the_losses():
    rng = np.random.default_rng(6)
    gate = gate_at(np.zeros(5), rng)
    a, (c, P) = gate.accepted.values, estimate(moved(3.0), 20, rng)
    gate.propose(c, P, 1.0, "x")
    blocks = []
    while gate.pending:
        e = evidence(J, moved(3.0), len(blocks), rng)
        at = rng.normal(size=5)
        blocks.append(dataclasses.replace(e, at=at, r=e.r + J @ at))
        gate.judge(blocks[-1], 1.0)
    assert gate.last.blocks == len(blocks)
    assert gate.last.gain == pytest.approx(sum(e.loss(a) - e.loss(c) for e in blocks), rel=1e-6)
    stacked = np.vstack([e.J for e in blocks])
    r = np.concatenate([e.residual(c) for e in blocks])
    M = np.eye(len(r)) + stacked @ P @ stacked.T
    w = stacked @ (c - a)
    assert gate.last.separation == pytest.approx(w @ w)
    assert gate.last.sd == pytest.approx(2 * np.sqrt(w @ M @ w * gate.last.scale))
    start = gate.history[0].covariance
    assert gate.last.claim == pytest.approx((c - a) @ np.linalg.solve(P + start, c - a))
    whole = r @ np.linalg.solve(M, r)  # of all rows: what no change of the numbers explains is in it as well
    beyond = r @ r - np.linalg.norm(np.linalg.qr(np.column_stack([stacked, r]), mode="r")[:5, 5]) ** 2
    assert gate.last.misfit == pytest.approx(whole - beyond)


def test_numbers_that_are_held_have_no_variance_and_may_stand():
    rng = np.random.default_rng(7)
    P = np.linalg.inv(200 * INFORMATION)
    P[4], P[:, 4] = 0.0, 0.0
    gate = Gate(P5, start=np.zeros(5), covariance=P)
    gate.propose(0.1 * np.sqrt(np.diag(P)), P, 1.0, "refined")
    assert judged(gate, np.zeros(5), rng)[0].kind == "accepted"
    assert np.isfinite(gate.last.claim)
    gate.propose(1e-6 * np.eye(5)[4], P, 1.0, "a number that was held")
    assert judged(gate, np.zeros(5), rng, 20) == (None, 20)
    assert gate.last.claim == np.inf


def test_blocks_that_are_not_finite_are_not_used_and_wrong_shapes_refused():
    rng = np.random.default_rng(8)
    gate = gate_at(np.zeros(5), rng, blocks=2)
    gate.propose(*estimate(np.zeros(5), 300, rng), 1.0, "x")
    bad = dataclasses.replace(evidence(J, np.zeros(5), 0, rng), r=np.full(5, np.nan))
    assert all(gate.judge(bad, 1.0) is None for _ in range(5))
    assert gate.pending
    with pytest.raises(EstimationError, match="5 finite"):
        gate.propose(np.zeros(4), np.eye(4), 1.0, "x")
    assert gate_at(np.zeros(5), rng).accept(0.0).kind == "refused"


def test_what_is_given_is_copied():
    q, P = np.zeros(5), np.eye(5)
    gate = Gate(P5, start=q, covariance=P)
    q[0], P[0, 0] = 9.0, 9.0
    assert gate.accepted.values[0] == 0.0
    assert gate.accepted.covariance[0, 0] == 1.0


def test_what_is_no_covariance_refuses():
    from ambid.tracking.gate import _squared_length

    d = np.array([1.0, -1.0])
    assert _squared_length(d, np.array([[2.0, 0.0], [0.0, 2.0]])) == pytest.approx(1.0)
    assert _squared_length(d, np.array([[1.0, 2.0], [2.0, 1.0]])) == np.inf  # an eigenvalue of -1
