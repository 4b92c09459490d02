"""Innovations that no number explains: a knock that passes, noise that has risen for good, or a model that fails.

A block with much more than usual is set aside and the predictor begins anew behind it. If that goes on, and no change
of the bench explains it, it is taken as noise as long as it can be believed; beyond that nothing is learned.
"""

from __future__ import annotations

from ambid.track.evidence import Evidence

WILD = 2.0  # times the usual variance of a block's innovations: far more than chance makes
_PERSISTENT = 3  # wild blocks on end, each with a fresh predictor: that is no knock
_BELIEVED = 25.0  # variance of the innovations over that at identification up to which it is taken as noise
_FIRST_WAIT_S, _LONGEST_WAIT_S = 0.1, 10.0  # until the next search while nothing is learned


def unexplained(evidence: Evidence) -> float:
    """Return the variance of what no number explains in a block.

    Returns 1 as at identification, also where a block is too short to tell.
    """
    return evidence.rest / evidence.freedom if evidence.freedom else 1.0


class Unexplained:
    """Keeps count of blocks that the model does not explain.

    `blocks`: wild blocks on end; `deaf`: whether nothing is learned: the error is larger than could be believed to be
    noise; `noise`: variance of the noise over that at identification, as it was taken: 1 if it never rose.
    """

    def __init__(self) -> None:
        self.blocks, self.deaf, self.noise = 0, False, 1.0
        self._sum, self._wait = 0.0, _FIRST_WAIT_S
        self._again = 0.0

    @property
    def level(self) -> float:
        """Mean variance of the wild blocks but the first, in which it began."""
        return self._sum / max(self.blocks - 1, 1) if self.blocks else 1.0

    @property
    def persists(self) -> bool:
        """Whether it is no knock."""
        return self.blocks >= _PERSISTENT

    @property
    def believable(self) -> bool:
        """Whether it may be noise."""
        return self.level <= _BELIEVED

    def count(self, variance: float) -> None:
        """Count a wild block."""
        self.blocks += 1
        self._sum = variance if self.blocks <= 2 else self._sum + variance

    def close_ears(self, t: float) -> None:
        """Learn nothing until it is over, or until a search is due.

        `t`: s of record.
        """
        self.deaf = True
        self._again = t + self._wait
        self._wait = min(2.0 * self._wait, _LONGEST_WAIT_S)

    def search_due(self, t: float) -> bool:
        """Tell whether it is time to look again for a change that explains it.

        `t`: s of record.
        """
        return self.deaf and t >= self._again

    def over(self) -> None:
        """Begin anew: the model explains the data again."""
        self.blocks, self._sum, self.deaf, self._wait = 0, 0.0, False, _FIRST_WAIT_S
