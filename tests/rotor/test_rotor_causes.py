"""What is wrong in a record of a rotor is named, with what cannot be told apart from it, and nothing else is blamed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

import ambid
from ambid.errors import EstimationError
from ambid.physics.linear_model import Parameter
from ambid.physics.presets import preset
from ambid.record import Record
from ambid.rig import Rig, rig_of_preset
from ambid.rig.rotor import RigModes
from ambid.rotor.conclusion import shifts_of
from ambid.rotor.estimator import estimate_rotor, unknowns_at
from ambid.rotor.likelihood import Experiment, Point, fit_noise, sampled
from ambid.rotor.lines import Line, apart
from ambid.rotor.response import Sampled
from ambid.rotor.scores import Bent, Cause, Score, agreement_checks, curvature_check, scored
from ambid.rotor.spectra import Between, find_excitation, find_slip, period_spectra
from tests.rotor_benches import free_rig, model_of, needs_simulator, record_of, truth

pytestmark = needs_simulator


@pytest.fixture(scope="module")
def sound() -> tuple[Record, Rig]:
    bench = replace(truth.BENCHES["rigid"], period=0.25)
    return record_of(bench, 1), free_rig(bench)


def changed(record: Record, **signals: Any) -> Record:
    of = {c.name: signals.get(c.name, lambda x: x)(c.values) for c in record.channels}
    return replace(record, channels=tuple(replace(c, values=of[c.name]) for c in record.channels))


def moved(rig: Rig, **by: float) -> Rig:
    """The rig with planes that are taken too large, in m; names with __ for the dot."""
    known = tuple(
        replace(p, value=(p.value or 0.0) + by.get(p.name.replace(".", "__"), 0.0)) if p.role == "fixed" else p
        for p in rig.parameters
    )
    return replace(rig, parameters=known)


def named(record: Record, rig: Rig, check: str) -> tuple[str, ...]:
    """The cause that a check names, and its alternatives; nothing else of that kind fails."""
    found = ambid.identify(record, rig)
    agree = {k: c for k, c in found.checks.items() if k in ("fixed_agree", "sensors_agree")}
    assert [k for k, c in agree.items() if not c.passed] == [check]
    assert found.verdict.word != "usable"
    return agree[check].cause, *agree[check].alternatives


@pytest.mark.parametrize("role", ["ax_current", "ax_voltage"])
def test_the_gain_of_a_current_or_voltage_is_named_and_no_position_blamed(sound: Any, role: str) -> None:
    causes = named(changed(sound[0], **{role: lambda x: 1.05 * x}), sound[1], "sensors_agree")
    assert set(causes) == {"ax_current.gain", "ax_voltage.gain"}


def test_the_lag_of_a_current_is_named_and_no_mode_stands_in_for_it(sound: Any) -> None:
    record, rig = sound
    lagging = filtered(record, "ax_current", 2000.0)
    causes = named(lagging, rig, "sensors_agree")
    assert causes[0] in ("ax_current.lag", "ax_voltage.lag")
    assert set(causes) <= {"ax_current.lag", "ax_voltage.lag"}
    assert not ambid.identify(lagging, rig).modes


def test_two_planes_wrong_together_are_no_single_plane(sound: Any) -> None:
    causes = named(sound[0], moved(sound[1], A__z_sensor=6e-3, B__z=6e-3), "fixed_agree")
    assert "planes" in causes
    assert not set(causes) & {"A.z", "B.z", "A.z_sensor", "B.z_sensor"}


def test_two_planes_a_little_off_are_named_and_no_mode_stands_in_for_them() -> None:
    bench = replace(truth.BENCHES["rigid"], m=3.0, Id=0.02, Ip=0.004, z_bearing=(-0.09, 0.11), z_sensor=(-0.11, 0.13))
    bench = replace(bench, period=0.25)
    found = ambid.identify(record_of(bench, 1), moved(free_rig(bench), A__z_sensor=1e-3, B__z=-1e-3))
    assert not found.modes
    check = found.checks["fixed_agree"]
    assert {"A.z_sensor", "B.z"} & {check.cause, *check.alternatives}


def coloured(record: Record, hertz: float) -> Record:
    """The record with 2 um rms of noise below a frequency in two positions."""
    rng, pole = np.random.default_rng(1), np.exp(-2 * np.pi * hertz / record.rate_hz)

    def noisy(x: Any) -> Any:
        slow = lfilter([1.0], [1.0, -pole], rng.standard_normal(x.size))
        return x + 2e-6 * slow / slow.std()

    return changed(record, ax_position=noisy, by_position=noisy)


def between(sound: Any, hertz: float) -> tuple[Between, list[Sampled]]:
    """Spectra of coloured noise between the lines, and the true model there and at the lines."""
    model, theta = model_of(replace(truth.BENCHES["rigid"], period=0.25))
    record = coloured(sound[0], hertz)
    excitation = find_excitation(record, sound[1].plant)
    assert excitation is not None
    of = Experiment(spectra=period_spectra(record, model, excitation), speed=0.0)
    at = Point(theta=theta, delays=np.ones(len(model.inputs)))
    return of.spectra.between, [sampled(of, model, at, between=x) for x in (True, False)]


@pytest.mark.parametrize("hertz", [30.0, 100.0])
def test_the_rms_of_coloured_noise_is_that_of_its_samples(sound: Any, hertz: float) -> None:
    """The excited lines end at a fifth of half the rate."""
    beside, response = between(sound, hertz)
    rms = fit_noise(beside, *response).sd(2500, sound[0].rate_hz)[:4]
    slow = np.hypot(2e-6, 2e-7)
    assert rms == pytest.approx(np.array([slow, 2e-7, 2e-7, slow]), rel=0.15)


def test_noise_is_coloured_in_any_unit_of_the_outputs(sound: Any) -> None:
    unit, (beside, response) = 1e6, between(sound, 30.0)
    larger = [replace(x, space=replace(x.space, C=unit * x.space.C)) for x in response]
    plain = fit_noise(beside, *response)
    scaled = fit_noise(replace(beside, Y=unit * beside.Y), *larger)
    assert {0, 3} <= {j for j, _ in plain.colours}
    assert scaled.colours == plain.colours
    assert scaled.covariance == pytest.approx(unit**2 * plain.covariance, rel=1e-3)


def test_coloured_noise_is_no_mode_and_leaves_numbers_usable(sound: Any) -> None:
    record, rig = sound
    found = ambid.identify(coloured(record, 10.0), rig)
    assert found.verdict.word == "usable", found.verdict.reasons
    assert not found.modes
    assert found.noise["ax_position"] > 2.0 * found.noise["ay_position"]
    _, theta = model_of(replace(truth.BENCHES["rigid"], period=0.25))
    assert not [p.name for p in found.parameters if p.sd and abs(p.value - theta[p.name]) > 3.8 * p.sd]


def test_a_reversed_position_is_not_blamed_on_the_magnets(sound: Any) -> None:
    record, rig = sound
    found = ambid.identify(changed(record, ax_position=np.negative), rig)
    assert found.verdict.word == "unusable"
    assert found.checks["curvature"].passed
    assert "something else is wrong" in found.checks["curvature"].detail


@pytest.mark.parametrize("told", [False, True])
def test_curvature_that_moves_numbers_passes_only_where_another_check_fails(told: bool) -> None:
    bent = Bent(gain=100.0, p=1e-9, shift={"m": 1.0}, more=np.ones((1, 1)), share=0.3)
    check = curvature_check(bent, {"m": 0.1}, told=told)
    assert (check.passed, check.cause, check.values) == (told, "", {"z": 10.0})
    assert "move m by 10 sd of the record: something else is wrong" in check.detail


def test_two_faults_at_once_are_both_named_and_in_the_intervals(sound: Any) -> None:
    record, rig = sound
    late = filtered(record, "ax_position", 2e3)
    found = ambid.identify(changed(late, ay_position=lambda x: 1.01 * x), rig)
    check = found.checks["sensors_agree"]
    assert check.cause == "ax_position.lag"
    assert "ay_position.gain" not in check.alternatives  # which explain what the first does
    assert "With that taken out, ay_position.gain (+" in check.detail
    _, theta = model_of(replace(truth.BENCHES["rigid"], period=0.25))
    assert not [p.name for p in found.parameters if p.sd and abs(p.value - theta[p.name]) > 3.8 * p.sd]


def test_a_mass_that_only_scales_is_not_contradicted(sound: Any) -> None:
    """Without voltages a fixed mass sets the scale of all, and no record says anything against it."""
    found = ambid.identify(sound[0], driven(sound[1], 6.2))
    assert found.checks["fixed_agree"].passed, found.checks["fixed_agree"].detail
    assert found.verdict.word == "usable"
    assert "curvature" not in found.checks  # which is not tested without coils


def test_a_late_current_is_late_where_it_is_the_input(sound: Any) -> None:
    record, rig = sound
    pole = np.exp(-2.0 * np.pi * 2000.0 / record.rate_hz)
    late = filtered(record, "ax_current", 2000.0)
    check = ambid.identify(late, driven(rig, 6.0)).checks["sensors_agree"]
    assert (check.passed, check.cause) == (False, "ax_current.lag")
    assert check.size == pytest.approx(pole / (1.0 - pole) / record.rate_hz, rel=0.1)
    assert not [x for x in check.alternatives if "voltage" in x]


@pytest.mark.parametrize(("name", "kind"), [("ax_position.lag", "lag"), ("eddy_pole", "eddy")])
def test_a_lead_names_the_lags_of_current_and_voltage(sound: Any, name: str, kind: str) -> None:
    lead = Score(cause=Cause(name=name, kind=kind), z=-9.0, size=-1e-5, gain=81.0)
    check = agreement_checks([lead], sound[1].rotor)["sensors_agree"]
    of = ("currents", "voltages") if kind == "eddy" else ("ax_current", "ax_voltage")
    assert check.alternatives == tuple(f"{x}.lag" for x in of)
    assert "pole to" not in check.detail
    assert "a lead of 10 us" in check.detail


def driven(rig: Rig, mass: float) -> Rig:
    """The rig without voltages, of a known mass in kg."""
    assert rig.rotor is not None
    model = replace(rig.rotor, drives=("current",) * 4)
    channels = tuple(replace(c, delay=0) for c in rig.channels if not c.role.endswith("_voltage"))
    known = {p.name: p for p in rig.parameters} | {"m": replace(rig.parameter("m"), role="fixed", value=mass)}
    return replace(rig, rotor=model, channels=channels, parameters=tuple(known[p.name] for p in model.parameters))


def test_a_plane_and_a_gain_are_named_without_whole_periods(sound: Any) -> None:
    record, rig = sound[0][0.0:0.45], sound[1]
    plain = ambid.identify(record, rig)
    assert plain.verdict.word == "usable"
    assert "were not asked of eddy currents or of curvature" in plain.checks["sensors_agree"].detail
    assert plain.checks["uncertainty_consistent"].passed
    assert {"A.z", "A.z_sensor"} >= set(named(record, moved(rig, A__z_sensor=5e-3), "fixed_agree"))
    causes = named(changed(record, ax_position=lambda x: 1.05 * x), rig, "sensors_agree")
    assert causes[0] == "ax_position.gain"


def filtered(record: Record, role: str, hertz: float) -> Record:
    late = np.exp(-2.0 * np.pi * hertz / record.rate_hz)
    return changed(record, **{role: lambda x: lfilter([1.0 - late], [1.0, -late], x, zi=[late * x[0]])[0]})


def test_a_lag_of_a_coil_is_named_without_whole_periods(sound: Any) -> None:
    late = filtered(sound[0][0.0:0.45], "ax_current", 3000.0)
    assert set(named(late, sound[1], "sensors_agree")) == {"ax_current.lag", "ax_voltage.lag"}


def test_hum_is_named_without_whole_periods(sound: Any) -> None:
    record, rig = sound[0][0.0:0.45], sound[1]
    hum = 0.02 * np.sin(2.0 * np.pi * 50.0 * np.arange(record.n_samples) / record.rate_hz)
    check = ambid.identify(changed(record, bx_current=lambda x: x + hum), rig).checks["lines"]
    assert (check.passed, check.cause, check.alternatives) == (False, "line", ("mode",))
    assert check.size == pytest.approx(50.0, abs=1.2)
    assert "most in" not in check.detail  # the noise is taken as coloured with it, which spreads it over channels


@pytest.mark.parametrize("logs_a", [False, True])
def test_solid_iron_is_named_and_within_the_intervals(monkeypatch: Any, logs_a: bool) -> None:
    bench = replace(truth.BENCHES["rigid"], period=0.25)
    rig = free_rig(replace(bench, eddy_pole_hz=3000.0) if logs_a else bench)
    plain = truth.plant
    monkeypatch.setattr(truth, "plant", lambda b: iron(*plain(b)))
    found = ambid.identify(record_of(bench, 1), rig)
    check = found.checks["sensors_agree"]
    assert (found.verdict.word, check.cause) == ("caution", "solid_iron"), check.detail
    for name, right in {"m": bench.m, "Id": bench.Id, "ax.k_i": bench.k_i[0], "by.L": bench.L[3]}.items():
        assert abs(found[name].value - right) < 2.5 * found[name].sd < 0.3 * right, name


def iron(A: Any, B: Any, C: Any) -> tuple[Any, Any, Any]:
    """The plant of a rigid rotor whose forces lose what poles of many decades pass on, as (s/w)^0.5 does."""
    n, poles, current = A.shape[0], 2.0 * np.pi * np.geomspace(3.0, 3e5, 11), slice(8, 12)
    share = 0.04 * np.sqrt(poles / poles[6])
    big, into = np.zeros((n + 44, n + 44)), np.zeros((n + 44, B.shape[1]))
    big[44:, 44:], into[44:] = A, B
    force = A[:8, current]
    big[44:52, 52:56] -= share.sum() * force
    for k, (pole, part) in enumerate(zip(poles, share, strict=True)):
        own = slice(4 * k, 4 * k + 4)
        big[own, own], big[own, 52:56], big[44:52, own] = -pole * np.eye(4), pole * np.eye(4), part * force
    return big, into, np.hstack([np.zeros((8, 44)), C])


def test_a_shift_beyond_first_order_stays_finite(sound: Any) -> None:
    record, model = sound[0], sound[1].rotor
    excitation = find_excitation(record, model)
    assert excitation is not None
    experiment = Experiment(spectra=period_spectra(record, model, excitation), speed=0.0)
    known = sound[1].parameters
    fit = estimate_rotor([experiment], model, known, delays=[1.0] * 4, modes=RigModes(count=0))
    n, cause = fit.vector.size, Cause(name="currents.lag", kind="lag")
    far = Score(cause=cause, z=9.0, size=1.0, gain=81.0, shift=np.full(n, -1e3), spread=np.zeros(n))
    shift, _ = shifts_of(fit, [far])
    names, _ = fit.unknowns.chain(fit.vector)
    assert np.all(np.isfinite(shift))
    assert shift[names.index("m")] == pytest.approx((1.0 - np.exp(3.0)) * fit.point.theta["m"])
    bent = fit.model.with_modes(1)
    of_mode = {p.name: 1.0 for p in bent.mode_parameters} | {"mode1.omega": 900.0, "mode1.zeta": 0.01}
    at = replace(fit.point, theta={**fit.point.theta, **of_mode})
    unknowns = unknowns_at(bent, known, at, ())
    fit = replace(fit, unknowns=unknowns, base=at, vector=unknowns.pack(at.theta, at.delays))
    far = replace(far, shift=np.full(fit.vector.size, -1e3), spread=np.zeros(fit.vector.size))
    assert np.all(np.isfinite(shifts_of(fit, [far])[0]))


def test_a_score_does_not_depend_on_slopes_that_are_nearly_alike() -> None:
    rng = np.random.default_rng(1)
    J, c, r = rng.standard_normal((200, 6)), rng.standard_normal((200, 1)), rng.standard_normal(200)
    cause = (Cause(name="A.z", kind="fixed"),)
    plain = scored(cause, c + J[:, :1], J, r + 2.0 * c[:, 0], 200)[0]
    alike = scored(cause, c + J[:, :1], np.column_stack([J, J[:, 0] + 1e-9 * J[:, 1]]), r + 2.0 * c[:, 0], 200)[0]
    assert alike.z == pytest.approx(plain.z, rel=1e-6)
    assert plain.size == pytest.approx(2.0, abs=0.3)
    assert plain.shift[0] == pytest.approx(plain.size, rel=0.2)  # what the first slope takes up of the cause


@pytest.mark.parametrize(("at", "logged"), [(0.35, True), (0.8, True), (0.35, False)])
def test_lost_samples_are_named_by_the_phase_that_jumps(sound: Any, at: float, logged: bool) -> None:
    record, rig = sound
    kept = [c for c in record.channels if logged or not c.name.endswith("_reference")]
    cut = tuple(replace(c, values=np.delete(c.values, slice(int(at * 1e4), int(at * 1e4) + 3))) for c in kept)
    slip = find_slip(replace(record, channels=cut), rig.plant)
    assert slip is not None
    assert slip.samples == 3
    assert slip.at_s == pytest.approx(at, abs=0.1)
    assert find_slip(replace(record, channels=tuple(kept)), rig.plant) is None


@pytest.mark.parametrize("frequency", [151.3, 298.7])
def test_a_tone_over_the_excitation_is_no_lost_sample(sound: Any, frequency: float) -> None:
    """Such as a synchronous part: the phase drifts from period to period."""
    wave = np.sin(2.0 * np.pi * frequency * np.arange(sound[0].n_samples) / sound[0].rate_hz)
    channels = tuple(c for c in sound[0].channels if not c.name.endswith("_reference"))
    more = tuple(replace(c, values=c.values + 4.0 * np.std(c.values) * wave) for c in channels)
    assert find_slip(replace(sound[0], channels=more), sound[1].plant) is None


def test_a_record_that_lost_samples_is_not_usable(sound: Any) -> None:
    cut = tuple(replace(c, values=np.delete(c.values, slice(8000, 8003))) for c in sound[0].channels)
    found = ambid.identify(replace(sound[0], channels=cut), sound[1])
    assert found.verdict.word == "unusable"
    assert {p.role for p in found.parameters if p.identifiable} <= {"fixed"}
    complete = found.checks["samples_complete"]
    assert (complete.cause, complete.size) == ("lost_samples", 3.0)
    assert "3 samples, but for whole periods of 2500" in complete.detail


@pytest.mark.parametrize("frequency", [52.0, 50.0, 151.3])
def test_hum_is_named_and_taken_out(sound: Any, frequency: float) -> None:
    """On an excited line, where a narrow mode looks alike, between two, and between the lines of the whole record: all
    else stays as it was.
    """
    record, rig = sound
    hum = 2e-6 * np.sin(2.0 * np.pi * frequency * np.arange(record.n_samples) / record.rate_hz + 0.3)
    found, plain = ambid.identify(changed(record, ax_position=lambda x: x + hum), rig), ambid.identify(record, rig)
    on = frequency == 52.0
    assert found.verdict.word == ("caution" if on else "usable"), found.verdict.reasons
    assert [k for k, c in found.checks.items() if not c.passed] == ["lines"] * on
    assert not on or found.checks["lines"].alternatives == ("mode",)
    said = [w for w in found.warnings if "lines were taken out" in w]
    assert len(said) == 1
    told, where = said[0].split("taken out: ")[1].split(". ")[0].split(" Hz in ")
    assert float(told) == pytest.approx(frequency, abs=0.3)
    assert where == "ax_position"
    assert not [p.name for p in plain.parameters if abs(found[p.name].value - p.value) > p.sd]


def test_two_tones_close_together_are_named_and_taken_out(sound: Any) -> None:
    record, rig = sound
    t = np.arange(record.n_samples) / record.rate_hz
    hum = 0.01 * sum(np.sin(2.0 * np.pi * f * t + 0.3) for f in (50.0, 55.3))
    found = ambid.identify(changed(record, ax_current=lambda x: x + hum), rig)
    assert found.verdict.word == "usable", found.verdict.reasons
    said = next(w for w in found.warnings if "lines were taken out" in w).split("taken out: ")[1].split(". ")[0]
    frequencies = [float(line.removesuffix(" Hz in ax_current")) for line in said.split(", ")]
    assert sorted(frequencies) == pytest.approx([50.0, 55.3], abs=0.1)


def test_a_sound_record_has_no_line(sound: Any) -> None:
    assert not [w for w in ambid.identify(*sound).warnings if "lines" in w]


def test_a_record_with_tones_on_nearly_all_lines_is_refused(sound: Any) -> None:
    excitation = find_excitation(*(told := (sound[0], sound[1].plant)))
    assert excitation is not None
    spectra = period_spectra(*told, excitation)
    lines = [Line(frequency_hz=float(f), channel="ax_position") for f in spectra.frequency_hz[19:]]
    assert apart(spectra, lines[1:]).frequency_hz.size == 20
    with pytest.raises(EstimationError, match="needs 20 others"):
        apart(spectra, lines)


@pytest.mark.parametrize("seed", [1, 2])
def test_curvature_of_the_magnets_is_named_and_within_the_intervals(seed: int) -> None:
    """Beyond a tenth of the gap; less is in the intervals, and no current is blamed; a quarter of it moves nothing."""
    rig = rig_of_preset(preset("rmit"))
    assert rig.rotor is not None
    free = tuple(p if p.name in rig.rotor.places else Parameter(name=p.name, unit=p.unit) for p in rig.parameters)
    told: dict[str, Any] = {"duration": 1.0, "periods": 4, "excitation": "zippered", "band": (4.0, 500.0)}
    large, middle, small = (
        ambid.identify(
            ambid.simulate(rig, nonlinear=True, amplitude=x, seed=seed, **told), replace(rig, parameters=free)
        )
        for x in (10.0, 7.5, 2.5)
    )
    off = {x: large[f"{x}.L"].value - (rig.parameter(f"{x}.L").value or 0.0) for x in rig.rotor.axes}
    assert sum(off.values()) > 3.0 * sum(large[f"{x}.L"].value for x in off) * 1e-4  # all too large
    assert all(abs(off[x]) < 1.96 * large[f"{x}.L"].sd for x in off)
    assert "curvature of the magnets shows" in large.checks["curvature"].detail
    assert (middle.verdict.word, small.verdict.word) == ("usable", "usable")
    assert "the intervals hold it" in middle.checks["curvature"].detail
    assert "no curvature" in small.checks["curvature"].detail


def bent(record: Record, role: str) -> Record:
    """The record with channels of a role of which 2 % are cubic, without the linear part of that."""
    return changed(record, **{c.name: cubic for c in record.channels if c.name.endswith(role)})


def cubic(v: Any) -> Any:
    power = np.mean(v**2)
    return v + 0.02 * (v**3 / power - v * np.mean(v**4) / power**2)


@pytest.mark.parametrize("role", ["voltage", "current"])
def test_what_bends_a_channel_is_named_and_widens_the_intervals(sound: Any, role: str) -> None:
    """Without whole periods intervals also hold how far parts of the record disagree."""
    theta = model_of(replace(truth.BENCHES["rigid"], period=0.25))[1]
    for record, method in ((sound[0][0.0:0.45], "predictor"), (sound[0], "periods")):
        found = ambid.identify(bent(record, role), sound[1])
        assert (found.method, found.verdict.word == "usable") == (method, False)
        assert found.checks["sensors_agree"].cause == f"{role}s.limiter"
        assert "curvature" in found.checks["sensors_agree"].alternatives
        assert not found.checks["residuals_white"].passed
        holds = "the intervals hold how far its parts disagree" in found.checks["residuals_white"].detail
        assert holds == (method == "predictor")
        assert not [p.name for p in found.parameters if p.sd and abs(p.value - theta[p.name]) > 4.0 * p.sd]
