"""The black-box job: what it says of its progress. What it fits, `tests/blackbox` and `tests/cli` look at."""

from __future__ import annotations

import numpy as np
import pytest

import ambid
from ambid.errors import EstimationError
from ambid.job import fit, physics
from ambid.rig import default_rig


def test_a_choice_of_orders_says_what_share_is_over(tmp_path) -> None:
    rng = np.random.default_rng(4)
    u, y = rng.standard_normal(400), np.zeros(400)
    for t in range(2, 400):
        y[t] = 1.2 * y[t - 1] - 0.5 * y[t - 2] + u[t - 1] + 0.1 * rng.standard_normal()
    table = np.column_stack([np.arange(400) / 100, u, y])
    np.savetxt(tmp_path / "r.csv", table, delimiter=",", header="time [s],u [V],y [m]", comments="")
    told: list[tuple[str, float | None]] = []

    def listen(stage: str, done: float | None = None) -> None:
        told.append((stage, done))

    fit(tmp_path / "r.csv", input="u", output="y", structure="armax", open_loop=True, tick=listen)
    shares = [x for stage, x in told if stage in ("orders", "fit") and x is not None]
    assert len(shares) > 5
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0.0, 0.95)
    assert [x for k, (x, _) in enumerate(told) if k == 0 or x != told[k - 1][0]] == ["orders", "fit", "check"]
    told.clear()
    fit(tmp_path / "r.csv", input="u", output="y", structure="arx", orders={"na": 2, "nb": 1}, tick=listen)
    assert told == [("fit", None), ("check", None)]


def test_a_fit_of_channels_of_two_runs_is_disowned_by_the_record() -> None:
    """And where it leads to no plant, the refusal begins with what the record says."""
    one, other = (ambid.simulate("levitated-ball", duration=2.0, seed=seed) for seed in (1, 2))
    columns = {name: one[name].values for name in ("voltage", "current", "position")}
    sound, mixed = (
        fit(c, "n4sid", "n=3", rate_hz=one.rate_hz, units={"voltage": "V", "current": "A", "position": "m"})
        for c in (columns, {**columns, "position": other["position"].values[::-1].copy()})
    )
    assert "belonging" not in sound.checks
    assert mixed.verdict.word == "unusable"
    assert mixed.verdict.reasons[0].cause == "belonging"
    with pytest.raises(EstimationError, match=r"^nothing relates the position to .* Further: "):
        physics(mixed, default_rig())
