"""A law for other programs: MATLAB, python-control, and as C source.

    w = C z + D y,  z+ = A z + B y + G (given - w),

in SI with the sign included; given is what the output took of w: w itself unless a limit or a rounding came between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ambid.arrays import Array
from ambid.errors import EstimationError
from ambid.physics.law import StateLaw

ENDINGS = (".mat", ".py", ".c")
MAT_HEADER = b"MATLAB 5.0 MAT-file, written by ambid"
"""With what ``.mat`` files begin that were written here, so that no other is written over."""


def write_law(law: StateLaw, path: str | Path, name: str, signals: Sequence[str], commands: Sequence[str]) -> None:
    """Write a law by the ending of a file; `signals`: what it sees, `commands`: what it gives, `name`: of the rig."""
    path = Path(path)
    if path.suffix == ".mat":
        names = {"signals": signals, "commands": commands}
        cells = {key: np.array(list(texts), dtype=object) for key, texts in names.items()}
        write_mat(path, {**_matrices(law), "rate_hz": law.rate_hz, **cells})
    elif path.suffix == ".py":
        path.write_text(python_of(law, name, signals, commands), encoding="utf-8")
    elif path.suffix == ".c":
        path.write_text(c_of(law, name, signals, commands), encoding="utf-8")
    else:
        raise EstimationError(f"{path.name} ends in none of {', '.join(ENDINGS)}. Give one of these endings")


def write_mat(path: Path, content: Mapping[str, Any]) -> None:
    """Write a ``.mat`` file, version 5, whose header says that it comes from here and not when."""
    from scipy.io import savemat

    written = BytesIO()
    savemat(written, content, long_field_names=True, oned_as="column")
    path.write_bytes(MAT_HEADER.ljust(116) + written.getvalue()[116:])


def _matrices(law: StateLaw) -> dict[str, Array]:
    return {"A": law.A, "B": law.B, "C": law.C, "D": law.D, "G": law.windup}


def python_of(law: StateLaw, name: str, signals: Sequence[str], commands: Sequence[str]) -> str:
    """Return a script that makes the law an object of python-control."""
    return "\n".join([
        f'"""The law of {comment_text(name)}, in SI, with sign: w = C z + D y, z+ = A z + B y + G (given - w)."""', "",
        "import control", "import numpy as np", "", f"RATE_HZ = {law.rate_hz!r}", f"SIGNALS = {list(signals)}",
        f"COMMANDS = {list(commands)}",
        *(f"{x} = np.array({m.tolist()}).reshape{m.shape}" for x, m in _matrices(law).items()), "", "",
        "def law():",
        '    """Return the law from what is fed back to the commands; G, which acts at limits, is beside it."""',
        "    return control.ss(A, B, C, D, 1.0 / RATE_HZ, inputs=SIGNALS, outputs=COMMANDS)", "", "",
        'if __name__ == "__main__":', "    print(law())", "",
    ])  # fmt: skip


_C = """/* The law of {name}, in double precision and SI; the sign is included.
 *
 *   w = C z + D y,  z+ = A z + B y + G (given - w)
 *
 * y: {signals}, less set point or rest; w: {commands}, beside those at rest. Once a sample, {rate} Hz:
 * law_command, then law_next with what the outputs were given of w (w itself where no limit came between).
 */
#define LAW_STATES {n}
#define LAW_SIGNALS {n_y}
#define LAW_COMMANDS {n_u}
#define LAW_RATE_HZ {rate}

struct law {{
    double z[{room}];
}};

{tables}

void law_reset(struct law *law)
{{
    int i;
    for (i = 0; i < LAW_STATES; i++)
        law->z[i] = 0.0;
}}

void law_command(const struct law *law, const double *y, double *w)
{{
    int i, j;
    for (i = 0; i < LAW_COMMANDS; i++) {{
        double sum = 0.0;
        for (j = 0; j < LAW_STATES; j++)
            sum += law_C[i][j] * law->z[j];
        for (j = 0; j < LAW_SIGNALS; j++)
            sum += law_D[i][j] * y[j];
        w[i] = sum;
    }}
}}

void law_next(struct law *law, const double *y, const double *w, const double *given)
{{
    double next[{room}];
    int i, j;
    for (i = 0; i < LAW_STATES; i++) {{
        next[i] = 0.0;
        for (j = 0; j < LAW_STATES; j++)
            next[i] += law_A[i][j] * law->z[j];
        for (j = 0; j < LAW_SIGNALS; j++)
            next[i] += law_B[i][j] * y[j];
        for (j = 0; j < LAW_COMMANDS; j++)
            next[i] += law_G[i][j] * (given[j] - w[j]);
    }}
    for (i = 0; i < LAW_STATES; i++)
        law->z[i] = next[i];
}}
"""


def c_of(law: StateLaw, name: str, signals: Sequence[str], commands: Sequence[str]) -> str:
    """Return the law as C source that needs nothing else."""
    return _C.format(
        name=comment_text(name), signals=", ".join(signals), commands=", ".join(commands), rate=repr(law.rate_hz),
        n=law.order, n_y=law.D.shape[1], n_u=law.D.shape[0], room=max(law.order, 1),
        tables="\n".join(_table(x, m) for x, m in _matrices(law).items()),
    )  # fmt: skip


def _table(name: str, matrix: Array) -> str:
    """Return a matrix as C; an empty one has one zero, which nothing reads."""
    full = matrix if matrix.size else np.zeros((max(matrix.shape[0], 1), max(matrix.shape[1], 1)))
    rows = ",\n".join("    {" + ", ".join(repr(float(x)) for x in row) + "}" for row in full)
    return f"static const double law_{name}[{full.shape[0]}][{full.shape[1]}] = {{\n{rows},\n}};"


def comment_text(name: str) -> str:
    """Return a text, such as a name that somebody gave, that begins and ends no comment and no string."""
    text = "".join(c if c.isprintable() and c not in '"\\' else " " for c in name)
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").strip() or "a rig"
