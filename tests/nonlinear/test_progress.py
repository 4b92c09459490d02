"""Shares of a search, put together from its parts."""

from __future__ import annotations

from itertools import pairwise

import pytest

from ambid.estimation.progress import guessed, part_of, portions, silent


def test_parts_count_from_nothing_to_all_and_make_up_the_whole() -> None:
    told: list[tuple[str, float | None]] = []

    def listen(stage: str, done: float | None = None, /) -> None:
        told.append((stage, done))

    first, left_out, second = portions(listen, (3.0, 0.0, 1.0))
    assert first is not None
    assert left_out is not None
    assert second is not None
    first("a", 0.0)
    first("a", 0.5)
    first("a")
    left_out("b", 0.7)
    inner = part_of(second, 0.5, 1.0)
    assert inner is not None
    inner("c", 0.5)
    inner("c", 7.0)
    assert [x for x, _ in told] == ["a", "a", "a", "b", "c", "c"]
    assert [x for _, x in told if x is not None] == pytest.approx([0.0, 0.375, 0.75, 0.9375, 1.0])
    assert told[2][1] is None


def test_a_guess_rises_and_never_ends() -> None:
    shares = [guessed(k, 6.0) for k in range(200)]
    assert (shares[0], shares[6]) == (0.0, 0.5)
    assert all(a < b < 1.0 for a, b in pairwise(shares))


def test_without_a_listener_there_is_none_for_the_parts() -> None:
    assert portions(None, (1.0, 2.0)) == [None, None]
    silent("a", 0.5)
