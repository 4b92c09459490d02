"""``ambid console``: a page in the browser that shows, commissions and judges a bearing."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from ambid.cli.options import option, switch
from ambid.errors import AmbidError

PASSWORD = "AMBID_CONSOLE_PASSWORD"


def command(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="Folder whose files are shown.")] = Path("."),
    port: Annotated[int, option("--port N", "Port of the page; 0: any that is free.", True)] = 0,
    no_browser: Annotated[bool, switch("--no-browser", "Print the link only.")] = False,
    read_only: Annotated[bool, switch("--read-only", "Refuse what changes something.")] = False,
    listen: Annotated[
        str, option("--listen ADDRESS", f"Another address; it needs TLS files, and a password in {PASSWORD}.", True)
    ] = "127.0.0.1",
    certificate: Annotated[Path | None, option("--certificate FILE", "TLS certificate, PEM.")] = None,
    key: Annotated[Path | None, option("--key FILE", "TLS key, PEM.")] = None,
) -> None:
    """Show the records of a folder, live signals and commissioning in the browser, until Ctrl-C.

    The page is served to this machine alone, and the link that is printed opens it once. What runs goes on when the
    console ends, and is found again by the next one.
    """
    try:
        from ambid.console.server import serve
    except ModuleNotFoundError as missing:
        if (missing.name or "").startswith("ambid"):
            raise
        raise AmbidError(f"the console needs {missing.name}. Install it: pip install 'ambid[console]'") from None
    if not 0 <= port <= 65_535:
        raise AmbidError(f"--port {port} is none; ports are 0 to 65535. Correct it")
    if (certificate is None) != (key is None):
        raise AmbidError("--certificate and --key belong together, and one is missing. Give both")
    for path in (certificate, key):
        if path is not None and not path.is_file():
            raise AmbidError(f"{path} is no file. Correct the path")

    def ready(link: str) -> None:
        print(f"console of {folder}: {link}  (Ctrl-C ends it; runs go on)", flush=True)
        if not no_browser and sys.stdout.isatty():
            import webbrowser

            webbrowser.open(link)

    serve(
        folder, port=port, read_only=read_only, listen=listen,
        tls=None if certificate is None or key is None else (certificate, key),
        password=os.environ.get(PASSWORD) or None, on_ready=ready,
    )  # fmt: skip
