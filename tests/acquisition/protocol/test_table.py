"""The table of the protocol: its own rules, and that what is made from it is up to date."""

import re
import subprocess
import sys
from importlib import resources

import pytest

from ambid.acquisition.protocol import read_table, table
from tests.conventions.sources import ROOT
from tools.protocol_header import c_header, complaints, protocol_page

TEXT = resources.files("ambid.acquisition.protocol").joinpath("messages.toml").read_text(encoding="utf-8")
REMEDY = "run `python tools/protocol_header.py`"


def test_the_controllers_header_is_made_from_the_table():
    made = (ROOT / "firmware" / "amb_daq" / "protocol.h").read_text(encoding="utf-8")
    assert made == c_header(table()), f"protocol.h is stale: {REMEDY}"


def test_the_reference_page_is_made_from_the_table():
    assert (ROOT / "docs" / "protocol.md").read_text(encoding="utf-8") == protocol_page(table()), f"stale: {REMEDY}"


def test_the_tool_agrees():
    tool = ROOT / "tools" / "protocol_header.py"
    done = subprocess.run([sys.executable, str(tool), "--check"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_the_page_names_everything():
    page = protocol_page(table())
    for m in table().messages.values():
        assert f"### `{m.name}` 0x{m.code:02x}" in page
    for group in [*table().enums.values(), *table().bits.values()]:
        assert all(f"| {e.value} | `{e.name}` |" in page for e in group)


def test_constants_of_the_header():
    header = c_header(table())
    for line in (
        "MSG_ACK 0x02",
        "STATE_FAULT 4",
        "CAUSE_WATCHDOG 8",
        "CODE_UNREADY 5",
        "MODE_LEVITATE 3",
        "KIND_PRBS 2",
    ):
        assert f"#define {line} " in header
    assert "#define STREAM_DUTY 0x08 " in header
    assert "#define FAILED_PULSE_WIDTH 0x40 " in header
    names = re.findall(r"^#define (\w+) ", header, re.MULTILINE)
    assert len(names) == len(set(names))


def test_lengths_and_names():
    messages = table().messages
    assert messages["limits"].length == 1 + 1 + 9 * 2
    assert messages["sample"].length == 4
    assert messages["sample"].tail is not None
    assert messages["gains"].tail is None
    assert table().name("cause", 3) == "over_current"
    assert table().name("cause", 99) == "99"
    assert table().names_of_bits("ready", 0b101) == ("configure", "gains")


WRONG = {
    "code twice": ("code = 0x02", "code = 0x01", "codes to the host: 1 stands twice"),
    "code zero": ("code = 0x02", "code = 0", "message ack: code 0 is not within 1 to 255"),
    "side": ('to = "controller"', 'to = "nobody"', "to = 'nobody'"),
    "type": ('["tick", "u16"', '["tick", "u24"', "has type 'u24'"),
    "array first": ('["tick", "u16"', '["tick", "u16[]"', "tick is the rest of the frame, but others follow"),
    "field twice": ('["state", "u8", "state, and', '["tick", "u8", "state, and', "'tick' stands twice"),
    "too long": ("largest = 64", "largest = 16", "the largest frame has 16"),
    "too large": ("largest = 64", "largest = 255", "at most 254 bytes"),
    "value twice": ("sampling = [1,", "sampling = [0,", "group state: 0 stands twice"),
    "value": ("sampling = [1,", "sampling = [256,", "state.sampling: 256 is out of range"),
    "bit": ("supply = [1,", "supply = [16,", "failed.supply: 16 is out of range"),
    "stream": ('duty = [3, "u16"', 'duty = [9, "u16"', "bits are to be 0, 1, ... in order"),
    "width": ('duty = [3, "u16"', 'duty = [3, "u32"', "stream.duty: u32 has not two bytes"),
    "name": ("[messages.stop]", "[messages.Stop]", "'Stop' is no name in both languages"),
    "comment": ('"output off, no samples"', '"output off */"', "would end a comment"),
    "version": ("version = 1", "version = 256", "version 256 does not fit a byte"),
}


@pytest.mark.parametrize(("old", "new", "says"), WRONG.values(), ids=WRONG.keys())
def test_a_table_that_breaks_a_rule_is_refused(old, new, says):
    assert old in TEXT
    assert any(says in line for line in complaints(read_table(TEXT.replace(old, new, 1))))


def test_the_table_breaks_no_rule():
    assert list(complaints(table())) == []


def test_every_command_begins_with_its_number_and_some_things_never_change():
    for m in table().messages.values():
        if m.to == "controller":
            assert (m.fields[0].name, m.fields[0].kind) == ("id", "u8")
    identify, identity = table().messages["identify"], table().messages["identity"]
    assert (identify.code, identify.length) == (0x10, 2)
    assert identity.code == 0x03
    assert [(f.name, f.kind) for f in identity.fields[:2]] == [("id", "u8"), ("protocol", "u8")]
