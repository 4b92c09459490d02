"""Compiled recursion of the three blocks on-line: regressors, errors and instruments of one block of samples."""

from __future__ import annotations

from ambid.arrays import Array
from ambid.compiled import compiled


@compiled(fastmath={"contract"})
def block_rows(signals: Array, rows: Array, errors: Array, s: Array, c: Array, fresh: bool) -> None:
    """Filter voltage, current, position and drive into rows of the two regressions.

    `signals` (n, 4) is prefiltered, means off, scaled. `rows` (n, 21): regressors and target of the current (5 + 1) and
    of the position (3 + 1), their instruments (5, 3), three instruments to spare. `errors` (n, 2): target less what the
    coefficients at which the rows were linearised make of the regressors. `s` (21,) is the state, `c` (27,) the
    constants of `ambid.recursive.blocks.Linearisation.constants`; `fresh`: the first sample begins at rest.
    """
    alpha_a, hold_a, new_a, old_a = c[0], c[1], c[2], c[3]
    alpha_b, new_b, old_b = c[4], c[5], c[6]
    alpha_f, new_f, old_f = c[7], c[8], c[9]
    alpha_c, new_c, old_c = c[10], c[11], c[12]
    ka, a, kb, b, off_i, kc, pole_c, off_x = c[13], c[14], c[15], c[16], c[17], c[18], c[19], c[20]
    size_a, size_b, f, back, loop, least = c[21], c[22], c[23], c[24], c[25], c[26] > 0.0
    for k in range(signals.shape[0]):
        v, i, x, d = signals[k, 0], signals[k, 1], signals[k, 2], signals[k, 3]
        if fresh and k == 0:
            s[:] = 0.0
            s[0], s[1] = v / a, v / (a * a)
            s[2], s[3] = x / b, x / (b * b)
            s[4], s[5] = i / f, x / f
            s[6], s[7], s[8], s[9] = v, i, x, d
            s[10], s[11] = d / a, d / (a * a)
            s[19], s[20] = d, d
        # measured signals: V/(s+a) and again, x/(s+b) and again, i/(s+f), x/(s+f)
        va = alpha_a * s[0] + hold_a * s[6]
        vaa = alpha_a * s[1] + new_a * va + old_a * s[0]
        xb = alpha_b * s[2] + new_b * x + old_b * s[8]
        xbb = alpha_b * s[3] + new_b * xb + old_b * s[2]
        wi = alpha_f * s[4] + new_f * i + old_f * s[7]
        wx = alpha_f * s[5] + new_f * x + old_f * s[8]
        s[0], s[1], s[2], s[3], s[4], s[5] = va, vaa, xb, xbb, wi, wx
        # what the drive alone makes of current and position through the blocks in their loop
        da = alpha_a * s[10] + hold_a * s[9]
        daa = alpha_a * s[11] + new_a * da + old_a * s[10]
        free = alpha_b * s[12] + back * old_b * s[13]
        y = (alpha_c * s[13] + kc * (new_c * (ka * da + free) + old_c * s[14])) * loop
        ib = free + back * new_b * y
        j = ka * da + ib
        yb = alpha_b * s[15] + new_b * y + old_b * s[13]
        ybb = alpha_b * s[16] + new_b * yb + old_b * s[15]
        yi = alpha_f * s[17] + new_f * j + old_f * s[14]
        yx = alpha_f * s[18] + new_f * y + old_f * s[13]
        r = rows[k]
        r[0], r[1], r[2], r[3], r[4] = size_a * va, -size_a * ka * vaa, size_b * xb, -size_b * kb * xbb, 1.0
        r[5] = i - a * ka * vaa - b * kb * xbb
        r[6], r[7], r[8] = f * wi, -f * wx, 1.0
        r[9] = x - f * wx
        if least:
            for q in range(5):
                r[10 + q] = r[q]
            for q in range(3):
                r[15 + q] = r[6 + q]
        else:
            r[10], r[11], r[12], r[13], r[14] = size_a * da, -size_a * ka * daa, size_b * yb, -size_b * kb * ybb, 1.0
            r[15], r[16], r[17] = f * yi, -f * yx, 1.0
        r[18], r[19], r[20] = s[9], s[20], s[13]
        s[20], s[19] = s[19], s[9]
        s[6], s[7], s[8], s[9] = v, i, x, d
        s[10], s[11], s[12], s[13], s[14] = da, daa, ib, y, j
        s[15], s[16], s[17], s[18] = yb, ybb, yi, yx
        errors[k, 0] = i - ka * va - kb * xb - off_i
        errors[k, 1] = r[9] - kc * wi + pole_c * wx - off_x
