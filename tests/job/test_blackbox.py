"""The black-box job: what it says of its progress. What it fits, `tests/blackbox` and `tests/cli` look at."""

from __future__ import annotations

import numpy as np

from ambid.job import fit


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
