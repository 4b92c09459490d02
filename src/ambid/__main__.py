"""``python -m ambid`` is the command ``ambid``."""

from ambid.cli import main

main()
