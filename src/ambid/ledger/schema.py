"""The tables of a ledger, schema ``ambid.ledger/1`` (contracts.md), for SQLite and PostgreSQL."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

SCHEMA = "ambid.ledger/1"
VERSION = 1
STEPS: Mapping[int, tuple[str, ...]] = {}
"""Statements that bring a ledger of a version to the next one."""


@cache
def tables() -> Any:
    """Return the tables, as attributes of their metadata's ``tables`` by name."""
    import sqlalchemy as sa
    from sqlalchemy import Boolean, Column, Double, ForeignKey, Index, Integer, LargeBinary, Table, Text

    whole = sa.MetaData()
    long = sa.BigInteger().with_variant(Integer(), "sqlite")  # where that is the row's own number

    def column(name: str, kind: Any = Text, *more: Any, nullable: bool = False, **how: Any) -> Any:
        return Column(name, kind, *more, nullable=nullable, **how)

    sa.Sequence("estimate_id", metadata=whole)  # PostgreSQL's; SQLite has one writer at a time
    Table("meta", whole, column("name", primary_key=True), column("value"))
    Table(
        "bearing", whole, column("id", Integer, primary_key=True), column("name", unique=True), column("plant"),
    )  # fmt: skip
    Table("rig", whole, column("sha", primary_key=True), column("name"), column("text", LargeBinary))
    Table(
        "estimate", whole,
        column("id", long, primary_key=True, autoincrement=False),
        column("bearing", Integer, ForeignKey("bearing.id")), column("taken_at", Double),
        *(column(name) for name in ("sha", "rig_sha", "settings", "version")),
        column("key", unique=True),
        *(column(name) for name in ("job", "record", "status", "verdict", "model", "failed")),
        column("added_at", Double),
        # a history reads these; in the index they lie together, in the table each row in a page of its own
        Index(
            "estimate_of", "bearing", "taken_at", "id",
            postgresql_include=[
                "record", "sha", "rig_sha", "job", "model", "version", "status", "verdict", "failed"
            ],
        ),
    )  # fmt: skip
    Table(
        "value", whole,
        column("bearing", Integer), column("name"), column("taken_at", Double),
        column("estimate", long, ForeignKey("estimate.id")),
        column("value", Double, nullable=True), column("sd", Double, nullable=True),
        column("identifiable", Boolean), column("unit"), column("role"),
        # in the order in which a history reads it, so that one lies together
        sa.PrimaryKeyConstraint(
            "bearing", "name", "taken_at", "estimate",
            postgresql_include=["value", "sd", "identifiable", "unit", "role"],
        ),
        sqlite_with_rowid=False,
    )  # fmt: skip
    Table(
        "event", whole, column("id", Integer, primary_key=True), column("bearing", Integer, ForeignKey("bearing.id")),
        column("at", Double), *(column(name) for name in ("kind", "parameter", "text")),
        column("estimate", long, ForeignKey("estimate.id"), nullable=True), Index("event_of", "bearing", "at"),
    )  # fmt: skip
    Table(
        "document", whole, column("estimate", long, ForeignKey("estimate.id"), primary_key=True, autoincrement=False),
        column("json", LargeBinary), column("covariance", LargeBinary),
    )  # fmt: skip
    Table(
        "failure", whole, column("key", primary_key=True),
        *(column(name) for name in ("bearing", "record", "sha", "rig_sha", "settings", "version", "reason")),
        column("failed_at", Double),
    )  # fmt: skip
    return whole
