"""Excitations over the axes of a rotor: whole periods, disjoint lines, orthogonal experiments, refusals."""

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.signals import excitation_of_axes

RATE = 1000.0


def test_each_line_of_a_zippered_multisine_is_on_one_axis() -> None:
    u = excitation_of_axes("zippered", 4000, RATE, axes=4, amplitude=2.0, band=(1.0, 200.0), periods=4, seed=1)
    assert np.abs(u[:1000] - u[3000:]).max() < 1e-12
    lines = np.abs(np.fft.rfft(u[:1000], axis=0)) > 1e-6
    assert np.array_equal(np.flatnonzero(lines.any(axis=1)), np.arange(1, 201))
    assert (lines.sum(axis=1)[1:201] == 1).all()
    assert np.abs(u).max(axis=0) == pytest.approx(np.full(4, 2.0))


def test_lines_are_dealt_out_over_the_excited_axes_alone() -> None:
    u = excitation_of_axes("zippered", 1000, RATE, axes=4, excited=(1, 3), amplitude=1.0, band=(1.0, 200.0))
    assert not u[:, [0, 2]].any()
    lines = np.abs(np.fft.rfft(u, axis=0)) > 1e-6
    assert lines.sum(axis=0).tolist() == [0, 100, 0, 100]


@pytest.mark.parametrize("axes", [2, 3, 4])
def test_orthogonal_experiments_are_orthogonal_at_each_line(axes: int) -> None:
    n = 1000
    u = excitation_of_axes("orthogonal", 2 * axes * n, RATE, axes=axes, amplitude=1.0, band=(1.0, 200.0), periods=2)
    blocks = u.reshape(axes, 2, n, axes)
    assert np.abs(blocks[:, 0] - blocks[:, 1]).max() < 1e-12
    spectra = np.fft.rfft(blocks[:, 0], axis=1)[:, 1:201].transpose(1, 0, 2)  # (lines, experiments, axes)
    spectra /= np.abs(spectra[:, :1])
    gram = np.conj(spectra.transpose(0, 2, 1)) @ spectra
    assert np.abs(gram - axes * np.eye(axes)).max() < 1e-9


def test_other_excitations_differ_from_axis_to_axis() -> None:
    u = excitation_of_axes("gaussian", 4000, RATE, axes=3, amplitude=1.0, seed=5)
    assert np.abs(np.corrcoef(u.T) - np.eye(3)).max() < 0.1


@pytest.mark.parametrize(
    ("name", "more", "says"),
    [
        ("steps", {}, "is the same on every axis"),
        ("zipered", {}, "Did you mean 'zippered'"),
        ("zippered", {"periods": 3}, "do not divide"),
        ("orthogonal", {"periods": 400}, "do not divide"),
        ("zippered", {"band": (1.0, 2.0)}, "too few for 4 axes"),
        ("zippered", {"excited": ()}, "do not divide"),
    ],
)
def test_what_cannot_be_made_is_refused(name: str, more: dict[str, object], says: str) -> None:
    with pytest.raises(AmbidError, match=says):
        excitation_of_axes(name, 1000, RATE, axes=4, amplitude=1.0, **more)  # type: ignore[arg-type]
