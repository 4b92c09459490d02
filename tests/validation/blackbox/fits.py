"""Small fits made by hand, so that judging is tested apart from the estimators."""

from __future__ import annotations

import numpy as np

from ambid.blackbox.data import IOData
from ambid.blackbox.fit import BlackBoxFit, build_fit
from ambid.blackbox.model import Offsets, PolynomialModel, Polynomials

DT = 0.01


def io(u, y, **options):
    """Data with names of their own."""
    u, y = np.asarray(u, dtype=float), np.asarray(y, dtype=float)
    u, y = u.reshape(y.shape[0], -1), y.reshape(y.shape[0], -1)
    inputs, outputs = (tuple(f"{c}{k}" for k in range(x.shape[1])) for c, x in (("u", u), ("y", y)))
    return IOData(
        u=u, y=y, dt=DT, inputs=inputs, outputs=outputs, units=dict.fromkeys((*inputs, *outputs), "1"), **options
    )


def run(model, u, e):
    """Output of a polynomial model, from rest."""
    from ambid.estimation.kernels import state_scan

    ss = model.state_space()
    z = np.hstack([u, e])
    work = np.hstack([np.zeros((len(u), ss.order)), z])
    state_scan(np.ascontiguousarray(np.hstack([ss.A, ss.B, ss.K])), work, np.zeros(ss.order))
    return work[:, : ss.order] @ ss.C.T + u @ ss.D.T + e


def polynomial(A=(1.0,), B=((0.0,),), C=(1.0,), D=(1.0,), F=((1.0,),)):
    """One-output polynomial model."""
    return PolynomialModel(outputs=(Polynomials(A=A, B=B, C=C, D=D, F=F),), dt=DT)


def arx(data: IOData, na: int, nb: int, nk: int = 1) -> BlackBoxFit:
    """One-output ARX fit by QR, with offset, covariance over all coefficients."""
    u, y = data.u - data.u.mean(axis=0), data.y - data.y.mean(axis=0)
    first, N = max(na, nb + nk - 1), len(y)
    columns = [-y[first - k : N - k, 0] for k in range(1, na + 1)]
    columns += [u[first - nk - k : N - nk - k, i] for i in range(u.shape[1]) for k in range(nb)]
    phi = np.stack([*columns, np.ones(N - first)], axis=1)
    theta, *_ = np.linalg.lstsq(phi, y[first:, 0], rcond=None)
    e = y[first:, 0] - phi @ theta
    variance = e @ e / (len(e) - phi.shape[1])
    inner = np.linalg.inv(phi.T @ phi) * variance
    a = np.concatenate([[1.0], theta[:na]])
    b = tuple(np.concatenate([np.zeros(nk), theta[na + i * nb : na + (i + 1) * nb]]) for i in range(u.shape[1]))
    model = polynomial(A=a, B=b, F=((1.0,),) * u.shape[1])
    free = [
        (n.startswith("a") and n != "a0") or (n.startswith("b") and int(n[1:].split(".")[0]) >= nk) for n in model.names
    ]
    covariance = np.zeros((len(free),) * 2)
    covariance[np.ix_(free, free)] = inner[: na + nb * u.shape[1], : na + nb * u.shape[1]]
    gain = a.sum()
    return build_fit(
        "arx",
        data,
        orders={"na": na, "nb": nb, "nk": nk},
        model=model,
        covariance=covariance,
        n_estimated=na + nb * u.shape[1],
        offsets=Offsets(u=data.u.mean(axis=0), y=data.y.mean(axis=0) + theta[-1] / gain),
        noise_covariance=np.array([[variance]]),
    )
