"""Compiled fusion of position sensors: a Kalman filter with tests of every sensor against the others.

The state is [motion, temperature (if modelled), one offset of each sensor]; `memory` (n + 1, n) holds the factors of
its covariance and, in the last row, its mean. Offsets come last, so that moving the motion one sample on leaves their
part of the factors alone.
"""

from __future__ import annotations

from math import inf, isfinite, nan, sqrt

import numpy as np

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive import fusion_watch_kernels as watching
from ambid.recursive.fusion_watch_kernels import GATED_OUT, LOOKED_AT, NEW, NOW, OLD, OUT
from ambid.recursive.square_root_kernels import project, propagate, shrink, size, widen


@compiled(fastmath={"contract"})
def _row(memory: Array, H: Array, i: int, f: Array) -> float:
    """Fill f with Uᵀ h, h being row i of H, and return h · mean."""
    n, mean = memory.shape[1], 0.0
    for j in range(n):
        mean += H[i, j] * memory[n, j]
    project(memory, H[i], f)
    return mean


@compiled(fastmath={"contract"})
def _absorb(memory: Array, f: Array, b: Array, e: float, r: float) -> None:
    """Take in one innovation e of noise variance r that sees f = Uᵀ h."""
    n = memory.shape[1]
    gain = e / shrink(memory, f, r, b)
    for j in range(n):
        memory[n, j] += gain * b[j]


@compiled(fastmath={"contract"})
def _advance(
    memory: Array, A: Array, B: Array, G: Array, walk: Array, stride: int, now: int, u: Array, k: int, column: int,
    W: Array, w: Array,
) -> None:  # fmt: skip
    """Move mean and covariance one sample on.

    `walk` (n_states - n,) is what temperature and offsets walk in `stride` samples, and they do so in such steps.
    """
    last, n = memory.shape[1], A.shape[0]
    for i in range(n):
        x = 0.0
        for a in range(n):
            x += A[i, a] * memory[last, a]
        for a in range(B.shape[1]):
            x += B[i, a] * u[k, column + a]
        w[i] = x
    memory[last, :n] = w[:n]
    propagate(memory[:last], A, np.empty((n, 0)), G, W, w)
    if now % stride == 0:
        for i in range(last - n):
            if walk[i] > 0.0:
                w[: n + i] = 0.0
                w[n + i] = 1.0
                widen(memory, w[: n + i + 1], walk[i])


@compiled
def _without(
    i: int, memory: Array, A: Array, B: Array, G: Array, H: Array, walk: Array, stride: int, watch: Array,
    clock: Array, ring: Array, kept: Array, f: Array, W: Array, w: Array,
) -> None:  # fmt: skip
    """Run the filter again without sensor i over the samples since its fault, as far as they are kept."""
    m, which = watch.shape[0], 1 if clock[NEW] <= watch[i, watching.ONSET] else 0
    memory[:] = kept[which]
    for k in range(int(clock[NEW if which == 1 else OLD]), int(clock[NOW])):
        at = k % ring.shape[0]
        for j in range(m):
            if watch[j, OUT] == 0.0 and isfinite(ring[at, j]):
                e = ring[at, j] - _row(memory, H, j, f[0])
                _absorb(memory, f[0], w, e, ring[at, m + j])
        _advance(memory, A, B, G, walk, stride, k, ring, at, 2 * m, W, w)
    clock[watching.FRESH] = 1.0


@compiled(fastmath={"contract"})
def _residuals(memory: Array, H: Array, z: Array, r: Array, used: Array, e: Array, f: Array, S: Array) -> None:
    """Fill the innovations e and their covariance S; row i of `f` becomes Uᵀ h of sensor i."""
    for i in range(e.shape[0]):
        if used[i] > 0.0:
            e[i] = z[i] - _row(memory, H, i, f[i])
            for j in range(i + 1):
                if used[j] > 0.0:
                    total = r[i] if i == j else 0.0
                    for a in range(memory.shape[1]):
                        total += f[i, a] * memory[a, a] * f[j, a]
                    S[i, j] = S[j, i] = total


@compiled(fastmath={"contract"})
def _instant(
    memory: Array, H: Array, z: Array, r: Array, used: Array, S: Array, W: Array, e: Array, f: Array, n: int
) -> float:
    """Make row m + 1 of H the mean of this instant's values, weighted by S⁻¹ 1; return the variance of their noise.

    Position = Σ w (z - offset as predicted): the motion has no part in it but for the weights.
    """
    m, total, noise = z.shape[0], 0.0, 0.0
    _, _ = watching.compare(e, used, S, W, f[m], f[m + 1], n < 0)
    for i in range(m):
        f[m, i] = 0.0
        for j in range(m):
            if used[i] > 0.0 and used[j] > 0.0:
                f[m, i] -= W[i, j]
        total += f[m, i]
    for j in range(memory.shape[1]):
        H[m + 1, j] = 0.0
    for i in range(m):
        weight = f[m, i] / total if used[i] > 0.0 else 0.0
        noise += weight * weight * r[i]
        for j in range(n, memory.shape[1]):
            H[m + 1, j] += weight * H[i, j]
        f[m, i] = weight
    return noise


@compiled(fastmath={"contract"})
def fuse_scan(
    start: int, y: Array, u: Array, out: Array, motion: Array, H: Array, walk: Array, sensors: Array, settings: Array,
    memory: Array, watch: Array, clock: Array, ring: Array, kept: Array, notes: Array,
) -> int:  # fmt: skip
    """Run over a block from sample `start`, and stop after a sample of which there is something to tell.

    `motion`: A, B and G with Q = G Gᵀ, one behind the other. `H` (m + 2, n_states): how each sensor sees the state,
    position, scratch. `out` (n_samples, 2): position and its standard deviation. `ring` (2 span, 2 m + n_u):
    displacements that were used (else NaN), their noise, and inputs. `kept`: the filter as it was before the two last
    whole spans.
    Returns how many samples of the block are done.
    """
    m, n, stride = sensors.shape[0], int(settings[watching.STATES]), int(settings[watching.STRIDE])
    at, to = n * n, n * (n + u.shape[1])
    A, B, G = motion[:at].reshape(n, n), motion[at:to].reshape(n, u.shape[1]), motion[to:].reshape(n, n)
    z, r, used, e, t, per = np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    f, S, W = np.empty((m + 2, memory.shape[1])), np.empty((m, m)), np.empty((m, m))
    M, b, first = np.empty((n, 2 * n)), np.empty(max(2 * n, memory.shape[1])), start - start
    clock[watching.NOTES] = 0.0
    for k in range(start, y.shape[0]):
        now = clock[NOW]
        fresh = clock[watching.FRESH] > 0.0
        if fresh or int(now) % int(settings[watching.SPAN]) == 0:
            kept[0] = memory if fresh else kept[1]
            kept[1] = memory
            clock[OLD] = now if fresh else clock[NEW]
            clock[NEW], clock[watching.FRESH] = now, 0.0
        watching.read(y, k, sensors, watch, z, r, used)
        working = watching.self_test(sensors, settings, watch, clock, notes, used)
        _residuals(memory, H, z, r, used, e, f, S)
        x = _row(memory, H, m, f[m])
        apart = working > 2
        tested = watching.gate(e, used, S, W, t, per, watch, clock, apart)
        for i in range(m):
            if used[i] > 0.0 or used[i] == GATED_OUT:
                watching.sums(watch, i, t[i], per[i], x, settings[watching.LOSS_PART], now)
        fault = watching.judge(settings, watch, clock, notes, tested, apart, x)
        if fault == watching.OPENED:
            for i in range(m):
                watch[i, watching.ZERO] = 0.0
                for a in range(n, memory.shape[1]):
                    watch[i, watching.ZERO] += H[i, a] * kept[0, memory.shape[1], a]
        for i in range(m):
            if watch[i, OUT] > 0.0 and watch[i, watching.SINCE] == now:
                used[i] = min(used[i], 0.0)
                _without(i, memory, A, B, G, H, walk, stride, watch, clock, ring, kept, f, M, b)
        instant = settings[watching.INSTANT] > 0.0
        noise, at, quietest, seen = 0.0, int(now) % ring.shape[0], inf, 0
        for i in range(m):
            seen += used[i] > 0.0
        if instant and seen > 0:
            noise = _instant(memory, H, z, r, used, S, W, e, f, n)
            x = -_row(memory, H, m + 1, f[m + 1])
            noise += size(memory, f[m + 1])
            for i in range(m):
                x += f[m, i] * z[i] if used[i] > 0.0 else 0.0
        for i in range(m):
            ring[at, i], ring[at, m + i] = z[i] if used[i] > 0.0 else nan, r[i]
            if used[i] > 0.0:
                _absorb(memory, f[0], b, z[i] - _row(memory, H, i, f[0]), r[i])
                quietest = min(quietest, r[i])
        filtered = _row(memory, H, m, f[m])
        variance = size(memory, f[m])
        for i in range(m):
            if used[i] == LOOKED_AT:
                residual = z[i] - _row(memory, H, i, f[0])
                s = size(memory, f[0]) + r[i]
                if watching.agree(watch, i, residual, s, r[i], filtered, quietest, working):
                    watching.back(i, watch, clock, notes)
        if clock[watching.DISPUTED] > 0.0:
            extra = watching.doubt(z, r, filtered, settings, watch, clock, notes)
            variance += extra
            noise += extra
        if instant:
            out[k, 0], out[k, 1] = (x, sqrt(noise)) if seen > 0 else (nan, inf)
        else:
            out[k, 0], out[k, 1] = filtered, sqrt(variance)
        for a in range(u.shape[1]):
            ring[at, 2 * m + a] = u[k, a]
        _advance(memory, A, B, G, walk, stride, int(now), u, k, first, M, b)
        clock[NOW] = now + 1.0
        if clock[watching.NOTES] > 0.0:
            return k + 1
    return int(y.shape[0])
