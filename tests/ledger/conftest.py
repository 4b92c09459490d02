import itertools

import pytest

from tests.ledger import server

COUNT = itertools.count()


@pytest.fixture(scope="session")
def postgres():
    """The URL of a server of our own, with a place for the name of a database."""
    why = server.absent()
    if why is not None:
        pytest.skip(why)
    with server.server() as url:
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request, tmp_path):
    """Where a new ledger may be, of either engine."""
    if request.param == "sqlite":
        return str(tmp_path / "l.db")
    return server.new_database(request.getfixturevalue("postgres"), f"t{next(COUNT)}")
