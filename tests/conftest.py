"""The files that take longest begin first, so that on two processes (``-n 2 --dist loadfile``) none is left at the end.

The pages of the documentation use most compiled kernels. They begin beside Monte Carlo experiments, which use few: what
the files after them need is compiled by then, and not by both processes.
"""

from __future__ import annotations

import gc
import signal
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest

from tests.tiers import ALL

LONGEST = (
    "examples/test_pages.py",
    "statistical/test_polynomial.py",
    "statistical/test_monte_carlo.py",
    "statistical/test_subspace.py",
    "bearing/test_physical.py",
    "real/test_nonlinear_maglev.py",
    "recursive/test_conformance.py",
    "cli/test_acquire.py",
    "cli/test_bad_input.py",
    "job/test_track.py",
    "nonlinear/test_hybrid.py",
    "bearing/magnet/test_rescue.py",
    "blackbox/instrumental/test_in_loop.py",
    "bars/test_acquisition_line.py",
    "statistical/test_recursive_polynomial.py",
    "statistical/test_blackbox_validation.py",
    "job/test_track_estimator.py",
    "statistical/test_frf.py",
    "statistical/test_tracking.py",
    "statistical/test_joint.py",
    "statistical/test_nonlinear_bearing.py",
    "statistical/test_recursive.py",
    "examples/test_examples.py",
    "test_job.py",
    "cli/test_identify_nonlinear.py",
    "real/test_track_maglev.py",
    "bars/test_acquisition_parameters.py",
    "bars/test_acquisition_damage.py",
    "job/test_commission.py",
    "conventions/test_compiled.py",
)


LONG = Path(__file__).with_name("long_tests.txt")


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in the background of a shell (``nohup make test &``) or CI:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # tests of Ctrl-C, and what they start, need it
    gc.set_threshold(100_000, 50, 100)  # as the command does: what is imported stays to the end
    if hasattr(config.option, "loadscopereorder"):  # else the files with most tests would begin first
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not ALL:
        _leave_out_long_ones(config, items)
    files = [list(of_file) for _, of_file in groupby(items, key=lambda item: item.path)]
    files.sort(key=lambda of_file: next((k for k, n in enumerate(LONGEST) if str(of_file[0].path).endswith(n)), 99))
    items[:] = [item for of_file in files for item in of_file]


def _leave_out_long_ones(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect the tests of long_tests.txt and those marked ``long``, unless single tests are asked for."""
    if any("::" in str(x) for x in config.args):
        return
    lines = LONG.read_text(encoding="utf-8").splitlines()
    long = {line.split(maxsplit=1)[1] for line in lines if not line.startswith("#")}
    left = {x for x in items if x.nodeid.removeprefix("tests/") in long or x.get_closest_marker("long")}
    config.hook.pytest_deselected(items=list(left))
    items[:] = [item for item in items if item not in left]


def pytest_collection_finish() -> None:
    gc.freeze()  # thousands of tests stay to the end: each collection would go through all of them, a third of a second


@pytest.fixture(autouse=True)
def figures_are_empty(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lay out and render no figure where a test asks only whether it is written; tests/report/ looks at figures."""
    if not ALL and request.path.parent.name != "report" and not request.node.get_closest_marker("drawn"):
        monkeypatch.setattr("matplotlib.figure.Figure.draw", _empty)


def _empty(figure: Any, renderer: Any) -> None:
    renderer.open_group("figure", gid="figure_1")
    renderer.close_group("figure")
    figure.stale = False


_empty._supports_rasterization = True  # else a class of figures that is made now keeps this for ever
