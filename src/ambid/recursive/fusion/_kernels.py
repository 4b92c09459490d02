"""Compiled fusion of position sensors: a U-D Kalman filter with tests of every sensor against the others.

The state is [motion, temperature (if modelled), one offset of each sensor]; its covariance U D Uᵀ and mean stand in
`memory` (n, n + 1): U above the diagonal, D on it, the mean in the last column. Offsets come last, so that moving the
motion one sample on leaves their part of U and D alone (Bierman 1977, ch. 5-7).
"""

from __future__ import annotations

from math import inf, isfinite, nan, sqrt

from ambid.arrays import Array
from ambid.compiled import compiled
from ambid.recursive.fusion import _watch_kernels as watching
from ambid.recursive.fusion._watch_kernels import GATED_OUT, LOOKED_AT, NEW, NOW, OLD, OUT

FIRST = 0.0  # a float: a whole number written out makes Numba compile a function once more for it


@compiled(fastmath={"contract"})
def row(memory: Array, H: Array, i: int, f: Array, at: int) -> float:
    """Fill row `at` of f with Uᵀ h, h being row i of H, and return h · mean."""
    N = memory.shape[0]
    mean = 0.0
    for j in range(N):
        total = H[i, j]
        mean += total * memory[j, N]
        for a in range(j):
            total += memory[a, j] * H[i, a]
        f[at, j] = total
    return mean


@compiled(fastmath={"contract"})
def size(memory: Array, f: Array, at: int) -> float:
    """Variance of what a row of `f` belongs to."""
    total = 0.0
    for j in range(memory.shape[0]):
        total += f[at, j] * f[at, j] * memory[j, j]
    return total


@compiled(fastmath={"contract"})
def absorb(memory: Array, f: Array, b: Array, e: float, r: float) -> None:
    """Take in one innovation e of noise variance r; row 0 of f is Uᵀ h (Bierman 1977, sec. 5.3)."""
    N = memory.shape[0]
    alpha, part = r, 1.0 / r
    for j in range(N):
        v = memory[j, j] * f[0, j]
        beta = alpha
        alpha += f[0, j] * v
        along = -f[0, j] * part
        part = 1.0 / alpha
        memory[j, j] *= beta * part
        b[j] = v
        for i in range(j):
            old = memory[i, j]
            memory[i, j] = old + b[i] * along
            b[i] += old * v
    e *= part
    for i in range(N):
        memory[i, N] += b[i] * e


@compiled(fastmath={"contract"})
def spread(memory: Array, q: float, state: int, a: Array) -> None:
    """Add the variance q to one state (Agee and Turner; Bierman 1977, sec. 3.3)."""
    if q <= 0.0:
        return
    for i in range(state):
        a[i] = 0.0
    a[state] = 1.0
    for j in range(state, -1, -1):
        s, d = a[j], memory[j, j]
        new = d + q * s * s
        beta = q * s / new
        q *= d / new
        memory[j, j] = new
        for i in range(j):
            a[i] -= s * memory[i, j]
            memory[i, j] += beta * a[i]


@compiled(fastmath={"contract"})
def advance(
    memory: Array, motion: Array, walk: Array, stride: int, now: int, u: Array, k: int, column: int, M: Array, b: Array
) -> None:
    """Move mean and covariance one sample on: modified weighted Gram-Schmidt of [A U, G] for the motion alone.

    `walk` (n_states - n,) is what temperature and offsets walk in `stride` samples, and they do so in such steps.
    """
    N, n = memory.shape[0], motion.shape[0]
    n_u = motion.shape[1] - 2 * n
    for j in range(n, N + 1):  # A times the mean and times every column of U beside the motion's own
        for i in range(n):
            total = 0.0
            for a in range(n):
                total += motion[i, a] * memory[a, j]
            b[i] = total
        for i in range(n):
            memory[i, j] = b[i]
    for i in range(n):
        for a in range(n_u):
            memory[i, N] += motion[i, n + a] * u[k, column + a]
        for j in range(n):
            total = motion[i, j]
            for a in range(j):
                total += motion[i, a] * memory[a, j]
            M[i, j] = total
            M[i, n + j] = motion[i, n + n_u + j]
    for j in range(n):
        b[j], b[n + j] = memory[j, j], 1.0
    for j in range(n - 1, -1, -1):
        square = 0.0
        for a in range(2 * n):
            square += M[j, a] * M[j, a] * b[a]
        memory[j, j] = square
        for i in range(j):
            along = 0.0
            for a in range(2 * n):
                along += M[i, a] * b[a] * M[j, a]
            along /= square
            memory[i, j] = along
            for a in range(2 * n):
                M[i, a] -= along * M[j, a]
    if now % stride == 0:
        for i in range(N - n):
            spread(memory, walk[i], n + i, b)


@compiled
def keep(kept: Array, memory: Array, also: bool) -> None:
    """Keep the filter as it is; what was kept becomes the older one, unless `also` that is to be the present one."""
    for i in range(memory.shape[0]):
        for j in range(memory.shape[1]):
            kept[0, i, j] = memory[i, j] if also else kept[1, i, j]
            kept[1, i, j] = memory[i, j]


@compiled
def _without(
    i: int, memory: Array, motion: Array, H: Array, walk: Array, stride: int, watch: Array, clock: Array, ring: Array,
    kept: Array, f: Array, M: Array, b: Array,
) -> None:  # fmt: skip
    """Run the filter again without sensor i over the samples since its fault, as far as they are kept."""
    first = int(FIRST)
    m, which = watch.shape[0], 1 if clock[NEW] <= watch[i, watching.ONSET] else 0
    for a in range(memory.shape[0]):
        for j in range(memory.shape[1]):
            memory[a, j] = kept[which, a, j]
    for k in range(int(clock[NEW if which == 1 else OLD]), int(clock[NOW])):
        at = k % ring.shape[0]
        for j in range(m):
            if watch[j, OUT] == 0.0 and isfinite(ring[at, j]):
                absorb(memory, f, b, ring[at, j] - row(memory, H, j, f, first), ring[at, m + j])
        advance(memory, motion, walk, stride, k, ring, at, 2 * m, M, b)
    clock[watching.FRESH] = 1.0


@compiled(fastmath={"contract"})
def _residuals(memory: Array, H: Array, z: Array, r: Array, used: Array, e: Array, f: Array, S: Array) -> None:
    """Fill the innovations e and their covariance S; row i of `f` becomes Uᵀ h of sensor i."""
    for i in range(e.shape[0]):
        if used[i] > 0.0:
            e[i] = z[i] - row(memory, H, i, f, i)
            for j in range(i + 1):
                if used[j] > 0.0:
                    total = r[i] if i == j else 0.0
                    for a in range(memory.shape[0]):
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
    for j in range(memory.shape[0]):
        H[m + 1, j] = 0.0
    for i in range(m):
        weight = f[m, i] / total if used[i] > 0.0 else 0.0
        noise += weight * weight * r[i]
        for j in range(n, memory.shape[0]):
            H[m + 1, j] += weight * H[i, j]
        f[m, i] = weight
    return noise


@compiled(fastmath={"contract"})
def fuse_scan(
    start: int, y: Array, u: Array, out: Array, motion: Array, H: Array, walk: Array, sensors: Array, settings: Array,
    memory: Array, watch: Array, clock: Array, ring: Array, kept: Array, work: Array, notes: Array,
) -> int:  # fmt: skip
    """Run over a block from sample `start`, and stop after a sample of which there is something to tell.

    `motion` (n, 2 n + n_u): [A B G] with Q = G Gᵀ. `H` (m + 2, n_states): how each sensor sees the state, position,
    scratch. `out` (n_samples, 2): position and its standard deviation. `ring` (2 span, 2 m + n_u): displacements that
    were used (else NaN), their noise, and inputs. `kept`: the filter as it was before the two last whole spans.
    Returns how many samples of the block are done.
    """
    first = int(FIRST)
    m, n, stride = sensors.shape[0], motion.shape[0], int(settings[watching.STRIDE])
    z, r, used, e, t, per, b = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    z, r, used, e, t, per = z[:m], r[:m], used[:m], e[:m], t[:m], per[:m]
    f, S, W, M = work[7 : 9 + m], work[9 + m : 9 + 2 * m], work[9 + 2 * m : 9 + 3 * m], work[9 + 3 * m :]
    clock[watching.NOTES] = 0.0
    for k in range(start, y.shape[0]):
        now = clock[NOW]
        fresh = clock[watching.FRESH] > 0.0
        if fresh or int(now) % int(settings[watching.SPAN]) == 0:
            keep(kept, memory, fresh)
            clock[OLD] = now if fresh else clock[NEW]
            clock[NEW], clock[watching.FRESH] = now, 0.0
        watching.read(y, k, sensors, watch, z, r, used)
        working = watching.self_test(sensors, settings, watch, clock, notes, used)
        _residuals(memory, H, z, r, used, e, f, S)
        x = row(memory, H, m, f, m)
        apart = working > 2
        tested = watching.gate(e, used, S, W, t, per, watch, clock, apart)
        for i in range(m):
            if used[i] > 0.0 or used[i] == GATED_OUT:
                watching.sums(watch, i, t[i], per[i], x, settings[watching.LOSS_PART], now)
        fault = watching.judge(settings, watch, clock, notes, tested, apart, x)
        if fault == watching.OPENED:
            for i in range(m):
                watch[i, watching.ZERO] = 0.0
                for a in range(n, memory.shape[0]):
                    watch[i, watching.ZERO] += H[i, a] * kept[0, a, memory.shape[0]]
        for i in range(m):
            if watch[i, OUT] > 0.0 and watch[i, watching.SINCE] == now:
                used[i] = min(used[i], 0.0)
                _without(i, memory, motion, H, walk, stride, watch, clock, ring, kept, f, M, b)
        instant = settings[watching.INSTANT] > 0.0
        noise, at, quietest, seen = 0.0, int(now) % ring.shape[0], inf, 0
        for i in range(m):
            seen += used[i] > 0.0
        if instant and seen > 0:
            noise = _instant(memory, H, z, r, used, S, W, e, f, n)
            x = -row(memory, H, m + 1, f, m + 1)
            noise += size(memory, f, m + 1)
            for i in range(m):
                x += f[m, i] * z[i] if used[i] > 0.0 else 0.0
        for i in range(m):
            ring[at, i], ring[at, m + i] = z[i] if used[i] > 0.0 else nan, r[i]
            if used[i] > 0.0:
                absorb(memory, f, b, z[i] - row(memory, H, i, f, first), r[i])
                quietest = min(quietest, r[i])
        filtered = row(memory, H, m, f, m)
        variance = size(memory, f, m)
        for i in range(m):
            if used[i] == LOOKED_AT:
                residual = z[i] - row(memory, H, i, f, first)
                s = size(memory, f, first) + r[i]
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
        advance(memory, motion, walk, stride, int(now), u, k, first, M, b)
        clock[NOW] = now + 1.0
        if clock[watching.NOTES] > 0.0:
            return k + 1
    return int(y.shape[0])


@compiled
def put_back(i: int, memory: Array, watch: Array, clock: Array, variance: float, b: Array, notes: Array) -> None:
    """Put sensor i to work again, its offset opened by `variance`."""
    spread(memory, variance, memory.shape[0] - watch.shape[0] + i, b)
    watching.back(i, watch, clock, notes)
