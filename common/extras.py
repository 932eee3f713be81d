"""Packages that not everyone needs, and the extras of the distribution that bring them."""

from __future__ import annotations

from importlib.util import find_spec

from common.errors import MissingExtraError


def is_installed(package: str) -> bool:
    """Whether the module `package` can be imported; "" is none, and always there."""
    return not package or find_spec(package) is not None


def require(what: str, package: str, extra: str) -> None:
    """Raise MissingExtraError where `what` needs a `package` that is not installed; `extra` brings it."""
    if not is_installed(package):
        raise MissingExtraError(
            f"{what} needs the package {package}; install it with: pip install 'surfacelink[{extra}]'"
        )
