"""Have everything compiled and loaded before the first sample comes: a tracker that is thrown away does it all once."""

from __future__ import annotations

import numpy as np

from ambid.recursive.lines import Event
from ambid.track.physical.numbers import TrackedNumbers
from ambid.track.physical.rpem import Memory, PhysicalRpem
from ambid.track.physical.signals import RecentSamples, Samples
from ambid.track.supervise.recovery import begin
from ambid.track.supervise.supervisor import Supervisor

_BLOCKS = 240  # after as many the walks of the numbers have been adapted once


def warm_up(numbers: TrackedNumbers, memory: Memory = "auto") -> None:
    """Track noise at the operating point, and search a change in it."""
    supervisor = Supervisor(PhysicalRpem(numbers, memory=memory))
    rpem, before = supervisor.rpem, supervisor.rpem.filter.copy()
    n, n_u = _BLOCKS * rpem.block_samples, len(numbers.problem.model.inputs)
    sizes = np.concatenate(
        [np.zeros(n_u), np.sqrt(np.diag(numbers.innovation_covariance)) * numbers.problem.scales.output]
    )
    values = numbers.point + sizes * np.random.default_rng(0).standard_normal((n, sizes.size))
    samples = Samples(
        u=np.ascontiguousarray(values[:, :n_u]),
        y=np.ascontiguousarray(values[:, n_u:]),
        forcing=np.zeros((n, 2)) if numbers.synchronous else None,
    )
    supervisor.feed(samples, 0)
    recent = RecentSamples(n)
    recent.add(samples, n)
    nothing = Event(kind="disturbed", t=0.0, why="")
    name = numbers.names[int(numbers.places("parameter")[0])]
    history = [(rpem.stream.latest, before)] if rpem.stream.latest is not None else []
    if history:
        begin(rpem, history, nothing, onset=0, suspects=(name,), size=0.1).attempt(rpem, recent)
