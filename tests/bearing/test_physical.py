"""From black box to physics: invariant, exact without noise, honest with it, and silent about nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import chi2, kstest

from ambid.bearing.linear import greybox
from ambid.bearing.physical import physical_parameters
from ambid.bearing.physical_target import physical_response
from ambid.bearing.uncertainty import uncertainty
from ambid.blackbox import fit as structures
from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials, StateSpaceModel, TransferModel
from ambid.errors import EstimationError
from ambid.physics.linear_model import Parameter, discretise, model
from tests.bearing.benches import BEARING, COIL, SPRUNG, THESIS, parameters, run
from tests.tiers import runs

UNITS = {"voltage": "V", "current": "A", "position": "m"}
PLANTS = {"one-axis": (THESIS, 1e-4), "coil": (COIL, 1e-4), "rotor": (SPRUNG, 2e-4)}


def asked(of, truth, *fixed, **priors):
    def one(p):
        if p.name in fixed:
            return Parameter(name=p.name, unit=p.unit, role="fixed", value=truth[p.name])
        if p.name in priors:
            return Parameter(name=p.name, unit=p.unit, role="prior", value=truth[p.name], sd=priors[p.name])
        return Parameter(name=p.name, unit=p.unit)

    return [one(p) for p in of.parameters]


def sampled(of, truth, dt, delay=0.0):
    """State space of a sampled plant, the delayed inputs as further states."""
    whole = int(delay)
    d, _ = discretise(of.matrices(truth), dt, fraction=delay - whole)
    n, later = d.A.shape[0], whole + 1
    A, B = np.zeros((n + later, n + later)), np.zeros((n + later, 1))
    A[:n, :n] = d.A
    columns = [d.B, d.B_late]  # of u[k - whole], u[k - whole - 1]; state n + j holds u[k - 1 - j]
    for extra, b in enumerate(columns):
        back = whole + extra
        if back:
            A[:n, n + back - 1] += b[:, 0]
        else:
            B[:n] += b
    A[n + 1 :, n:-1] = np.eye(later - 1)
    B[n] = 1.0
    C = np.hstack([d.C, np.zeros((d.C.shape[0], later))])
    return A, B, C


def turned(A, B, C, seed=0):
    """The same plant in other states, all of like size under an excitation from 1/300 of the sampling rate up."""
    z = np.exp(1j * np.geomspace(0.02, 3.0, 40))
    size = np.sqrt(np.mean([np.abs(np.linalg.solve(p * np.eye(A.shape[0]) - A, B[:, 0])) ** 2 for p in z], axis=0))
    Q = np.linalg.qr(np.random.default_rng(seed).standard_normal(A.shape))[0]
    T, inverse = Q / size, (Q * size).T
    return T @ A @ inverse, T @ B, C @ inverse


def fit_of(black_box, relative, *, dt=1e-4, of="one-axis", seed=1, structure="pbsid"):
    """A fit with a covariance of full rank over the coefficients that are not zero."""
    rng = np.random.default_rng(seed)
    blocks = [getattr(black_box, x) for x in "ABCDK"] if isinstance(black_box, StateSpaceModel) else None
    typical = (
        np.abs(black_box.theta)
        if blocks is None
        else np.concatenate(
            [np.broadcast_to(np.sqrt(np.mean(b**2, axis=1, keepdims=True)), b.shape).ravel() for b in blocks]
        )
    )
    sd = relative * typical
    mix = np.eye(sd.size) + 0.2 * rng.standard_normal((sd.size, sd.size)) / np.sqrt(sd.size)
    factor = sd[:, None] * mix
    plant = model(of)
    return BlackBoxFit(
        structure=structure, orders={}, model=black_box, covariance=factor @ factor.T, n_estimated=sd.size,
        offsets=Offsets(u=np.zeros(1), y=np.zeros(len(plant.outputs))),
        noise_covariance=np.eye(len(plant.outputs)), inputs=plant.inputs, outputs=plant.outputs, units=UNITS, dt=dt,
        record={"samples": 20_000},
    )  # fmt: skip


def state_space(A, B, C, dt):
    n_y = C.shape[0]
    return StateSpaceModel(A=A, B=B, C=C, D=np.zeros((n_y, 1)), K=np.zeros((A.shape[0], n_y)), dt=dt)


@pytest.mark.parametrize("dt", [None, 1e-4])
@pytest.mark.parametrize("name", list(PLANTS))
def test_derivatives_equal_fourth_differences(name, dt):
    of, truth, omega = model(name), dict(PLANTS[name][0]), np.geomspace(3.0, 2e4, 9)
    names = [p.name for p in of.parameters]
    _, slope = physical_response(of, truth, omega, dt=dt, delay_s=1.3e-4, along=names, with_delay=True)
    for j, parameter in enumerate(names):
        step = (abs(truth[parameter]) or 1.0) * 1e-4
        ends = [
            physical_response(of, {**truth, parameter: truth[parameter] + s * step}, omega, dt=dt, delay_s=1.3e-4)[0]
            for s in (-2, -1, 1, 2)
        ]
        wanted = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        np.testing.assert_allclose(slope[..., j], wanted, rtol=1e-6, atol=1e-7 * np.abs(slope[..., j]).max())
    ends = [physical_response(of, truth, omega, dt=dt, delay_s=1.3e-4 + s * 1e-8)[0] for s in (-1, 1)]
    np.testing.assert_allclose(
        slope[..., -1], (ends[1] - ends[0]) / 2e-8, rtol=1e-6, atol=1e-6 * np.abs(slope[..., -1]).max()
    )


@pytest.mark.parametrize("delay", [0.0, 2.0, 1.4])
@pytest.mark.parametrize("name", list(PLANTS))
def test_a_perfect_black_box_gives_the_truth(name, delay):
    of, (truth, dt) = model(name), PLANTS[name]
    matrices = turned(*sampled(of, truth, dt, delay))
    fixed = {"one-axis": ("c",), "coil": (), "rotor": ("m",)}[name]
    found = physical_parameters(fit_of(state_space(*matrices, dt), 1e-5, of=name, dt=dt), of, asked(of, truth, *fixed))
    assert found.misfit.passed
    assert found.delay.samples + found.delay.fraction == pytest.approx(delay, abs=1e-5)
    for p in found.parameters:
        assert p.value == pytest.approx(truth[p.name], rel=1e-5), p.name


def test_the_choice_of_states_does_not_matter():
    of, dt = model("one-axis"), 1e-4
    A, B, C = turned(*sampled(of, THESIS, dt))
    first = fit_of(state_space(A, B, C, dt), 1e-5)
    # the same model, with its covariance, in other states: theta_2 = f(theta_1), by the exact linear map of each block
    rng = np.random.default_rng(4)
    T = np.eye(A.shape[0]) + 0.3 * rng.standard_normal(A.shape)
    inverse = np.linalg.inv(T)
    slope = np.zeros_like(first.covariance)
    at = 0
    for block in (np.kron(T, inverse.T), T, np.kron(np.eye(2), inverse.T)):
        slope[at : at + block.shape[0], at : at + block.shape[0]] = block
        at += block.shape[0]
    second = replace(
        first, model=state_space(T @ A @ inverse, T @ B, C @ inverse, dt), covariance=slope @ first.covariance @ slope.T
    )
    found = [physical_parameters(f, of, asked(of, THESIS, "c")) for f in (first, second)]
    for k in found[0].values:
        assert found[0].values[k] == pytest.approx(found[1].values[k], rel=1e-6, abs=1e-12)
    np.testing.assert_allclose(np.diag(found[0].covariance), np.diag(found[1].covariance), rtol=1e-3)


def test_continuous_models_are_taken_as_they_are():
    of = model("one-axis")
    s = of.matrices(BEARING)
    first = physical_parameters(fit_of(state_space(s.A, s.B, s.C, None), 1e-4, dt=5e-5), of, asked(of, BEARING, "c"))
    den = np.poly(s.A)
    m, k_x, k_i, ell = (BEARING[k] for k in ("m", "k_x", "k_i", "L"))
    num = (np.array([k_i / (m * ell)]), np.array([1.0, 0.0, k_x / m]) / ell)
    transfer = TransferModel(num=tuple((x,) for x in num), den=((den,), (den,)), dt=None, delay=(1e-4,))
    second = physical_parameters(fit_of(transfer, 1e-4, dt=5e-5), of, asked(of, BEARING, "c"))
    for found, delay in ((first, 0), (second, 2)):
        assert found.delay.samples == delay
        for k in ("m", "k_x", "k_i", "R", "L"):
            assert found.values[k] == pytest.approx(BEARING[k], rel=1e-4)


def test_intervals_cover_the_truth():
    # coefficients drawn from their own covariance: 95 % intervals hold the truth in 95 of 100 draws
    of, dt, rng = model("one-axis"), 1e-4, np.random.default_rng(7)
    matrices = turned(*sampled(of, THESIS, dt))
    exact = fit_of(state_space(*matrices, dt), 3e-6)
    values, ways = np.linalg.eigh(exact.covariance)
    factor = ways * np.sqrt(np.maximum(values, 0.0))
    n, inside, left = exact.model.order, [], []
    n_draws = runs(50, short=15)
    for _ in range(n_draws):
        theta = exact.model.theta + factor @ rng.standard_normal(factor.shape[1])
        A, B, C = (
            theta[: n * n].reshape(n, n),
            theta[n * n : n * n + n, None],
            theta[n * n + n :][: 2 * n].reshape(2, n),
        )
        found = physical_parameters(replace(exact, model=state_space(A, B, C, dt)), of, asked(of, THESIS, "c"), delay=0)
        inside.append([p.ci95[0] <= THESIS[p.name] <= p.ci95[1] for p in found.parameters if p.role == "free"])
        left.append(found.misfit.p)
    assert np.all(np.abs(np.mean(inside, axis=0) - 0.95) < n_draws.limit(0.09, centre=0))
    assert np.mean(np.array(left) < 0.1) < n_draws.limit(0.25, centre=0.1)


def plain():
    return fit_of(state_space(*turned(*sampled(model("one-axis"), THESIS, 1e-4)), 1e-4), 1e-5)


def test_what_the_black_box_lacks_is_refused_by_name():
    of, asks = model("one-axis"), asked(model("one-axis"), THESIS, "c")
    fit = plain()
    one_output = replace(fit.model, C=fit.model.C[:1], D=fit.model.D[:1], K=fit.model.K[:, :1])
    with pytest.raises(EstimationError, match="no output for 'current'"):
        physical_parameters(replace(fit, model=one_output, outputs=("position",)), of, asks)
    with pytest.raises(EstimationError, match="no input for 'voltage'"):
        physical_parameters(replace(fit, inputs=("pressure",)), of, asks)
    with pytest.raises(EstimationError, match="no covariance"):
        physical_parameters(replace(fit, covariance=None), of, asks)
    coil = fit_of(state_space(*turned(*sampled(model("coil"), COIL, 1e-4)), 1e-4), 1e-5, of="coil")
    small = StateSpaceModel(
        A=coil.model.A,
        B=coil.model.B,
        C=np.ones((2, 1)) @ coil.model.C,
        D=np.zeros((2, 1)),
        K=np.zeros((2, 2)),
        dt=1e-4,
    )
    with pytest.raises(EstimationError, match="has 2 poles"):
        physical_parameters(fit_of(small, 1e-5), of, asks)
    with pytest.raises(EstimationError, match="every parameter is fixed"):
        physical_parameters(fit, of, asked(of, THESIS, *THESIS))
    with pytest.raises(EstimationError, match="parameter 'm' of 'one-axis' is missing"):
        physical_parameters(fit, of, asks[1:])


def test_channels_are_found_by_unit_and_by_role():
    of, fit = model("one-axis"), plain()
    asks = asked(of, THESIS, "c")
    renamed = replace(
        fit, inputs=("u1",), outputs=("probe", "shunt"), units={"u1": "V", "probe": "m", "shunt": "A"}
    )  # by unit
    told = replace(renamed, units={"u1": "V", "probe": "m", "shunt": "V"})
    first = physical_parameters(renamed, of, asks)
    second = physical_parameters(told, of, asks, roles={"current": "shunt"})
    assert first.values["k_i"] == second.values["k_i"] == pytest.approx(THESIS["k_i"], rel=1e-4)
    with pytest.raises(EstimationError, match="no output for 'current'"):
        physical_parameters(told, of, asks)


def test_another_plant_is_called_another_plant():
    # a coil with an eddy-current pole is no coil: the better a black box knows it, the louder it says so
    of, dt = model("coil"), 1e-4
    A = np.array([[-860.0, 0.0], [1500.0, -1500.0]])
    B, C = np.array([[550.0], [0.0]]), np.array([[0.7, 0.3]])
    big = expm(np.block([[A, B], [np.zeros((1, 3))]]) * dt)
    eddy = state_space(big[:2, :2], big[:2, 2:], C, dt)
    rough, sharp = (
        physical_parameters(fit_of(eddy, s, of="coil"), of, asked(of, COIL), delay=0) for s in (1.5e-2, 1e-4)
    )
    assert not rough.misfit.passed
    assert not rough.passed
    assert any("only roughly" in w for w in rough.warnings)
    assert any("contradicts 'coil'" in w for w in sharp.warnings)
    assert not any(p.identifiable for p in sharp.parameters)
    assert (rough.verdict.word, sharp.verdict.word) == ("caution", "unusable")


def test_what_does_not_show_is_not_identifiable():
    # position alone knows ratios to m (theory.md sec. 1): with a rotor's mass free, nothing that hangs on it is known
    of = model("rotor")
    fit = fit_of(state_space(*turned(*sampled(of, SPRUNG, 2e-4)), 2e-4), 1e-5, of="rotor", dt=2e-4)
    found = physical_parameters(fit, of, asked(of, SPRUNG))
    assert not found.passed
    assert {p.name for p in found.parameters if not p.identifiable} == {"m", "k_x", "k_i", "c"}
    assert found.misfit.passed
    known = physical_parameters(fit, of, asked(of, SPRUNG, m=0.005))
    by_name = {p.name: p for p in known.parameters}
    assert by_name["m"].sd == pytest.approx(0.005, rel=1e-3)
    assert by_name["k_i"].sd / SPRUNG["k_i"] == pytest.approx(0.01, rel=0.05)
    assert all(p.identifiable for p in known.parameters)


def test_inputs_are_not_changed_and_results_repeat():
    of, fit = model("one-axis"), plain()
    before = fit.covariance.copy()
    first, second = (physical_parameters(fit, of, asked(of, THESIS, "c")) for _ in range(2))
    np.testing.assert_array_equal(fit.covariance, before)
    assert first.values == second.values
    assert np.linalg.eigvalsh(first.covariance / np.sqrt(np.outer(*[np.diag(first.covariance)] * 2))).min() > 0


def test_a_model_without_a_number_to_spare_keeps_its_own_delay():
    # one pole, one number: any delay could be had by another R and L, so none is searched for
    of, dt = model("coil"), 1e-4
    d, _ = discretise(of.matrices(COIL), dt, fraction=0.0)
    one = np.ones(1)
    held = Polynomials(A=[1.0, -d.A[0, 0]], B=([0.0, 0.0, 0.0, d.B[0, 0]],), C=one, D=one, F=(one,))
    fit = fit_of(PolynomialModel(outputs=(held,), dt=dt), 1e-4, of="coil", structure="arx")
    fixed = np.array([n in ("a0", "c0", "d0", "f0", "b0", "b1", "b2") for n in fit.model.names])
    covariance = np.where(fixed[:, None] | fixed, 0.0, fit.covariance)
    found = physical_parameters(replace(fit, covariance=covariance), of, asked(of, COIL))
    assert (found.delay.samples, found.delay.how) == (2, "given")
    assert found.values["L"] == pytest.approx(COIL["L"], rel=1e-6)
    assert found.misfit.p is None


def identified(name, n, seed, structure, orders):
    bench = run(name, n, seed)
    data = IOData(
        u=bench.signals.u, y=bench.signals.y, dt=1 / bench.signals.rate_hz, inputs=bench.model.inputs,
        outputs=bench.model.outputs, units=UNITS, record={"samples": n},
    )  # fmt: skip
    return bench, structures.structure(structure).estimator(data, orders)


@pytest.mark.parametrize(
    ("name", "n", "fixed", "structure", "orders"),
    [("thesis", 8000, ("c",), "pbsid", {"n": 3}),
     ("bearing", 20_000, ("c",), "pbsid", {"n": 4}),
     ("falling rotor", 8000, ("m", "c"), "armax", {"na": 2, "nb": 2, "nc": 2, "nk": 2}),
     ("coil", 5000, (), "armax", {"na": 1, "nb": 1, "nc": 1, "nk": 1})],
)  # fmt: skip
def test_black_box_and_grey_box_agree_on_the_same_record(name, n, fixed, structure, orders):
    bench, fit = identified(name, n, 0, structure, orders)
    asks = parameters(bench, fixed=fixed)
    found = physical_parameters(fit, bench.model, asks)
    grey = greybox(bench.model, bench.signals, asks)
    known = uncertainty(grey)
    values = grey.vector[grey.problem.slices["physical"]] * grey.problem.magnitude
    assert found.covariance_names == known.names
    total = found.covariance + known.information  # wide for two estimates from one record, whose errors go together
    off, sd = np.array([found.values[k] for k in known.names]) - values, np.sqrt(np.diag(total))
    assert chi2.sf((off / sd) @ np.linalg.solve(total / np.outer(sd, sd), off / sd), off.size) > 1e-3
    assert found.delay.samples == bench.delay
    assert all(p.identifiable for p in found.parameters)
    for k, sd in zip(found.covariance_names, np.sqrt(np.diag(found.covariance)), strict=True):
        assert abs(found.values[k] - bench.truth[k]) < min(5 * sd, 0.02 * abs(bench.truth[k])), k
        # nothing is sharper than the maximum likelihood of the right model
        assert sd > 0.6 * np.sqrt(known.information[known.names.index(k), known.names.index(k)])


def test_intervals_from_identified_black_boxes_hold():
    # an unstable plant in a loop, 24 records: standard deviations are those of the errors
    z, n = [], runs(24, short=10)
    for seed in range(n):
        bench, fit = identified("falling rotor", 5000, seed, "armax", {"na": 2, "nb": 2, "nc": 2, "nk": 2})
        found = physical_parameters(fit, bench.model, parameters(bench, fixed=("m", "c")))
        z.append([(found.values[k] - bench.truth[k]) / np.sqrt(v) for k, v in
                  zip(found.covariance_names, np.diag(found.covariance), strict=True)])  # fmt: skip
    z = np.array(z)
    assert np.all(np.abs(z.mean(axis=0)) < n.limit(0.75, centre=0))
    assert np.all(
        np.mean(np.abs(z) < 1.96, axis=0) > n.limit(0.79)
    )  # 95 % of 24: fewer than 19 in one of 10 000 trials
    assert np.all(np.std(z, axis=0) > n.limit(0.5, centre=1))


@pytest.mark.parametrize(
    ("name", "n", "fixed", "structure", "orders", "seeds"),
    [("falling rotor", 5000, ("m", "c"), "pbsid", {"n": 3}, 10),
     ("bearing", 8000, ("c",), "pbsid", {"n": 4}, 6)],
)  # fmt: skip
def test_errors_are_of_the_size_that_is_said(name, n, fixed, structure, orders, seeds):
    # no record is picked: each counts, passed or not. A delay's pole lies where the record hardly sees it, anywhere
    # from -0.8 to 0.3, so that the black box is far from linear in what it does not know
    z, joint, left = [], [], []
    for seed in range(seeds):
        bench, fit = identified(name, n, seed, structure, orders)
        found = physical_parameters(fit, bench.model, parameters(bench, fixed=fixed))
        off = np.array([found.values[k] - bench.truth[k] for k in found.covariance_names])
        sd = np.sqrt(np.diag(found.covariance))
        z.append(off / sd)
        joint.append(chi2.sf((off / sd) @ np.linalg.solve(found.covariance / np.outer(sd, sd), off / sd), off.size))
        left.append(found.misfit.p)
    rms = np.sqrt(np.mean(np.square(z), axis=0))
    slack = 2.5 / np.sqrt(2 * seeds)
    assert np.all(rms < 1 + slack)
    assert np.all(rms > 0.85 - slack - (0.2 if structure == "pbsid" else 0.0))  # few groups count as wider
    assert np.max(np.abs(z)) < 4.5
    assert kstest(joint, "uniform", alternative="greater").pvalue > 1e-3  # no more small ones than chance allows
    assert np.mean(np.array(left) < 1e-3) < 0.2
