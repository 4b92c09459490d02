"""A ledger as version 1 of its tables made it, by SQL of then, with two bearings and what failed."""

import sqlite3
import zlib

from ambid.ledger.entry import key_of
from tests.ledger.entries import BEGIN, DAY

_TABLES = """
CREATE TABLE meta (name TEXT NOT NULL, value TEXT NOT NULL, PRIMARY KEY (name));
CREATE TABLE bearing (id {serial} NOT NULL, name TEXT NOT NULL, plant TEXT NOT NULL, PRIMARY KEY (id), UNIQUE (name));
CREATE TABLE rig (sha TEXT NOT NULL, name TEXT NOT NULL, text {blob} NOT NULL, PRIMARY KEY (sha));
CREATE TABLE failure (
    key TEXT NOT NULL, bearing TEXT NOT NULL, record TEXT NOT NULL, sha TEXT NOT NULL, rig_sha TEXT NOT NULL,
    settings TEXT NOT NULL, version TEXT NOT NULL, reason TEXT NOT NULL, failed_at {double} NOT NULL, PRIMARY KEY (key)
);
CREATE TABLE estimate (
    id {long} NOT NULL, bearing INTEGER NOT NULL, taken_at {double} NOT NULL, sha TEXT NOT NULL, rig_sha TEXT NOT NULL,
    settings TEXT NOT NULL, version TEXT NOT NULL, key TEXT NOT NULL, job TEXT NOT NULL, record TEXT NOT NULL,
    status TEXT NOT NULL, verdict TEXT NOT NULL, model TEXT NOT NULL, failed TEXT NOT NULL, added_at {double} NOT NULL,
    PRIMARY KEY (id), FOREIGN KEY(bearing) REFERENCES bearing (id), UNIQUE (key)
);
CREATE INDEX estimate_of ON estimate (bearing, taken_at, id){included};
CREATE TABLE value (
    bearing INTEGER NOT NULL, name TEXT NOT NULL, taken_at {double} NOT NULL, estimate {long} NOT NULL, value {double},
    sd {double}, identifiable BOOLEAN NOT NULL, unit TEXT NOT NULL, role TEXT NOT NULL,
    PRIMARY KEY (bearing, name, taken_at, estimate){included_values}, FOREIGN KEY(estimate) REFERENCES estimate (id)
){rowid};
CREATE TABLE event (
    id {serial} NOT NULL, bearing INTEGER NOT NULL, at {double} NOT NULL, kind TEXT NOT NULL, parameter TEXT NOT NULL,
    text TEXT NOT NULL, estimate {long}, PRIMARY KEY (id), FOREIGN KEY(bearing) REFERENCES bearing (id),
    FOREIGN KEY(estimate) REFERENCES estimate (id)
);
CREATE INDEX event_of ON event (bearing, at);
CREATE TABLE document (
    estimate {long} NOT NULL, json {blob} NOT NULL, covariance {blob} NOT NULL, PRIMARY KEY (estimate),
    FOREIGN KEY(estimate) REFERENCES estimate (id)
);
"""
_SQLITE = {
    "serial": "INTEGER", "long": "INTEGER", "double": "DOUBLE", "blob": "BLOB", "included": "", "included_values": "",
    "rowid": " WITHOUT ROWID",
}  # fmt: skip
_POSTGRES = {
    "serial": "SERIAL", "long": "BIGINT", "double": "DOUBLE PRECISION", "blob": "BYTEA", "rowid": "",
    "included": " INCLUDE (record, sha, rig_sha, job, model, version, status, verdict, failed)",
    "included_values": " INCLUDE (value, sd, identifiable, unit, role)",
}  # fmt: skip
ESTIMATES = 6


def _rows():
    yield "meta", ("schema", "ambid.ledger/1")
    yield "meta", ("version", "1")
    yield "rig", ("one", "bench", zlib.compress(b'name = "one"\n'))
    for number, name in enumerate(("A", "B"), 1):
        yield "bearing", (number, name, f"bench {name}")
    for k in range(ESTIMATES):
        bearing, sha, at = 1 + k % 2, f"record {k}", BEGIN + DAY * k
        key = key_of(sha, "one", "{}", "1.0.0")
        words = (sha, "one", "{}", "1.0.0", key, "identify", f"day{k}.h5", "converged", "usable", "one-axis", "")
        yield "estimate", (k + 1, bearing, at, *words, at + 60.0)
        yield "value", (bearing, "k_i", at, k + 1, 80.0 - k, 0.5, True, "N/A", "free")
        yield "value", (bearing, "R", at, k + 1, None, None, False, "ohm", "free")
    yield "event", (1, 1, BEGIN + 5.0, "change", "k_i", "it fell", 1)
    yield "document", (1, zlib.compress(b"{}"), zlib.compress(b'{"names": [], "matrix": []}'))
    key = key_of("none", "one", "{}", "1.0.0")
    yield "failure", (key, "A", "day9.h5", "none", "one", "{}", "1.0.0", "out of memory", BEGIN)


def make(place):
    """Make one where there is none, in SQLite or PostgreSQL."""
    postgres = "://" in place
    statements = _TABLES.format(**_POSTGRES if postgres else _SQLITE).split(";\n")
    if postgres:
        import psycopg

        with psycopg.connect(place) as c:
            for statement in ("CREATE SEQUENCE estimate_id", *statements):
                c.execute(statement)
            for table, row in _rows():
                c.execute(f"INSERT INTO {table} VALUES ({', '.join(['%s'] * len(row))})", row)
            c.execute(f"SELECT setval('estimate_id', {ESTIMATES})")
            for table in ("bearing", "event"):
                c.execute(f"SELECT setval('{table}_id_seq', (SELECT max(id) FROM {table}))")
        return
    c = sqlite3.connect(place)
    c.execute("PRAGMA journal_mode = WAL")
    for statement in statements:
        c.execute(statement)
    for table, row in _rows():
        c.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(row))})", row)
    c.commit()
    c.close()
