"""A PostgreSQL server of our own, in a temporary folder, on a socket there; gone when the block ends."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def absent() -> str | None:
    """Why no server can be started here; None where one can."""
    if os.environ.get("CI") == "true":
        return "no server is started in CI"
    if not (shutil.which("initdb") and shutil.which("postgres")):
        return "the programs of PostgreSQL are not installed"
    try:
        import psycopg  # noqa: F401
    except ImportError:
        return "psycopg is not installed"
    if os.geteuid() == 0 and _other() is None:
        return "PostgreSQL refuses to run as root, and there is no user postgres or nobody"
    return None


def _other() -> int | None:
    known = {p.pw_name: p.pw_uid for p in pwd.getpwall()}
    return known.get("postgres", known.get("nobody"))


@contextmanager
def server() -> Iterator[str]:
    """Start a server; its URL without the name of a database."""
    how = {} if os.geteuid() else {"user": _other(), "group": pwd.getpwuid(_other()).pw_gid}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
    with tempfile.TemporaryDirectory(prefix="pg", ignore_cleanup_errors=True) as made:
        if how:
            os.chown(made, how["user"], how["group"])
        data = Path(made) / "data"
        words = ["-U", "ambid", "-A", "trust", "--no-sync", "-E", "UTF8", "--locale", "C"]
        subprocess.run(["initdb", "-D", data, *words], check=True, cwd=made, **quiet, **how)
        run = subprocess.Popen(
            ["postgres", "-D", data, "-k", made, "-c", "listen_addresses=", "-c", "fsync=off"], cwd=made, **quiet, **how
        )
        try:
            wait(made, run)
            yield f"postgresql://ambid@/{{}}?host={made}"
        finally:
            run.terminate()
            run.wait(30)


def wait(folder: str, run: subprocess.Popen[bytes]) -> None:
    """Wait until the server answers."""
    import psycopg

    for _ in range(600):
        try:
            psycopg.connect(host=folder, user="ambid", dbname="postgres").close()
            return
        except psycopg.OperationalError:
            if run.poll() is not None:
                raise
            time.sleep(0.1)
    raise TimeoutError("the server does not answer")


def new_database(url: str, name: str) -> str:
    """Make an empty database; its URL."""
    import psycopg

    with psycopg.connect(url.format("postgres"), autocommit=True) as c:
        c.execute(f'CREATE DATABASE "{name}"')
    return url.format(name)
