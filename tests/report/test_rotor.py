"""What is shown of a rotor: tables by bearing, figures, page; and that it comes back from its file."""

import base64
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ambid
from ambid.errors import EstimationError, RigError
from ambid.job.fits import physics
from ambid.job.presentation import document_of
from ambid.job.rotor import replays_of
from ambid.report.document import page_sections
from ambid.report.drawing import single
from ambid.report.rotor import rotor_document
from ambid.report.rotor_figures import RotorEvidence, measured_pairs, response_of, rotor_overview, rotor_poles
from ambid.report.signals import record_strips
from ambid.rig import draft_rig, rig_from_text
from tests.report.rotor_record import estimate, record, rig


def test_a_rotor_has_one_table_for_itself_and_one_for_each_bearing() -> None:
    e = estimate()
    lines = e.summary().splitlines()
    assert max(map(len, lines)) <= 80
    assert len(lines) <= 60
    assert "record: rotor on 4 axes, 3 periods of 0.5 s at 10000 Hz, at rest" in lines
    heads = [line.split() for line in lines if line.startswith(("rotor ", "bearing "))]
    assert [h[:4] for h in heads] == [["rotor", "value", "±", "sd"], ["bearing", "A", "ax", "ay"],
                                      ["bearing", "B", "bx", "by"]]  # fmt: skip
    (k_x, _) = (line for line in lines if line.startswith("k_x"))
    assert [float(x) for x in k_x.split()[1:7:3][:1]] == [round(e["ax.k_x"].value / 1e3, 1)]
    loops = [line for line in lines if line.startswith("sensitivity")]
    assert [line.count(" dB, A (> 99 %)") for line in loops] == [2, 2]  # the zone of each axis
    assert any(line.split() == ["sensor", "plane", "45", "mm,", "fixed"] for line in lines)
    narrow = e.summary(width=60).splitlines()
    assert sum(line.startswith("bearing A") for line in narrow) == 2  # an axis each


def test_what_the_data_do_not_show_is_marked_in_its_cell() -> None:
    e = estimate()
    unseen = [replace(p, identifiable=p.name != "by.R") for p in e.parameters]
    said = replace(e, parameters=tuple(unseen)).summary()
    (line,) = (x for x in said.splitlines() if x.startswith("R ") and "✗" in x)
    assert line.rindex("✗") > line.index("±")  # the second axis
    assert "✗ not identifiable from these data" in said
    assert "✗" not in e.summary()


def test_an_estimate_of_a_rotor_comes_back_from_its_file(tmp_path: Path) -> None:
    e = estimate()
    e.save(tmp_path / "e.json")
    again = ambid.load(tmp_path / "e.json")
    assert again.plant == e.plant
    assert again.dumps() == e.dumps()
    assert again.summary() == e.summary()


@cache
def evidence() -> RotorEvidence:
    e = estimate()
    return RotorEvidence(estimate=e, runs=replays_of(e, e.used))


def test_measured_lines_stand_around_the_model_by_their_noise() -> None:
    (run,) = evidence().runs
    found = measured_pairs(run, [0, 2], [0, 2])
    known = np.isfinite(found.sd[:, 0])  # by input
    assert not np.any(known[:, 0] & known[:, 1])  # zippered: a line is one axis'
    assert np.count_nonzero(known) > 100
    for j in range(2):
        at = known[:, j]
        away = np.abs(found.G[at, :, j] - run.H[at][:, [0, 2], 2 * j]) / found.sd[at, :, j]
        assert 0.7 < np.mean(away**2) < 1.3


def test_a_band_of_the_response_is_what_its_derivatives_say() -> None:
    e = estimate()
    at = response_of(e, evidence().runs[0])
    moved = dict(e.numbers) | {"m": e.numbers["m"] * (1 + 1e-6)}
    of = response_of(replace(e, numbers=moved), evidence().runs[0])
    alone = np.zeros_like(e.covariance)
    k = e.covariance_names.index("m")
    alone[k, k] = (e.numbers["m"] * 1e-6) ** 2
    band = response_of(replace(e, covariance=alone), evidence().runs[0])
    _, one, other = np.intersect1d(of.frequency_hz, at.frequency_hz, return_indices=True)  # the grid follows the poles
    assert one.size > 400
    change = np.abs(np.log(np.abs(of.G[one, 0, 0] / at.G[other, 0, 0])))
    np.testing.assert_allclose(change, band.log_sd[other, 0, 0], rtol=1e-3, atol=1e-12)


def test_poles_of_a_rotor_are_those_of_its_plant_with_a_spread() -> None:
    e = estimate()
    found = rotor_poles(e)
    np.testing.assert_allclose(
        sorted(p.value.real for p in found), sorted(e.continuous.poles.real), rtol=1e-9, atol=1e-6
    )
    assert all(p.covariance is not None and np.all(np.diag(p.covariance) >= 0) for p in found)
    assert any(p.value.real > 0 for p in found)


def test_figure_and_page_of_a_rotor_show_its_record() -> None:
    e = estimate()
    figure = rotor_overview(evidence())
    heads = {a.get_title(loc="left") for a in figure.axes}
    for pair in ("ax_voltage → ax_position", "by_voltage → ay_position", "bx_voltage → bx_current"):
        assert pair in heads
    (residual,) = (a for a in figure.axes if a.get_title(loc="left").startswith("ay_position: "))
    measured = next(line for line in residual.lines if line.get_label() == "residual")
    assert len(measured.get_xdata()) == evidence().runs[0].left.shape[0]
    sections = page_sections(rotor_document(e, None, evidence))
    assert [s.title for s in sections][:3] == ["Rotor", "Bearings", "Checks"]
    assert {"Response in plane x", "Coils", "Residuals", "Poles", "Noise", "Rig"} <= {s.title for s in sections}
    assert e.to_dataframe().loc["ax.k_i", "value"] == e["ax.k_i"].value
    assert all(s.figure is not None for s in sections if s.title in ("Coils", "Residuals", "Poles"))


def test_the_page_of_a_rotor_holds_its_signals_as_extremes_and_a_stretch_in_full(tmp_path: Path) -> None:
    whole, close = record_strips(record()).packed()
    assert [x["title"] for x in whole["strips"]] == list(record().names)
    for strip in whole["strips"]:
        low, high = (
            np.frombuffer(base64.b64decode(whole["arrays"][strip["lines"][0][end]]), "<f4") for end in ("low", "high")
        )
        values = record()[strip["title"]].values.astype("f4")
        assert (low.min(), high.max()) == (values.min(), values.max())
        assert low.size * whole["every"] >= record().n_samples
    assert (close["every"], close["samples"]) == (1, 20_000 // len(record().names))
    assert record_strips(record(), 4).packed()[1]["samples"] == 400  # at the least
    estimate().report(tmp_path / "r.html")
    assert "Signals" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_an_estimate_holds_on_another_record_of_its_rotor_and_not_on_one_of_another() -> None:
    e = estimate()
    found = e.validate(record(2))
    assert found.passed, found.summary()
    assert 0.5 < found.fit["ax_position"]["over_noise"] < 1.3
    assert "over its noise" in found.summary()
    assert any(a.get_title(loc="left").startswith("ax_position: ") for a in found.plot().axes)
    heavy = replace(e, numbers={**e.numbers, "m": 1.05 * e.numbers["m"]})
    assert not heavy.validate(record(2)).passed
    with pytest.raises(EstimationError, match="not periodic"):
        e.validate(record(2)[0.0:0.4])
    with pytest.raises(EstimationError, match="holds no predictor"):
        e.predict(record(2))


def test_a_whirl_diagram_is_drawn_where_what_turns_is_known() -> None:
    from tests.report.test_rotor_drawing import PLANES, identified

    e = estimate()
    assert "campbell" not in RotorEvidence(estimate=e).drawings()
    plant = replace(e.plant, polar=True, speed=300.0, n_modes=1)
    numbers = {"Ip": 0.01, "gyro.01": 0.0, "gyro.11": 0.1, "mode1.omega": 918.0, "mode1.zeta": 0.004}
    numbers |= {f"mode1.{name}": x.value for name, x in identified(1.0).shape.items()}
    turning = replace(
        e, plant=plant, numbers={**e.numbers, **numbers, **PLANES}, modes=(identified(1.0),),
        records=({**e.records[0], "speed": 300.0},),
    )  # fmt: skip
    blocks = RotorEvidence(estimate=turning).drawings()
    assert {"campbell", "shapes", "response_across"} <= set(blocks)
    heads = [a.get_title(loc="left") for a in single(blocks["campbell"]).axes]
    assert (
        heads[0] == f"critical speed {918.0 / np.sqrt(1 - 0.1) * 30 / np.pi:.0f} 1/min, without bearings"
    )  # W²(1 - g) = w²


def test_a_second_record_given_with_the_first_is_judged_beside_it(tmp_path: Path) -> None:
    e = ambid.identify(record(), rig(known=False), validate=record(2))
    assert e.validation is not None
    assert "on the second record (15000 samples)" in e.summary()
    assert "On the second record" in [s.title for s in page_sections(document_of(e))]
    e.save(tmp_path / "e.json")
    assert ambid.load(tmp_path / "e.json").summary() == e.summary()


def test_a_rig_of_a_rotor_is_refused_where_one_axis_is_meant() -> None:
    for verb in (
        lambda: ambid.frf(record(), rig=rig(known=False)),
        lambda: physics(ambid.fit(record(), structure="arx", orders="na=1,nb=1,nk=1", input="ax_voltage",
                                  output="ax_current", rig=rig(known=False)), rig(known=False)),
    ):  # fmt: skip
        with pytest.raises(EstimationError, match="rig of a rotor on many axes is for 'ambid identify'"):
            verb()


def test_a_rig_of_a_rotor_is_drafted_from_the_names_of_columns() -> None:
    text = draft_rig(record())
    with pytest.raises(RigError, match=r"bearings\.A\.z is missing"):  # a plane is measured, not guessed
        rig_from_text(text, "bench.toml")
    first, second = text.replace("# z", "z").split("[bearings.B]")
    drafted = rig_from_text(f"{first}[bearings.B]{second.replace('value = 0', 'value = 300')}", "bench.toml")
    assert drafted.plant.inputs == rig(known=False).plant.inputs
    assert [b.axes for b in drafted.plant.bearings] == [("ax", "ay"), ("bx", "by")]
    assert drafted.parameter("bx.k_i").role == "free"
