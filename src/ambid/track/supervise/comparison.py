"""What the gate holds and what it decides on: accepted numbers, and two sets of numbers compared on later data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from ambid.arrays import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Accepted:
    """Numbers that were accepted."""

    values: Array  # (p,)
    covariance: Array  # (p, p)
    t: float  # when, s of record
    why: str
    refined: bool = False  # whether they say the same as those before, only better, by the covariances of both


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Candidate q against rival numbers a on evidence (J, r at q): what the gate decides on."""

    blocks: int
    gain: float  # loss of the rival less loss of the candidate: twice the gain in log-likelihood
    # |J (q - a)|², the gain to be expected if the candidate is the truth (minus that if the rival is)
    separation: float
    sd: float  # standard deviation of the gain if the candidate is right up to its covariance
    # whitened square of the candidate's own residual: chi-squared with p degrees of freedom if it is right
    misfit: float
    # square of q - a over the sum of both covariances: whether the candidate says that something is not as accepted
    claim: float
    scale: float  # overdispersion by which these are to be judged, 1 or more

    @property
    def text(self) -> str:
        """The reason in numbers, one line."""
        return (
            f"over {self.blocks} blocks gain {self.gain:.3g}, expected {self.separation:.3g} with sd {self.sd:.2g}, "
            f"misfit {self.misfit:.3g}"
        )

    @property
    def values(self) -> Mapping[str, float]:
        """All of it, for an event."""
        return {
            "blocks": float(self.blocks),
            "gain": self.gain,
            "separation": self.separation,
            "sd": self.sd,
            "misfit": self.misfit,
            "claim": self.claim,
            "scale": self.scale,
        }
