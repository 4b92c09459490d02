"""All that a ledger holds, without the numbers of rows, so that two can be compared."""

from ambid.ledger import open_ledger

_QUERIES = {
    "bearing": "SELECT name, plant FROM bearing WHERE name > '!'",
    "estimate": """
        SELECT e.key, b.name, e.taken_at, e.version, e.verdict, e.added_at
        FROM estimate e JOIN bearing b ON b.id = e.bearing""",
    "value": """
        SELECT e.key, b.name, v.taken_at, v.name, v.value, v.sd, v.unit, v.role
        FROM value v JOIN estimate e ON e.id = v.estimate JOIN bearing b ON b.id = v.bearing""",
    "event": """
        SELECT e.key, b.name, v.at, v.kind, v.parameter, v.text
        FROM event v JOIN estimate e ON e.id = v.estimate JOIN bearing b ON b.id = v.bearing""",
    "document": "SELECT e.key, d.json, d.covariance FROM document d JOIN estimate e ON e.id = d.estimate",
    "rig": "SELECT sha, name, text FROM rig",
    "failure": "SELECT * FROM failure",
    "assignment": "SELECT * FROM assignment",
    "silence": "SELECT at, kind, bearing, rule, parameter, since, until, who, why FROM silence",
    "correction": "SELECT at, who, kind, bearing, text, why FROM correction",
}


def contents(place):
    with open_ledger(place, write=False) as ledger, ledger._reading() as c:
        return {name: {tuple(row) for row in c.exec_driver_sql(query)} for name, query in _QUERIES.items()}
