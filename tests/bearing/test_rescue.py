"""Records on which the grey box's start values fail: a global search finds the plant, says so, and is not used else."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from ambid.bearing import rescue
from ambid.bearing.linear import greybox
from ambid.bearing.rescue import Rescue, global_candidates, likelihood_cost
from ambid.bearing.uncertainty import uncertainty
from ambid.errors import EstimationError
from ambid.estimation.estimate import Estimate, estimate_from_json
from ambid.estimation.global_search import describe_search
from ambid.estimation.likelihood import Fit, unexplained
from ambid.job import identify
from ambid.record import Channel, Record
from ambid.rig import load_rig
from tests.bearing import benches
from tests.bearing.benches import SETTINGS, Bench, parameters, run

home = import_module("ambid.bearing.linear")  # the room exports a function of the same name


def shifts(fit: Fit, bench: Bench) -> dict[str, float]:
    """Errors of the estimated parameters in standard deviations."""
    known, values = uncertainty(fit), fit.problem.parameters(fit.vector)
    sd = dict(zip(known.names, known.standard_deviations(robust=False), strict=True))
    return {k: abs(values[k] - bench.truth[k]) / sd[k] for k in known.names}


@pytest.fixture(scope="module")
def weak() -> Iterator[Bench]:
    """An unstable bearing under a twentieth of the usual excitation and thirty times the usual sensor noise."""
    settings = dict(SETTINGS)
    noise = {k: v * (30.0 if k in ("position", "current") else 1.0) for k, v in SETTINGS["bearing"].noise.items()}
    benches.SETTINGS["weak"] = replace(SETTINGS["bearing"], rms=0.3, noise=noise)
    yield run("weak", 2000, 1)
    benches.SETTINGS.clear()
    benches.SETTINGS.update(settings)


@pytest.fixture(scope="module")
def estimate(weak: Bench, tmp_path_factory: pytest.TempPathFactory) -> Estimate:
    """What the main job makes of it."""
    file = Path(tmp_path_factory.mktemp("rig")) / "rig.toml"
    file.write_text(
        'schema = "ambid.rig/1"\nname = "weak"\nmodel = "one-axis"\n[channels.voltage]\n[channels.current]\n'
        '[channels.position]\n[parameters]\nc = { value = 0.0, unit = "N s/m", role = "fixed" }\n'
    )
    s = weak.signals
    columns = (("voltage", "V", s.u[:, 0]), ("position", "m", s.y[:, 0]), ("current", "A", s.y[:, 1]))
    channels = tuple(Channel(name=name, unit=unit, values=values) for name, unit, values in columns)
    return identify(Record(rate_hz=s.rate_hz, channels=channels), load_rig(file))


@pytest.fixture(scope="module")
def before(weak: Bench) -> Fit:
    """What the ordinary starts lead to."""
    return greybox(weak.model, weak.signals, parameters(weak, fixed=("c",)), evaluations=0)


def test_a_weakly_excited_unstable_plant_is_found_where_no_search_converges(
    weak: Bench, before: Fit, estimate: Estimate
) -> None:
    assert before.status == "stalled"
    assert before.global_search is None
    assert before.problem.parameters(before.vector)["m"] > 1e3 * weak.truth["m"]
    assert estimate.status == "converged"
    assert estimate.delay["voltage"].samples == 1
    for p in estimate.parameters:
        assert p.value == pytest.approx(weak.truth[p.name], abs=3.5 * p.sd + 1e-12), p.name
    assert estimate.parameter("L").value == pytest.approx(weak.truth["L"], rel=0.2)


def test_the_estimate_says_that_it_was_needed(estimate: Estimate) -> None:
    told = estimate.global_search
    assert told is not None
    assert told["why"] == "no search converged"
    assert told["taken"]
    assert not told["interrupted"]
    assert told["criterion_after"] < told["criterion_before"]  # type: ignore[operator]
    assert 100 < told["evaluations"] <= rescue.EVALUATIONS  # type: ignore[operator]
    assert any("differential evolution" in w for w in estimate.warnings)
    assert estimate.timing_s["global_search"] > 0.0
    document = json.loads(estimate.dumps())
    assert document["global_search"] == dict(told)
    assert estimate_from_json(document, "file").global_search == told
    del document["global_search"]  # as files of earlier versions are
    assert estimate_from_json(document, "file").global_search is None


def test_a_wrong_minimum_shows_in_its_errors_and_is_left() -> None:
    late = run("thesis", 1500, 1, delay=20.0)
    ps = parameters(late, fixed=("c",))
    before = greybox(late.model, late.signals, ps, evaluations=0)
    assert unexplained(before) > 0.9
    assert max(abs(before.problem.parameters(before.vector)[k] / late.truth[k] - 1.0) for k in ("m", "k_i", "L")) > 1.0
    fit = greybox(late.model, late.signals, ps, evaluations=700)
    assert fit.status == "converged"
    assert fit.problem.delay_samples(fit.vector) == 20.0
    assert max(shifts(fit, late).values()) < 3.5
    assert fit.problem.parameters(fit.vector)["k_i"] == pytest.approx(late.truth["k_i"], rel=0.01)
    assert fit.global_search is not None
    assert "linear regression" in str(fit.global_search["why"])


def test_it_takes_over_where_no_start_makes_a_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object, **__: object) -> None:
        raise EstimationError("no start values make a physical plant")

    bench = run("falling rotor", 1000, 3)
    ps = parameters(bench, fixed=("c", "m"))
    monkeypatch.setattr(home, "starts", none)
    fit = greybox(bench.model, bench.signals, ps, evaluations=600)
    assert fit.status == "converged"
    assert max(shifts(fit, bench).values()) < 3.5
    assert fit.global_search is not None
    assert fit.global_search["criterion_before"] is None
    with pytest.raises(EstimationError, match="physical plant"):
        greybox(bench.model, bench.signals, ps, evaluations=0)


def test_a_mass_of_nothing_is_refused_as_before() -> None:
    bench = run("bearing", 600, 3)
    ps = [replace(p, value=0.0) if p.name == "m" else p for p in parameters(bench, fixed=("c", "m"))]
    with pytest.raises(EstimationError, match="physical plant"):
        greybox(bench.model, bench.signals, ps, evaluations=100)


@pytest.mark.parametrize("name", ["thesis", "bearing", "rmit", "coil", "sprung rotor", "falling rotor"])
def test_it_is_not_called_where_the_ordinary_starts_work(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("a global search where none is needed")

    monkeypatch.setattr(home, "rescue", refuse)
    for n, louder in ((400, 1.0), (1500, 10.0)):
        noise = {k: v * louder for k, v in SETTINGS[name].noise.items() if k in ("position", "current")}
        bench = run(name, n, 1, **noise)
        fixed = tuple(p for p in ("c", "m") if p in bench.truth and (p == "c" or name.endswith("rotor")))
        fit = greybox(bench.model, bench.signals, parameters(bench, fixed=fixed))
        assert fit.status == "converged"
        assert fit.global_search is None


def test_it_hangs_on_the_seed_alone(weak: Bench) -> None:
    ps = parameters(weak, fixed=("c",))
    found = []
    for seed in (0, 0, 1):
        cost = likelihood_cost(weak.model, weak.signals, ps, "auto")
        assert cost is not None
        found.append(global_candidates(cost, weak.signals, Rescue(evaluations=200, seed=seed)))
    one, again, other = found
    assert [c.problem.delay for c in one] == [c.problem.delay for c in again]
    assert len(one) > 1
    for a, b in zip(one, again, strict=True):
        np.testing.assert_array_equal(a.vector * 1.0, b.vector)
        np.testing.assert_array_equal(a.problem.magnitude, b.problem.magnitude)
    assert not np.array_equal(one[0].problem.magnitude, other[0].problem.magnitude)


def test_an_interruption_keeps_the_best_so_far(weak: Bench, before: Fit, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = [-1]
    whole = likelihood_cost

    def begun(*arguments: object) -> object:
        calls[0] = 0
        return whole(*arguments)  # type: ignore[arg-type]

    def tick() -> None:
        if calls[0] >= 0:
            calls[0] += 1
            if calls[0] == 300:
                raise KeyboardInterrupt

    monkeypatch.setattr(rescue, "likelihood_cost", begun)
    fit = greybox(weak.model, weak.signals, parameters(weak, fixed=("c",)), tick=tick)
    assert fit.status == "stalled"
    assert fit.global_search is not None
    assert fit.global_search["interrupted"]
    assert fit.global_search["evaluations"] == 300
    assert fit.criterion <= before.criterion
    assert "interrupted" in describe_search(fit.global_search)
