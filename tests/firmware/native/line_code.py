"""Frames as the table of messages says, by another way than firmware and product: for comparison."""

import binascii


def stuff(data):
    """COBS of `data`."""
    out = bytearray()
    for block in data.split(b"\0"):
        assert len(block) < 254
        out += bytes([len(block) + 1]) + block
    return bytes(out)


def frame(body):
    """The frame of a body, with the zero at its end."""
    return stuff(body + binascii.crc_hqx(body, 0).to_bytes(2, "little")) + b"\0"


def opened(run):
    """The body in what stands between two zeros, or None if it is damaged."""
    out, at = bytearray(), 0
    while at < len(run):
        end = at + run[at]
        if end > len(run):
            return None
        out += run[at + 1 : end]
        if run[at] != 0xFF and end < len(run):
            out.append(0)
        at = end
    if not 3 <= len(out) <= 64 or binascii.crc_hqx(bytes(out[:-2]), 0).to_bytes(2, "little") != out[-2:]:
        return None
    return bytes(out[:-2])


def expected(line):
    """What a decoder finds in `line`: bodies in hex, "-" for each damaged frame; after the last zero nothing counts."""
    found = []
    for run in line.split(b"\0")[:-1]:
        if run:
            body = opened(run)
            found.append("-" if body is None else body.hex())
    return found
