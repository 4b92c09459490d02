"""The controller's header against the host's codec: each message read and written by both, byte for byte.

A small C program made from the table reads code and fields with ``read_NAME``, prints what it read, and writes them
again with ``write_NAME``.
"""

import os
import random
import shutil
import subprocess

import pytest

from ambid.acquisition.protocol import table
from ambid.acquisition.protocol.codec import pack
from tests.acquisition.protocol.vectors import random_message
from tests.conventions.sources import ROOT

HEADER = ROOT / "firmware" / "amb_daq" / "protocol.h"
FLAGS = ["-Wall", "-Wextra", "-Werror", "-Wconversion", "-pedantic"]
COMPILERS = {"C99": ("cc", ["-std=c99", "-x", "c"]), "C++": ("c++", ["-std=c++11", "-x", "c++"])}
CTYPES = {"u8": "uint8_t", "u16": "uint16_t", "u32": "uint32_t", "i8": "int8_t", "i16": "int16_t", "i32": "int32_t"}


def compiler(name):
    found = shutil.which(name)
    if found is None:
        if os.environ.get("CI") == "true":
            pytest.fail(f"{name} is not there, and CI skips nothing")
        pytest.skip(f"no {name}: apt-get install gcc g++")
    return found


def case(kind):
    """What the program does with one message: read, print, write again."""
    tail = kind.tail
    lines = [f"case MSG_{kind.name.upper()}: {{"]
    lines.append(f"struct msg_{kind.name} m = read_{kind.name}(in{', n' if tail else ''});")
    lines += [f'printf(" %lld", (long long)m.{f.name});' for f in kind.fixed]
    arguments = "".join(f", m.{f.name}" for f in kind.fixed)
    if tail:
        lines.append(f"{CTYPES[tail.kind]} a[64]; uint8_t i;")
        lines.append(f"for (i = 0; i < m.n_{tail.name}; i++) a[i] = {kind.name}_{tail.name}(in, i);")
        lines.append(f'for (i = 0; i < m.n_{tail.name}; i++) printf(" %lld", (long long)a[i]);')
        arguments += f", a, m.n_{tail.name}"
    else:
        lines.append(f"if (n != LENGTH_{kind.name.upper()}) return 2;")
    lines.append(f"n = write_{kind.name}(out{arguments}); break; }}")
    return "\n".join(lines)


def program():
    return f"""
#include <stdio.h>
#include <string.h>
#include "{HEADER}"
int main(void)
{{
    uint8_t in[64], out[64], n, k;
    int c;
    while ((c = getchar()) != EOF) {{
        n = (uint8_t)c;
        if (fread(in, 1, n, stdin) != n) return 1;
        memset(out, 0xa5, sizeof out);
        printf("%d", in[0]);
        switch (in[0]) {{
{"".join(case(kind) for kind in table().messages.values())}
        default: return 3;
        }}
        printf(" :");
        for (k = 0; k < n; k++) printf(" %02x", out[k]);
        printf("\\n");
    }}
    return 0;
}}
"""


@pytest.mark.parametrize("language", COMPILERS)
def test_both_sides_read_and_write_the_same(language, tmp_path):
    name, standard = COMPILERS[language]
    source, made = tmp_path / "both.c", tmp_path / "both"
    source.write_text(program(), encoding="utf-8")
    subprocess.run([compiler(name), *FLAGS, *standard, str(source), "-o", str(made)], check=True, timeout=120)
    generator = random.Random(2)
    sent = [random_message(kind, generator) for kind in table().messages.values() for _ in range(50)]
    packed = [pack(m) for m in sent]
    records = b"".join(bytes((len(p),)) + p for p in packed)
    done = subprocess.run([str(made)], input=records, capture_output=True, check=True, timeout=60)
    lines = done.stdout.decode().splitlines()
    assert len(lines) == len(sent)
    for line, message, payload in zip(lines, sent, packed, strict=True):
        numbers, written = line.split(" :")
        assert [int(x) for x in numbers.split()] == [payload[0], *message.fields.values(), *message.values]
        assert bytes.fromhex(written) == payload


def test_the_header_compiles_for_the_controller(tmp_path):
    source = tmp_path / "header.c"
    source.write_text(f'#include "{HEADER}"\nint main(void) {{ return 0; }}\n', encoding="utf-8")
    avr = shutil.which("avr-gcc")
    if avr is None and os.environ.get("CI") != "true":
        pytest.skip("no avr-gcc: apt-get install gcc-avr avr-libc")
    command = [avr or "avr-gcc", "-mmcu=atmega328p", "-Os", "-std=c99", *FLAGS, "-fsyntax-only", str(source)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
