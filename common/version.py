"""Which surfacelink this is."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version


def product_version() -> str:
    """Version of the installed distribution, or "source" for a checkout that is not installed."""
    try:
        return version("surfacelink")
    except PackageNotFoundError:
        return "source"
