"""Compiled reading of plain decimal numbers: for long files, of which it takes a sixth of the time. Mantissa times
power of ten as sums of two doubles (Dekker 1971), 98 bits: the nearest double, unless the text lies that near a middle.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from ambid.arrays import Array
from ambid.compiled import compiled

_POWERS = 80  # of ten, up and down
_DIGITS = 18  # that a 64-bit integer holds
_EXACT, _EXACT_POWER = 1 << 53, 22  # whole number, and power of ten, below which a double holds them
_MINUS, _PLUS, _POINT, _ZERO, _NINE, _SMALL_E, _LARGE_E, _END = 45, 43, 46, 48, 57, 101, 69, 10


def powers_of_ten() -> Array:
    """Return 10^-80 to 10^80 as sums of two doubles, (161, 2)."""
    exact = [Fraction(10) ** k for k in range(-_POWERS, _POWERS + 1)]
    return np.array([(float(x), float(x - Fraction(float(x)))) for x in exact])


@compiled
def read_rows(text: NDArray[np.uint8], at: int, delimiter: int, powers: Array, values: Array) -> int:
    """Read rows of numbers from byte `at` of a text that ends with a line feed into `values` (n_rows, n_columns);
    return the bytes read, -1 where a cell is no plain decimal number or a row has more or fewer cells.
    """
    n_rows, n_columns = values.shape
    for row in range(n_rows):
        for column in range(n_columns):
            negative = text[at] == _MINUS
            if negative or text[at] == _PLUS:
                at += 1
            mantissa, digits, first, scale, point = 0, 0, at, 0, 0
            while True:
                byte = text[at]
                if _ZERO <= byte <= _NINE:
                    digits += digits > 0 or byte > _ZERO
                    if digits > _DIGITS:  # before the mantissa grows beyond 63 bits
                        return -1
                    mantissa = 10 * mantissa + int(byte) - _ZERO
                    scale -= point
                elif byte == _POINT and point == 0:
                    point = 1
                else:
                    break
                at += 1
            if at - first - point < 1:
                return -1
            if byte in (_SMALL_E, _LARGE_E):
                at += 1
                down = text[at] == _MINUS
                if down or text[at] == _PLUS:
                    at += 1
                exponent, first = 0, at
                while _ZERO <= text[at] <= _NINE and exponent < 1000:
                    exponent = 10 * exponent + int(text[at]) - _ZERO
                    at += 1
                if at == first:
                    return -1
                scale += -exponent if down else exponent
            if text[at] != (_END if column == n_columns - 1 else delimiter):
                return -1
            at += 1
            if mantissa == 0:
                value = 0.0
            elif not -_POWERS <= scale <= _POWERS:
                return -1
            elif mantissa < _EXACT and 0 <= scale <= _EXACT_POWER:
                value = float(mantissa) * powers[_POWERS + scale, 0]
            elif mantissa < _EXACT and -_EXACT_POWER <= scale < 0:
                value = float(mantissa) / powers[_POWERS - scale, 0]
            else:
                high = float(mantissa)
                low = float(mantissa - int(high))
                ten, rest = powers[scale + _POWERS, 0], powers[scale + _POWERS, 1]
                product = high * ten
                a, b = 134217729.0 * high, 134217729.0 * ten
                a, b = a - (a - high), b - (b - ten)
                c, d = high - a, ten - b
                error = ((a * b - product) + a * d + c * b) + c * d + (high * rest + low * ten)
                doubt = product * 2.0**-98
                value = product + (error - doubt)
                if value != product + (error + doubt):
                    return -1
            values[row, column] = -value if negative else value
    return at
