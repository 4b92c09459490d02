"""What a nonlinear model is to those who judge, compare, store and use it: predictions, simulations, their slopes."""

from __future__ import annotations

from typing import Any, Protocol

from ambid.arrays import Array


class NonlinearModel(Protocol):
    """A discrete-time model of inputs and outputs, in SI units of the record; time is axis 0.

    A model that works on scaled or centred signals does so inside. All arrays are read only for it.

    Attributes
    ----------
    kind : str
        Under which `identify.nonlinear.model_file` writes and finds it.
    dt : float
        Sampling interval in s.
    n_inputs, n_outputs : int
        Channels.
    lag : int
        Samples of the past that a prediction needs.
    names : tuple of str
        Of all parameters, in the order of `theta`.
    theta : ndarray, shape (n_theta,)
        All parameters.
    """

    @property
    def kind(self) -> str: ...  # noqa: D102
    @property
    def dt(self) -> float: ...  # noqa: D102
    @property
    def n_inputs(self) -> int: ...  # noqa: D102
    @property
    def n_outputs(self) -> int: ...  # noqa: D102
    @property
    def lag(self) -> int: ...  # noqa: D102
    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def theta(self) -> Array: ...  # noqa: D102

    def predict(self, u: Array, y: Array) -> Array:
        """Return one-step-ahead predictions of the outputs from past outputs and inputs.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are NaN: there is no past to predict them from.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def jacobian(self, u: Array, y: Array) -> Array:
        """Return the exact derivative of `predict` by `theta`.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples, n_outputs, n_theta)
            The first `lag` rows are zero.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def simulate(self, u: Array, y: Array) -> Array:
        """Run freely from the first `lag` measured samples on, without noise.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (at least lag, n_outputs), SI
            Only the first `lag` rows are looked at.

        Returns
        -------
        ndarray, shape (n_samples, n_outputs), SI
            The first `lag` rows are those of `y`. NaN from where a run diverges on (here: leaves
            a million times the size of the training data); never clipped.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def novelty(self, u: Array, y: Array) -> Array:
        """Say how far from the training data a prediction is made.

        Parameters
        ----------
        u : ndarray, shape (n_samples, n_inputs), SI
        y : ndarray, shape (n_samples, n_outputs), SI

        Returns
        -------
        ndarray, shape (n_samples,)
            0 in the middle of what was trained on, 1 at its edge, above 1 outside: there the model extrapolates. The
            first `lag` rows are NaN.

        Raises
        ------
        EstimationError
            If the signals are not of the model's shape.
        """
        ...

    def as_json(self) -> dict[str, Any]:
        """Return all that `nonlinear.model_file` needs to read it back; numbers survive bit by bit."""
        ...
