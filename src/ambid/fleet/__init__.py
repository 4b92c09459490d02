"""Any job on many records: a pool of processes or a cluster, each record once.

The room itself is the function `ambid.fleet`: ``ambid.fleet(records, rigs, job=...)``.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ambid.lazy import exports

if TYPE_CHECKING:
    from ambid.fleet.run import fleet as fleet

_exported, __dir__, __all__ = exports(__name__)


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for."""
    return _exported(name)


class _Room(ModuleType):
    """The room as `ambid` shows it, whose name is also that of its function."""

    def __call__(self, *arguments: Any, **settings: Any) -> Any:
        from ambid.fleet.run import fleet

        return fleet(*arguments, **settings)


sys.modules[__name__].__class__ = _Room
