import dataclasses

import numpy as np
import pytest
from scipy import stats

from ambid.errors import EstimationError
from ambid.tracking.monitors import ChangeDetector
from tests.tracking.evidences import (
    BLOCK,
    BLOCK_S,
    GAINS,
    NAMES,
    OFFSETS,
    PHYSICAL,
    Filter,
    bearing,
    evidence,
    merge,
    triangle,
)

P7 = tuple(f"q{i}" for i in range(7))


def started(J, blocks=200, seed=0, walk=1e-9):
    """A filter as after `blocks` blocks, about the truth zero."""
    P = np.linalg.inv(blocks * J.T @ J)
    return Filter(np.linalg.cholesky(P) @ np.random.default_rng(seed).normal(size=len(P)), P, walk=walk)


def test_whitened_windows_are_standard_normal_whatever_the_filter_knew():
    from ambid.tracking.kernels import whiten

    J, rng, values = triangle(5, 3, condition=1e4), np.random.default_rng(4), []
    for _ in range(300):
        truth = rng.normal(size=5)
        f = Filter(truth + rng.normal(size=5), np.eye(5), walk=0.01)
        for k in range(2):
            f.update(evidence(J, truth, k, rng))
            truth = truth + 0.1 * rng.normal(size=5)
        window = merge([evidence(J, truth, k, rng) for k in (2, 3)])
        M, X = np.empty((5, 5)), np.empty((5, 6))
        before = np.column_stack([f.P, f.q])
        whiten(np.column_stack([window.J, window.r]), before, np.zeros(5), 1, M, X)
        assert np.allclose(np.tril(M) @ np.tril(M).T, np.eye(5) + window.J @ f.P @ window.J.T)
        values.append(X[:, 5])
    assert stats.kstest(np.ravel(values), "norm").pvalue > 0.01
    assert np.cov(np.transpose(values)) == pytest.approx(np.eye(5), abs=0.3)


def test_the_statistic_is_that_of_the_whole_window():
    J, rng = triangle(7, 5), np.random.default_rng(6)
    f, detector = started(J), ChangeDetector(P7, block_s=BLOCK_S)
    detector.drift[:] = 1e-9
    states, blocks, truth = [], [], np.zeros(7)
    for k in range(60):
        truth[2] = 0.02 if k >= 37 else 0.0  # half a standard deviation of a block: a long window finds it
        e = dataclasses.replace(evidence(J, truth, k, rng), at=f.q.copy())
        e = dataclasses.replace(e, r=e.r + J @ f.q)
        states.append((f.q, f.P))
        blocks.append(e)
        alarm = detector.update(e, f.q, f.P)
        if alarm is not None:
            break
        f.update(e)
    assert alarm is not None
    assert alarm.kind == "moved"
    n = alarm.blocks
    assert n > 4
    assert alarm.onset == blocks[-n].first
    window, (q, P) = merge(blocks[-n:]), states[-n]
    M = np.eye(7) + window.J @ (P + n * 1e-9 * np.eye(7)) @ window.J.T
    a = window.J[:, P7.index(alarm.parameter)]
    b, v = a @ np.linalg.solve(M, window.residual(q)), a @ np.linalg.solve(M, a)
    scale = max(1.0, sum(e.rest for e in blocks[-n:]) / sum(e.freedom for e in blocks[-n:]))
    learned = detector.overdispersion[detector.windows.index(n), P7.index(alarm.parameter)]
    assert alarm.size == pytest.approx(-b / v, rel=1e-6)
    assert alarm.statistic == pytest.approx(b * b / v / max(scale, learned), rel=0.01)
    assert alarm.sd == pytest.approx(np.sqrt(max(scale, learned) / v), rel=0.01)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_a_jump_anywhere_in_a_block_is_found_in_three_blocks_and_named(scale):
    """15 % of a number known to 0.09 % after a second; or, of a quiet rotor, so much more as its data say less."""
    sd = 0.0009 * np.sqrt(200)
    J, found = triangle(7, 7, sd=sd) * scale, []
    for seed in range(40):
        rng, share, number = np.random.default_rng(seed), (seed % 8) / 8, seed % 7
        f, detector = started(J, seed=seed), ChangeDetector(P7, block_s=BLOCK_S)
        jump = 0.15 / scale * np.eye(7)[number]
        for k in range(43):
            # a change inside a block acts with the part of its information that comes after it
            after = 0.0 if k < 40 else 1.0 if k > 40 else 1.0 - share
            e = evidence(J, after * jump, k, rng)
            alarm = detector.update(e, f.q, f.P)
            assert alarm is None or k >= 40
            if alarm is not None:
                break
            f.update(e)
        assert alarm is not None
        found.append(alarm.parameter == P7[number] and not alarm.rivals and abs(alarm.onset - 40 * BLOCK) <= 2 * BLOCK)
    assert np.mean(found) > 0.9


@pytest.mark.parametrize(
    ("what", "factor", "within_ms"),
    [
        ("k_i", 0.85, 30), ("R", 1.15, 80), ("m", 1.15, 40), ("m", 0.85, 30), ("k_x", 1.15, 70), ("L", 1.15, 20),
        ("gain_position", 0.85, 30), ("gain_current", 0.85, 20), ("force", 5.0, 20),
    ],
)  # fmt: skip
def test_what_moved_in_a_bearing_under_feedback_is_named(what, factor, within_ms):
    at = 6050
    blocks = bearing(what, factor, at=at, n=at + 2000, seed=1)
    free = [NAMES.index(n) for n in PHYSICAL + OFFSETS]
    before = merge([e for e in blocks if e.last <= at])
    P = np.zeros((len(NAMES), len(NAMES)))
    P[np.ix_(free, free)] = np.linalg.inv(before.J[:, free].T @ before.J[:, free])
    f = Filter(blocks[0].at, P, walk=1e-10)
    detector = ChangeDetector(NAMES, block_s=BLOCK_S)
    detector.drift[:] = f.walk
    named = None
    for e in blocks:
        alarm = detector.update(e, f.q, f.P)
        f.update(e)
        assert alarm is None or e.last > at
        if alarm is not None and alarm.kind == "moved" and not alarm.rivals:
            named = alarm
            break
    assert named is not None
    assert named.parameter == what
    assert named.end - at <= within_ms * 20
    if what in PHYSICAL + GAINS:  # to second order in the jump, and a first block that holds part of it
        signed = (factor - 1) * blocks[0].at[NAMES.index(what)]
        assert named.size == pytest.approx(signed, abs=0.05 + 3 * named.sd)
    assert what in named.why
    assert named.runner_up[1] < named.statistic


def quiet_run(detector, J, n, seed, *, noise=1.0, bias=0.0, jump=None):
    """Alarms as (block, alarm) of a run with white noise and a slow model error of rms `bias` in each r."""
    rng, f, alarms, slow = np.random.default_rng(seed), started(J, seed=seed), [], np.zeros(len(J))
    for k in range(n):
        slow = 0.9 * slow + np.sqrt(1 - 0.81) * rng.normal(size=len(J))
        truth = np.zeros(len(J)) if jump is None or k < jump[0] else jump[1]
        e = evidence(J, truth, k, rng, noise=noise if not callable(noise) else noise(k))
        e = dataclasses.replace(e, r=e.r + bias * slow)
        alarm = detector.update(e, f.q, f.P)
        f.update(e)
        if alarm is not None:
            alarms.append((k, alarm))
    return alarms


def test_noise_that_rises_or_falls_is_not_taken_for_a_parameter():
    J = triangle(7, 8)
    for low, high in ((1.0, 1.5), (1.0, 0.6)):
        detector = ChangeDetector(P7, block_s=BLOCK_S)
        alarms = quiet_run(detector, J, 120, 9, noise=lambda k, a=low, b=high: a if k < 100 else b)
        assert 100 <= alarms[0][0] <= 102
        assert {alarm.kind for _, alarm in alarms} == {"unexplained"}
        assert {alarm.by for _, alarm in alarms} == {"noise"}
        assert all(alarm.parameter is None and alarm.size == 0.0 for _, alarm in alarms)
        assert alarms[0][1].noise == pytest.approx(high**2, rel=0.3)
        assert "no single parameter" in alarms[0][1].why


def test_several_numbers_at_once_are_not_taken_for_one():
    J = triangle(7, 10)
    detector = ChangeDetector(P7, block_s=BLOCK_S)
    move = np.linalg.solve(J, 12 * np.random.default_rng(1).choice([-1, 1], size=7))
    alarms = quiet_run(detector, J, 43, 11, jump=(40, move))
    assert alarms[0][0] == 40
    assert (alarms[0][1].kind, alarms[0][1].by) == ("unexplained", "all")
    assert alarms[0][1].statistic > alarms[0][1].threshold


def test_an_imperfect_model_is_learned_and_a_true_change_is_found_all_the_same():
    J = triangle(7, 12)
    naive = ChangeDetector(P7, block_s=BLOCK_S)
    bad = quiet_run(naive, J, 1000, 13, bias=2.0, noise=1.3)
    assert len(bad) > 50
    taught = ChangeDetector(P7, block_s=BLOCK_S, settle_s=4.0)
    alarms = quiet_run(taught, J, 3000, 13, bias=2.0, noise=1.3, jump=(2990, 0.15 * np.eye(7)[1]))
    early = [k for k, _ in alarms if k < 2990]
    assert len(early) <= 5
    assert alarms[-1][1].parameter == "q1"
    assert next(k for k, _ in alarms if k >= 2990) <= 2995
    assert taught.noise == pytest.approx(1.69, rel=0.1)
    assert taught.overdispersion[0, :7].mean() > 2.5  # 1.69 + 4 in the mean of r, less what the filter follows
    assert taught.overdispersion.min() >= 1.0


def test_a_standing_alarm_is_not_learned_away():
    J = triangle(7, 14)
    detector = ChangeDetector(P7, block_s=BLOCK_S)
    rng, q, P = np.random.default_rng(15), np.zeros(7), np.linalg.inv(200 * J.T @ J)
    alarms = [detector.update(evidence(J, 0.1 * np.eye(7)[3], k, rng), q, P) for k in range(1500)]
    assert all(a is not None and a.parameter == "q3" for a in alarms[3:])
    assert detector.overdispersion.max() < 1.1


def test_restart_forgets_the_windows_and_leaves_out_earlier_blocks():
    J, rng = triangle(7, 16), np.random.default_rng(17)
    f, detector = started(J), ChangeDetector(P7, block_s=BLOCK_S)
    for k in range(30):
        detector.update(evidence(J, 0.1 * np.eye(7)[0] * (k >= 20), k, rng), f.q, f.P)
    detector.restart(32 * BLOCK)
    right = f.q + 0.1 * np.eye(7)[0]
    assert all(detector.update(evidence(J, np.full(7, 9.0), k, rng), right, f.P) is None for k in (30, 31))
    assert all(detector.update(evidence(J, 0.1 * np.eye(7)[0], k, rng), right, f.P) is None for k in range(32, 200))


def test_results_do_not_hang_on_where_the_evidence_is_linearised():
    J, moved = triangle(7, 18), np.linspace(-1, 1, 7)
    found = []
    for shift in (0.0, 1.0):
        f, detector, rng = started(J), ChangeDetector(P7, block_s=BLOCK_S), np.random.default_rng(19)
        for k in range(50):
            e = evidence(J, 0.03 * np.eye(7)[4] * (k >= 30), k, rng)
            at = shift * moved * np.sin(k)
            found.append(detector.update(dataclasses.replace(e, at=at, r=e.r + J @ at), f.q, f.P))
    first, second = found[:50], found[50:]
    assert any(first)
    for a, b in zip(first, second, strict=True):
        assert (a is None) == (b is None)
        assert a is None or a.statistic == pytest.approx(b.statistic, rel=1e-6)


def test_what_is_not_finite_is_refused_and_changes_nothing():
    J, rng = triangle(7, 20), np.random.default_rng(21)
    f, one, two = started(J), ChangeDetector(P7, block_s=BLOCK_S), ChangeDetector(P7, block_s=BLOCK_S)
    blocks = [evidence(J, 0.05 * np.eye(7)[6] * (k >= 20), k, rng) for k in range(25)]
    found = []
    for k, e in enumerate(blocks):
        if k == 10:
            with pytest.raises(EstimationError, match="not finite"):
                one.update(dataclasses.replace(e, r=np.full(7, np.nan)), f.q, f.P)
            with pytest.raises(EstimationError, match="not finite"):
                one.update(e, f.q, np.full((7, 7), np.inf))
        found.append((one.update(e, f.q, f.P), two.update(e, f.q, f.P)))
    assert found[-1][0] is not None
    assert all(a == b for a, b in found)


def test_evidence_of_nothing_says_nothing():
    J, rng, detector = np.zeros((7, 7)), np.random.default_rng(22), ChangeDetector(P7, block_s=BLOCK_S)
    assert all(detector.update(evidence(J, np.ones(7), k, rng), np.zeros(7), np.eye(7)) is None for k in range(300))


def test_drift_widens_what_a_window_may_show():
    J = triangle(7, 30)
    detector = ChangeDetector(P7, block_s=BLOCK_S)
    assert detector.drift.tolist() == [0.0] * 7

    def walked(detector, walk, n=400):
        """Alarms where the numbers walk, and the filter stands still as of before."""
        rng, truth, q, P = np.random.default_rng(31), np.zeros(7), np.zeros(7), np.zeros((7, 7))
        found = []
        for k in range(n):
            truth = truth + np.sqrt(walk) * rng.normal(size=7)
            found.append(detector.update(evidence(J, truth, k, rng), q, P + k * walk * np.eye(7)))
        return sum(alarm is not None for alarm in found)

    assert walked(ChangeDetector(P7, block_s=BLOCK_S), 2e-5) > 3
    detector.drift = np.full(7, 2e-5)
    assert walked(detector, 2e-5) == 0


def test_memory_does_not_grow():
    J, rng, detector = triangle(7, 23), np.random.default_rng(24), ChangeDetector(P7, block_s=BLOCK_S)
    f = started(J)

    def bytes_held():
        return sum(v.nbytes for v in vars(detector).values() if isinstance(v, np.ndarray))

    sizes = set()
    for k in range(300):
        detector.update(evidence(J, np.zeros(7), k, rng), f.q, f.P)
        sizes.add((bytes_held(), len(vars(detector))))
    assert len(sizes) == 1


@pytest.mark.parametrize("longest_s", [0.01, 0.03, 0.06, 0.5])
def test_windows_are_no_longer_than_asked(longest_s):
    detector = ChangeDetector(P7, block_s=BLOCK_S, longest_s=longest_s)
    assert detector.windows[:4] == (1, 2, 3, 4)
    assert max(detector.windows) <= max(4, longest_s / BLOCK_S)
    assert max(detector.windows) > 0.5 * longest_s / BLOCK_S
    assert not quiet_run(detector, triangle(7, 25), 150, 26)
