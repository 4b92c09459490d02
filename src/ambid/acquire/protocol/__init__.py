"""The wire protocol: declared once in ``messages.toml``, framed with COBS and a CRC."""
