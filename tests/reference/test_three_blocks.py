"""Table 5.1 of the thesis from its own eq. 5.4-5.6, corrected (theory.md sec. 6)."""

import numpy as np
import pytest

from ambid.blackbox.blocks import block_parameters

PRINTED = np.array([653.5, 1204.0, 0.003496, 1.752, 1.049, 0.07209])  # K_a, a, K_b, b, K_c, c


def test_table_5_1():
    R, L, C, K, k_i, k_x = block_parameters(PRINTED)[0]
    assert pytest.approx(1.842, abs=5e-4) == R
    assert pytest.approx(1.530e-3, abs=5e-7) == L  # printed as 1.5302 H: millihenry are meant
    assert pytest.approx(1.824, abs=5e-4) == C
    assert pytest.approx(0.1226, abs=5e-5) == K
    assert k_i == pytest.approx(-1.913, abs=1e-3)  # agrees with the print
    assert k_x == pytest.approx(0.00886, abs=5e-6)  # printed as 0.933


def test_the_two_ways_to_read_the_blocks_agree():
    # s^2 + C s + K is the denominator of TF_eq, and -k_i/(C s + k_x + K) is TFc
    _, _, kb, b, kc, c = PRINTED
    _, _, C, K, k_i, k_x = block_parameters(PRINTED)[0]
    np.testing.assert_allclose(np.polysub(np.polymul([1, b], [1, c]), [kb * kc]), [1, C, K], rtol=1e-14)
    assert -k_i / C == pytest.approx(kc, rel=1e-14)
    assert (k_x + K) / C == pytest.approx(c, rel=1e-14)
