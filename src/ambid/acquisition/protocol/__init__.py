"""The wire protocol between host and controller: both sides follow from one table, ``messages.toml``."""
