"""One tree of errors; each class knows the HTTP status it means.

Every error that surfacelink raises on purpose derives from `SurfacelinkError`::

    SurfacelinkError
    ├── InputError (ValueError)        422  what was given cannot be used
    │   ├── PointsError                422  a cloud of points that is no surface
    │   ├── ParameterError             422  a setting out of its bounds
    │   └── FileFormatError            422  a file that cannot be read as points
    ├── WireError (ValueError)         400  bytes that are not what they should be
    │   ├── PacketError                400  not a packet, or a damaged one
    │   ├── VersionError               400  a version or kind that is not known here
    │   └── LimitError                 413  more than the stated limits allow
    ├── ChannelError (ValueError)      422  a channel that cannot be built
    ├── TrainingError                  422  a network that cannot be trained on these points
    │   └── TrainingCancelled          409  stopped on request
    ├── NotFoundError                  404  no such surface, transmission or name
    ├── ConflictError                  409  contradicts what is already there
    ├── ForbiddenError                 403  the settings do not allow it
    ├── NotReadyError                  409  exists, but has no result yet
    ├── MediaTypeError                 415  a body of a kind that is not understood
    ├── NotAcceptableError             406  an answer in a form that is not offered
    ├── MissingExtraError              501  needs a package that is not installed
    ├── StoreError                     503  what is kept on disk cannot be read or written
    └── LinkError                      502  the other end does not answer, or answers nonsense
        └── RefusedError               502  the other end answered with a problem of its own
"""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import ClassVar


def guess(name: str, accepted: Iterable[str]) -> str:
    """What a message about an unknown name says of the one that was probably meant; "" where there is none."""
    close = get_close_matches(name[:80], list(accepted), n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def hint(name: str, accepted: Iterable[str]) -> str:
    """The end of a message about an unknown name: the one that was probably meant, and all that are accepted."""
    accepted = list(accepted)
    return f"{guess(name, accepted) or ';'} accepted are {', '.join(accepted)}"


class SurfacelinkError(Exception):
    """Root of the tree.

    Attributes
    ----------
    status : int
        The HTTP status the error means.
    title : str
        A short sentence that is the same for every error of the class (RFC 9457, "title").
    retry_after : int or None
        Seconds after which to ask again, where the error passes by itself.
    """

    status: ClassVar[int] = 500
    title: ClassVar[str] = "Internal error"
    retry_after: ClassVar[int | None] = None

    @property
    def detail(self) -> str:
        """What was wrong this time, and what is accepted (RFC 9457, "detail")."""
        return str(self)


class InputError(SurfacelinkError, ValueError):
    """What was given cannot be used."""

    status = 422
    title = "Unusable input"


class PointsError(InputError):
    """A cloud of points that is no surface: empty, not finite, in one place, on one line."""

    title = "Unusable points"


class ParameterError(InputError):
    """A setting out of its bounds."""

    title = "Parameter out of bounds"


class FileFormatError(InputError):
    """A file that cannot be read as points."""

    title = "Unreadable file"


class WireError(SurfacelinkError, ValueError):
    """Bytes that are not what they should be."""

    status = 400
    title = "Malformed body"


class PacketError(WireError):
    """Not a packet, or a damaged one."""

    title = "Malformed packet"


class VersionError(WireError):
    """A version or a kind that is not known here."""

    title = "Unknown version or kind"


class LimitError(WireError):
    """More than the stated limits allow."""

    status = 413
    title = "Limit exceeded"


class ChannelError(SurfacelinkError, ValueError):
    """A channel that cannot be built from its description."""

    status = 422
    title = "Unusable channel"


class TrainingError(SurfacelinkError):
    """A network that cannot be trained on these points."""

    status = 422
    title = "Training failed"


class TrainingCancelled(TrainingError):  # noqa: N818 - a request that was granted, not a fault
    """Stopped on request."""

    status = 409
    title = "Training cancelled"


class NotFoundError(SurfacelinkError):
    """No such surface, transmission or name."""

    status = 404
    title = "Not found"


class ConflictError(SurfacelinkError):
    """Contradicts what is already there."""

    status = 409
    title = "Conflict"


class ForbiddenError(SurfacelinkError):
    """The settings do not allow it."""

    status = 403
    title = "Not allowed here"


class NotReadyError(SurfacelinkError):
    """The surface exists but has no result yet."""

    status = 409
    title = "Not ready"


class MediaTypeError(SurfacelinkError):
    """A body of a kind that is not understood."""

    status = 415
    title = "Unsupported media type"


class NotAcceptableError(SurfacelinkError):
    """An answer was asked for in a form that is not offered."""

    status = 406
    title = "Not acceptable"


class MissingExtraError(SurfacelinkError):
    """What was asked for needs a package of an extra that is not installed."""

    status = 501
    title = "Not installed here"


class StoreError(SurfacelinkError):
    """What is kept on disk cannot be read or written."""

    status = 503
    title = "Store unavailable"


class LinkError(SurfacelinkError):
    """The other end does not answer, or answers what makes no sense."""

    status = 502
    title = "The other end failed"


class RefusedError(LinkError):
    """The other end answered with a problem (RFC 9457) of its own.

    Attributes
    ----------
    answered : int
        The HTTP status it answered with.
    """

    title = "Refused by the other end"

    def __init__(self, message: str, answered: int) -> None:
        super().__init__(message, answered)
        self.answered = answered

    def __str__(self) -> str:
        return str(self.args[0])
