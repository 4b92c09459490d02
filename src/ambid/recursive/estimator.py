"""What every recursive estimator promises: the same numbers from single samples and from blocks, and a way back."""

from __future__ import annotations

from typing import Protocol, Self

from numpy.typing import ArrayLike

from ambid.arrays import Array


class RecursiveEstimator(Protocol):
    """A stateful estimator that is fed samples as they come.

    Splitting a stream into calls of `update` differently does not change any number: work that is done once for
    several samples is done at fixed counts of samples, not at the ends of blocks. A sample that holds a number that is
    not finite is rejected: it changes no estimate, is counted, and an estimator with a memory of past signals starts
    that memory anew. Memory does not grow with the number of samples.

    Attributes
    ----------
    names : tuple of str
        The estimated numbers.
    estimate : ndarray, shape (p,)
        A copy of their present values, in the units of the signals.
    covariance : ndarray, shape (p, p)
        A copy; symmetric, positive definite.
    n_used, n_rejected : int
        Samples that were used, and those that were not because they held a number that is not finite.
    """

    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def estimate(self) -> Array: ...  # noqa: D102
    @property
    def covariance(self) -> Array: ...  # noqa: D102
    @property
    def n_used(self) -> int: ...  # noqa: D102
    @property
    def n_rejected(self) -> int: ...  # noqa: D102

    def update(self, inputs: ArrayLike, outputs: ArrayLike) -> Array:
        """Take in one sample or a block.

        Parameters
        ----------
        inputs : array_like, shape (n_inputs,), or (n_samples, n_inputs) for a block
            A number, or (n_samples,), where there is one input. A regression takes regressors.
        outputs : array_like, shape (n_outputs,), or (n_samples, n_outputs) for a block
            A number, or (n_samples,), where there is one output.

        Returns
        -------
        ndarray, shape of `outputs`
            Errors of prediction made before each sample was used; NaN where nothing was predicted.

        Raises
        ------
        EstimationError
            If the shapes do not fit.
        """
        ...

    def copy(self) -> Self:
        """Return an independent estimator in the same state: what a rollback returns to.

        Returns
        -------
        RecursiveEstimator
        """
        ...
