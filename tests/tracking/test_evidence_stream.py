"""A block's evidence is the off-line estimator's linearisation of the same samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ambid.estimation.likelihood import linearise as off_line
from ambid.tracking.evidence import EvidenceStream, RecentSamples, Samples, linearise
from ambid.tracking.numbers import tracked_numbers
from tests.tracking.starts import bearing, bearing_start, columns

ROWS = 1500


@pytest.fixture(scope="module")
def numbers():
    return tracked_numbers(bearing_start(4000, 1))


@pytest.fixture(scope="module")
def moved(numbers):
    """A point where nothing is at its start."""
    step = np.random.default_rng(1).normal(size=numbers.start.size)
    return numbers.start + 0.01 * step


def run(numbers, q, samples, block):
    stream = EvidenceStream(numbers, linearise(numbers, q), block)
    found, k = [], 0
    while k < samples.y.shape[0]:
        used, _, evidence = stream.feed(samples.part(k))
        k += used
        found += [] if evidence is None else [evidence]
    return stream, found


def test_evidence_is_the_triangle_of_the_off_line_estimator(numbers, moved):
    u, y = columns(bearing(6000, 2), 0, ROWS)
    samples = Samples(u=u, y=y)
    stream = EvidenceStream(numbers, linearise(numbers, moved), 1)
    settle = stream.settling_samples
    stream, (evidence,) = run(numbers, moved, samples, ROWS - settle)
    n_u = u.shape[1]
    problem = replace(numbers.problem, u=u - numbers.point[:n_u], y=y - numbers.point[n_u:])
    # the off-line one starts at an unknown state instead of settling: its first samples are taken off
    W = np.linalg.inv(np.linalg.cholesky(numbers.innovation_covariance))
    whole, head = (
        off_line(replace(problem, u=problem.u[:n], y=problem.y[:n]), numbers.vector(moved), W) for n in (ROWS, settle)
    )
    p = numbers.start.size
    grams = [np.column_stack([a.J[:, :p], a.r]) for a in (whole, head)]
    gram = grams[0].T @ grams[0] - grams[1].T @ grams[1]
    own = np.column_stack([evidence.J, evidence.r])
    scale = np.sqrt(np.diag(gram))
    full = np.vstack([own, np.append(np.zeros(p), np.sqrt(evidence.rest))])
    np.testing.assert_allclose(full.T @ full / np.outer(scale, scale), gram / np.outer(scale, scale), atol=2e-3)


def test_evidence_predicts_the_loss_at_other_numbers(numbers, moved):
    """Exact derivatives: what remains falls with the square of the move."""
    u, y = columns(bearing(6000, 2), 0, ROWS)
    samples = Samples(u=u, y=y)
    settle = EvidenceStream(numbers, linearise(numbers, moved), 1).settling_samples
    _, (here,) = run(numbers, moved, samples, ROWS - settle)
    direction = np.random.default_rng(2).normal(size=moved.size) / np.sqrt(np.sum(here.J**2, axis=0))
    slope = 2 * direction @ here.J.T @ here.r
    W = np.linalg.inv(np.linalg.cholesky(numbers.innovation_covariance))

    def loss(q):
        stream = EvidenceStream(numbers, linearise(numbers, q), 1 << 40)
        errors = stream.feed(samples)[1][settle:] / numbers.problem.scales.output
        return np.sum((errors @ W.T) ** 2)

    assert loss(moved) == pytest.approx(here.loss(moved), rel=1e-9)
    for h in (1e-2, 1e-3):
        assert (loss(moved + h * direction) - loss(moved - h * direction)) / (2 * h) == pytest.approx(slope, rel=h)


def test_numbers_do_not_hang_on_how_the_stream_is_cut(numbers, moved):
    u, y = columns(bearing(6000, 2), 0, ROWS)
    _, whole = run(numbers, moved, Samples(u=u, y=y), 300)
    stream = EvidenceStream(numbers, linearise(numbers, moved), 300)
    parts = []
    for k in range(ROWS):
        _, _, evidence = stream.feed(Samples(u=u[k : k + 1], y=y[k : k + 1]))
        parts += [] if evidence is None else [evidence]
    assert len(parts) == len(whole) > 1
    for a, b in zip(parts, whole, strict=True):
        np.testing.assert_array_equal(a.J, b.J)
        np.testing.assert_array_equal(a.r, b.r)
        assert (a.rest, a.first, a.last, a.n_samples) == (b.rest, b.first, b.last, b.n_samples)


def test_offsets_enter_exactly_linearly(numbers):
    """A constant force and voltage change innovations linearly: the evidence is exact however large they are."""
    u, y = columns(bearing(6000, 2), 0, ROWS)
    samples, q = Samples(u=u, y=y), numbers.start.copy()
    _, here = run(numbers, q, samples, 400)
    far = q.copy()
    far[numbers.places("offset")] += [3.0, -2.0]
    _, there = run(numbers, far, samples, 400)
    for a, b in zip(here, there, strict=True):
        assert a.loss(far) == pytest.approx(b.loss(far), rel=1e-7)


def test_a_bad_sample_ends_a_feed_and_a_restart_drops_the_block(numbers):
    u, y = columns(bearing(6000, 2), 0, ROWS)
    y[700] = np.nan
    stream = EvidenceStream(numbers, linearise(numbers, numbers.start), 5000)
    used, errors, evidence = stream.feed(Samples(u=u, y=y))
    assert (used, evidence) == (700, None)
    assert errors.shape == (700, 2)
    stream.restart(701)
    assert stream.close(100) is None
    used, _, _ = stream.feed(Samples(u=u, y=y).part(701, 710))
    assert (used, stream.settling) == (9, stream.settling_samples - 9)


def test_recent_samples_stay_in_one_piece():
    """As they come one by one, and in blocks that are longer than what is kept."""
    values, rng = np.arange(2000.0), np.random.default_rng(0)
    for sizes in ([1] * 400, rng.integers(0, 30, 60), [3, 95, 7, 41, 40, 200, 1]):
        recent, last = RecentSamples(20), 0
        for n in sizes:
            part = values[last : last + n, None]
            last += int(n)
            recent.add(Samples(u=part, y=-part), last)
            kept = recent.since(recent.first)
            assert last - recent.first >= min(20, last)
            assert kept is None if last == 0 else np.array_equal(kept.u[:, 0], values[recent.first : last])
        assert np.shares_memory(recent.since(last - 9).y, recent.since(last - 1).y)  # a search has no time to copy
        assert np.array_equal(recent.since(last - 3).y[:, 0], -values[last - 3 : last])
        recent.clear()
        assert recent.since(last - 1) is None
