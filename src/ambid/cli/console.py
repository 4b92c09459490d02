"""``ambid console``: a page in the browser that shows, commissions and judges a bearing."""

from __future__ import annotations

import sys

from ambid.cli.options import Values, verb
from ambid.errors import AmbidError


@verb("console")
def command(v: Values) -> None:
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

    def ready(link: str) -> None:
        print(f"console of {v.folder}: {link}  (Ctrl-C ends it; runs go on)", flush=True)
        if not v.no_browser and sys.stdout.isatty():
            import webbrowser

            webbrowser.open(link)

    serve(v.folder, port=v.port, read_only=v.read_only, on_ready=ready)
