"""Models as the objects of python-control.

What has no place in the other object is refused or named, never dropped silently: its objects know neither noise
models nor operating points, and its transfer functions no delay in continuous time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ambid.blackbox.model import BlackBoxModel, PolynomialModel, Polynomials, StateSpaceModel, TransferModel
from ambid.errors import ModelError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[np.float64]


def to_control(model: BlackBoxModel) -> Any:
    """Return the input-output part of a model as an object of python-control.

    Parameters
    ----------
    model : BlackBoxModel

    Returns
    -------
    control.StateSpace or control.TransferFunction
        A transfer function for transfer and polynomial models, a state space for state-space models.

    Raises
    ------
    ModelError
        If python-control is not installed, the model has no inputs, or a delay in continuous time.
    """
    control = _control()
    _with_inputs(model)
    dt = 0 if model.dt is None else model.dt
    if isinstance(model, StateSpaceModel):
        return control.ss(model.A, model.B, model.C, model.D, dt)
    if isinstance(model, PolynomialModel):
        pairs = [[_entry(p, i) for i in range(model.n_inputs)] for p in model.outputs]
    else:
        assert isinstance(model, TransferModel)
        pairs = [[_delayed(model, o, i) for i in range(model.n_inputs)] for o in range(model.n_outputs)]
    return control.tf([[n for n, _ in row] for row in pairs], [[d for _, d in row] for row in pairs], dt)


def state_space_to_control(A: Array, B: Array, C: Array) -> Any:
    """Return a continuous plant without direct path as a control.StateSpace."""
    return _control().ss(A, B, C, [[0.0] * B.shape[1]] * C.shape[0])


def discrete_to_control(A: Array, B: Array, C: Array, D: Array, dt: float) -> Any:
    """Return a discrete-time system as a control.StateSpace."""
    return _control().ss(A, B, C, D, dt)


def _control() -> Any:
    try:
        import control
    except ImportError:
        raise ModelError("python-control is not installed. Install ambid[control]") from None
    return control


def _with_inputs(model: BlackBoxModel) -> None:
    if not model.n_inputs:
        raise ModelError("a time series has no transfer function from inputs. Use its state_space() with the gain K")


def _reduced(num: Array) -> Array:
    """Take leading zeros off."""
    used = np.nonzero(num)[0]
    return np.asarray(num[used[0] :] if used.size else num[-1:])


def _entry(p: Polynomials, i: int) -> tuple[Array, Array]:
    """B/(A F) of one input with powers of z, highest first."""
    den = np.convolve(p.A, p.F[i])
    size = max(den.size, p.B[i].size)
    return _reduced(np.pad(p.B[i], (0, size - p.B[i].size))), np.pad(den, (0, size - den.size))


def _delayed(model: TransferModel, o: int, i: int) -> tuple[Array, Array]:
    later = 0
    if model.delay[i]:
        if model.dt is None:
            raise ModelError(
                f"the continuous model has a delay of {model.delay[i]:g} s, which a rational transfer function "
                "cannot hold. Remove the delay, or use a discrete structure"
            )
        later = round(model.delay[i] / model.dt)
    return model.num[o][i], np.concatenate([model.den[o][i], np.zeros(later)])
