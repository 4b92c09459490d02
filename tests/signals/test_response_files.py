"""Frequency responses from files: values, units, channels and standard deviations; what is open is asked back."""

import itertools

import numpy as np
import pytest

from ambid.errors import AmbidError
from ambid.signals.response_files import is_response_file, read_response
from tests.signals.response_files import F, noisy, plant, uff, units_164

G = plant()
UNITS = ("mm", "A")


@pytest.mark.parametrize(("double", "even"), [*itertools.product((True, False), (True, False))])
def test_uff_gives_responses_in_si_with_coherence(tmp_path, double, even):
    f = F if even else F + 0.1 * np.sin(F)
    functions = [(4, 1, 7, f, 1e3 * G[:, 0], UNITS), (6, 1, 7, f, np.full(f.size, 0.9), ("", "")),
                 (4, 2, 7, f, G[:, 1], ("", "A")), (2, 2, 2, f, np.abs(G[:, 1]), ("", ""))]  # fmt: skip
    path = tmp_path / "a.unv"
    path.write_bytes(uff(functions, double=double, even=even))
    found, about = read_response(path, layout={"averages": "20"})
    assert (found.inputs, found.outputs, found.hold) == (("7Z",), ("1Z", "2Z"), "band-limited")
    assert found.units == {"7Z": "A", "1Z": "m", "2Z": "?"}
    assert about["history"][-1] == "1 other functions left out"
    np.testing.assert_allclose(found.frequency_hz, f, rtol=1e-6)
    np.testing.assert_allclose(found.G[:, :, 0], G, rtol=1e-6)
    np.testing.assert_allclose(found.sd[:, 0, 0], np.abs(G[:, 0]) * np.sqrt(0.1 / 0.9 / 20), rtol=1e-6)
    assert "of 7Z → 2Z are assumed, from the scatter" in found.details["assumed"]


@pytest.mark.parametrize(("columns", "made"), [
    ("x/i real [um/A],x/i imag [um/A],x/i sd [%]", lambda g: (g.real * 1e6, g.imag * 1e6, np.full(F.size, 2.0))),
    ("x/i magnitude [mm/A],x/i phase [deg],x/i sd [mm/A]",
     lambda g: (abs(g) * 1e3, np.angle(g, deg=True), 20 * abs(g))),
    ("x/i mag [dB],x/i phase [rad],x/i sd [%]", lambda g: (20 * np.log10(abs(g)), np.angle(g), np.full(F.size, 2.0))),
    ("(re) [m/A],(im) [m/A],(sd) [m/A]", lambda g: (g.real, g.imag, 0.02 * abs(g))),
])  # fmt: skip
@pytest.mark.parametrize("dialect", [(",", "."), (";", ",")])
def test_csv_of_complex_values(tmp_path, columns, made, dialect):
    separator, decimal = dialect
    rows = ["frequency [Hz]," + columns] + [
        ",".join(f"{x:.12g}" for x in row) for row in zip(F, *made(G[:, 0]), strict=True)
    ]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(rows).replace(",", separator).replace(".", decimal) + "\n")
    assert is_response_file(path)
    layout = {"magnitude": "m/A"} if "dB" in columns else {}
    names = {} if "x/i" in columns else {"inputs": ("i",), "outputs": ("x",)}
    found, _ = read_response(path, layout=layout, **names)
    assert (found.inputs, found.outputs, dict(found.units)) == (("i",), ("x",), {"i": "A", "x": "m"})
    np.testing.assert_allclose(found.G[:, 0, 0], G[:, 0], rtol=1e-9)
    np.testing.assert_allclose(found.sd[:, 0, 0], 0.02 * np.abs(G[:, 0]), rtol=1e-9)
    if layout:
        with pytest.raises(AmbidError, match=r"in dB of what.*layout={'magnitude': 'm/A'}"):
            read_response(path)


def test_responses_to_a_reference_are_divided(tmp_path):
    """Plant = response of the output over that of the input, both to the excitation of the loop."""
    loop = 1 / (1 + 0.3j * F / 100)
    path = tmp_path / "a.uff"
    path.write_bytes(uff([(4, 1, 9, F, noisy(G[:, 0] * loop, 1e-3), ("m", "V")), (4, 2, 9, F, loop, ("V", "V"))]))
    found, _ = read_response(path, inputs=("2Z",), outputs=("1Z",), references=("9Z",))
    assert (found.inputs, found.outputs, found.units["2Z"]) == (("2Z",), ("1Z",), "V")
    assert "joint" in found.method
    assert "feedback correlates them" in found.details["assumed"]
    assert np.all(np.abs(found.G[:, 0, 0] - G[:, 0]) < 5 * found.sd[:, 0, 0])


def test_scatter_of_neighbours_is_the_noise():
    from ambid.signals.response_files import _scatter

    ratio = [np.mean(_scatter(noisy(G[:, 0], 0.1, seed)) / (0.1 * np.abs(G[:, 0])) ** 2) for seed in range(20)]
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.05)


GOOD = uff([(4, 1, 7, F, G[:, 0], UNITS)])
HEAD = b"frequency [Hz],x/i real [m/A],x/i imag [m/A]\n"
ROWS = b"".join(b"%g,1,2\n" % f for f in F)
REFUSED = {
    "cut.uff": (GOOD[:2000], "cut off"),
    "binary.uff": (GOOD.replace(b"    58 ", b"    58b", 1), "binary .58b., which is not read. Export it as ASCII"),
    "head.uff": (GOOD[:300] + b"\n    -1\n", "head"),
    "text.uff": (b"hello\n" * 30, "no universal file"),
    "word.uff": (GOOD[:-200] + b"open" + GOOD[-196:], "'open' among its values"),
    "less.uff": (GOOD.replace(b"       199", b"       250"), "of 500 numbers"),
    "more.uff": (GOOD.replace(b"       199", b"999999999"[:9].rjust(10)), "of 1999999998 numbers"),
    "real.uff": (uff([(4, 1, 7, F, np.abs(G[:, 0]), UNITS)]), "real; a frequency response has a phase"),
    "none.uff": (uff([(2, 1, 7, F, np.abs(G[:, 0]), UNITS)]), "holds no frequency response"),
    "twice.uff": (GOOD + GOOD, r"7Z → 1Z occurs twice \(functions 1,2\).*layout={'functions': '1"),
    "other.uff": (GOOD + uff([(4, 2, 7, F + 1, G[:, 0], UNITS)]), "other frequencies than the first"),
    "kinds.uff": (GOOD + uff([(4, 2, 7, F, G[:, 0], ("mm", "V"))]), r"7Z is in \[A\] in one function and in \[V\]"),
    "inches.uff": (units_164(7) + GOOD, "dataset 164 says units of system 7.*layout={'units': 'labels'}"),
    "few.uff": (uff([(4, 1, 7, F[:5], G[:5, 0], UNITS)]), "5 lines over 0 Hz; at least 9"),
    "nan.csv": (HEAD + ROWS.replace(b"10,1,2", b"10,nan,2"), "line 5 is not finite"),
    "word.csv": (HEAD + ROWS.replace(b"10,1,2", b"10,open,2"), "row 6: '10,open,2'"),
    "cells.csv": (HEAD + ROWS.replace(b"\n10,1,2", b"\n10,1"), "row 6: 2 cells, 3 columns"),
    "falling.csv": (HEAD + ROWS.replace(b"\n10,1,2", b"\n6,1,2"), "must rise"),
    "alone.csv": (HEAD.replace(b" imag ", b" coherence ") + ROWS, "needs real and imag"),
    "name.csv": (HEAD.replace(b" imag ", b" ") + ROWS, "must end in real, imag"),
    "units.csv": (HEAD.replace(b"imag [m/A]", b"imag [mm/A]") + ROWS, r"real is in \[m/A\], imag in \[mm/A\]"),
    "unit.csv": (HEAD.replace(b"[Hz]", b"") + ROWS, "write its unit"),
    "empty.csv": (HEAD, "no lines"),
    "coherence.csv": (b"frequency [Hz],x/i real [m/A],x/i imag [m/A],x/i coherence [1]\n"
                      + ROWS.replace(b"2\n", b"2,1.2\n"), "not between 0 and 1"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_damaged_and_doubtful_files_are_refused_in_a_line(tmp_path, name):
    data, said = REFUSED[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(AmbidError, match=rf"{name}.*{said}") as failure:
        read_response(tmp_path / name)
    assert "\n" not in str(failure.value)
