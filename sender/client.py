"""FeatureSet in, HTTP out: the receiver's client, with retries and selective retransmission."""

from __future__ import annotations

import io
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import Any, TypeAlias

import anyio
import httpx
import numpy as np
from pydantic import ValidationError

from common.channel.carrying import ATTEMPT_HEADER
from common.errors import LinkError, NotFoundError, ParameterError, RefusedError, SurfacelinkError, TrainingError
from common.messages import Receipt
from common.network.model import NetworkSettings
from common.surface import FloatArray, HeightGrid, Region, Units
from common.wire import MEDIA_TYPE

Sleep: TypeAlias = Callable[[float], Awaitable[None]]

CONNECT_TIMEOUT = 5.0
"""Seconds to reach the receiver: a host that is up answers within a second, even over a satellite."""

READ_TIMEOUT = 60.0
"""Seconds for an answer, beside the time that a body takes on the link."""

SLOWEST_LINK = 100.0
"""Bits a second at which a body is given its time on the link: less than half of LoRa's lowest rate, see
`common.channel.profiles`."""

PROBES = 5
"""Signs of life that a receiver may owe one after the other, asked for `READ_TIMEOUT` apart and each given as long,
before it counts as hanging: on a slow link they share the line with the body."""

POLL = 0.1
"""Seconds between two questions whether a surface is trained: what an eye takes for at once."""

MAX_BODY_BYTES = 4 << 20
"""A longer run of packets is posted in several bodies: well below what the receiver accepts in one."""

RETRY_STATUS = frozenset({408, 429, 502, 503, 504})
"""Answers that a later try may change (RFC 9110, sections 15.5 and 15.6)."""


def server_url(url: str, whose: str) -> httpx.URL:
    """The address of an HTTP server; raises ParameterError, which says `whose` it should be, for anything else."""
    told = f"{url!r} is not {whose} URL"
    try:
        parsed = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise ParameterError(f"{told}: {error}") from error
    if parsed.scheme not in ("http", "https") or not parsed.host or parsed.query or parsed.fragment:
        raise ParameterError(f"{told}; accepted is for example http://127.0.0.1:8001")
    if parsed.port is not None and not 1 <= parsed.port <= 65535:
        raise ParameterError(f"{told}; its port must be 1 to 65535")
    return parsed


def http_client(
    server: httpx.URL, timeout: httpx.Timeout, transport: httpx.AsyncBaseTransport | None
) -> httpx.AsyncClient:
    """A client for `server`: through the proxy of the environment, unless there is a `transport` or the server is on
    this machine, where no proxy can reach it. Raises ParameterError for a proxy that cannot be used."""
    try:
        here = ip_address(server.host).is_loopback
    except ValueError:
        here = server.host == "localhost"
    if transport is None and here:
        transport = httpx.AsyncHTTPTransport()
    try:
        return httpx.AsyncClient(base_url=server, timeout=timeout, transport=transport)
    except (ImportError, ValueError, httpx.InvalidURL) as error:
        raise ParameterError(
            f"the proxy that HTTP_PROXY, HTTPS_PROXY or ALL_PROXY names cannot be used: {error}; "
            f"NO_PROXY={server.host} goes without"
        ) from error


@dataclass(frozen=True)
class RetryPolicy:
    """Exponential backoff with jitter.

    Attributes
    ----------
    tries : int
        Requests in all, at least 1.
    first, factor, longest : float
        Seconds before the second request; what each further pause is multiplied by; its bound.
    jitter : float
        Share of a pause that is drawn at random, so that many senders do not come back together.
    """

    tries: int = 4
    first: float = 0.25
    factor: float = 2.0
    longest: float = 8.0
    jitter: float = 0.5

    def pause(self, failures: int, rng: np.random.Generator) -> float:
        """Seconds to wait after `failures` >= 1 failed requests."""
        full = min(self.longest, self.first * self.factor ** (failures - 1))
        return float(full * (1 - self.jitter * rng.random()))


@dataclass
class Sent:
    """What a transmission took.

    Attributes
    ----------
    receipt : Receipt
        The last one.
    packets, bytes : int
        Put on the air, retransmissions included.
    retransmitted : int
        Packets sent again because the receipt called them missing.
    """

    receipt: Receipt
    packets: int
    bytes: int
    retransmitted: int


@dataclass
class ReceiverClient:
    """A receiver, spoken to over HTTP.

    Parameters
    ----------
    http : httpx.AsyncClient
        With `base_url` set; any transport (a socket, an ASGI application, a channel around either).
    retry : RetryPolicy
    sleep : callable
        Awaited between tries; replace it to run without a clock.
    rng : numpy.random.Generator
        Draws the jitter of the pauses; never part of a result.
    tick : callable
        Awaited between the signs of life that are asked for while a body is on its way.
    """

    http: httpx.AsyncClient
    retry: RetryPolicy = RetryPolicy()
    sleep: Sleep = anyio.sleep
    rng: np.random.Generator = field(default_factory=np.random.default_rng)
    tick: Sleep = anyio.sleep

    @classmethod
    def connect(cls, url: str, transport: httpx.AsyncBaseTransport | None = None) -> ReceiverClient:
        """A client for the receiver at `url`; raises ParameterError for what is no http(s) URL."""
        timeout = httpx.Timeout(READ_TIMEOUT, connect=CONNECT_TIMEOUT)
        base = server_url(url, "a receiver's")
        if base.path.rstrip("/").endswith("/v1"):
            raise ParameterError(f"{url!r} has the path of a call in it; give the receiver's URL without /v1")
        return cls(http_client(base, timeout, transport))

    async def __aenter__(self) -> ReceiverClient:
        await self.http.__aenter__()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.http.aclose()

    async def send(
        self,
        packets: Sequence[bytes],
        *,
        transmission: str,
        rounds: int = 1,
        network: NetworkSettings | None = None,
    ) -> Sent:
        """Post the packets, then, for up to `rounds` - 1 more rounds, those that the receipt calls missing.

        Parameters
        ----------
        packets : sequence of bytes
            As `common.wire.encode` makes them; the index is the sequence number.
        transmission : str
            Its id at the receiver.
        rounds : int
            1 sends each packet once.
        network : NetworkSettings, optional
            The network the receiver is to train; what is not set is left to the receiver.

        Raises
        ------
        LinkError
            If the receiver cannot be reached, shows no sign of life while a body is on its way, or its answer makes no
            sense.
        SurfacelinkError
            As the receiver's problem says.
        """
        if rounds < 1:
            raise ParameterError(f"rounds must be 1 or more, got {rounds}")
        asked = {} if network is None else network.model_dump(exclude_unset=True)
        wanted: Sequence[int] = range(len(packets))
        sent = Sent(await self._post(packets, wanted, transmission, 0, asked), len(packets), sum(map(len, packets)), 0)
        for attempt in range(1, rounds):
            if sent.receipt.complete:
                break
            # A receipt without a total means that nothing got through: the receiver cannot know what is missing.
            wanted = range(len(packets)) if sent.receipt.packets.total is None else sent.receipt.packets.missing
            wanted = [number for number in wanted if number < len(packets)]
            sent.receipt = await self._post(packets, wanted, transmission, attempt, asked)
            sent.packets += len(wanted)
            sent.bytes += sum(len(packets[number]) for number in wanted)
            sent.retransmitted += len(wanted)
        return sent

    async def _post(
        self,
        packets: Sequence[bytes],
        wanted: Sequence[int],
        transmission: str,
        attempt: int,
        network: Mapping[str, Any],
    ) -> Receipt:
        body = bytearray()
        receipt: Receipt | None = None
        for position, number in enumerate(wanted):
            body += packets[number]
            last = position + 1 == len(wanted)
            if last or len(body) + len(packets[wanted[position + 1]]) > MAX_BODY_BYTES:
                answer = await self._request(
                    "POST",
                    f"/v1/transmissions/{transmission}",
                    content=bytes(body),
                    headers={"Content-Type": MEDIA_TYPE, ATTEMPT_HEADER: str(attempt)},
                    params=dict(network),
                    timeout=httpx.Timeout(READ_TIMEOUT + 8 * len(body) / SLOWEST_LINK, connect=CONNECT_TIMEOUT),
                )
                try:
                    receipt = Receipt.model_validate_json(answer.content)
                except ValidationError as error:
                    raise LinkError(f"{self.http.base_url} did not answer with a receipt; is it a receiver?") from error
                body.clear()
        if receipt is None:
            raise ParameterError("there is no packet to send")
        return receipt

    async def surface(self, transmission: str) -> dict[str, Any]:
        """What the receiver says of a surface: state, region, counts, network."""
        answer = await self._request("GET", f"/v1/surfaces/{transmission}")
        try:
            description = answer.json()
        except ValueError as error:
            raise LinkError(f"{self.http.base_url} did not answer with JSON; is it a receiver?") from error
        if not isinstance(description, dict) or "state" not in description:
            raise LinkError(f"{self.http.base_url} did not describe a surface; is it a receiver?")
        return description

    async def wait_ready(self, transmission: str, *, timeout: float = 600.0) -> dict[str, Any]:
        """Wait until a surface is trained, asking again and again.

        Raises
        ------
        TrainingError
            If the training failed, or nothing arrived that could be trained on.
        LinkError
            If it takes longer than about `timeout` seconds.
        """
        for _ in range(max(1, round(timeout / POLL))):
            surface = await self.surface(transmission)
            match surface["state"]:
                case "ready":
                    return surface
                case "failed":
                    problem = surface.get("error") or {}
                    raise TrainingError(problem.get("detail") or f"the receiver could not train {transmission}")
                case "receiving":
                    raise TrainingError(f"nothing of {transmission} reached the receiver; send it again")
            await self.sleep(POLL)
        raise LinkError(f"{transmission} was not ready after {timeout:g} seconds")

    async def grid(self, transmission: str, shape: tuple[int, int]) -> HeightGrid:
        """The reconstructed heights over the region of the surface, on `shape` (rows, columns)."""
        surface = await self.surface(transmission)
        path = f"/v1/surfaces/{transmission}/grid"
        z = await self._array(path, {"shape": f"{shape[0]},{shape[1]}", "f": "npy"})
        try:
            region, units = Region(**surface["region"]), Units(**surface["units"])
        except (TypeError, KeyError) as error:
            raise LinkError(f"{self.http.base_url} did not describe a surface; is it a receiver?") from error
        return HeightGrid(*region.axes(shape), z, units)

    async def features(self, transmission: str) -> FloatArray:
        """The feature points that arrived, shape (n, 3)."""
        return await self._array(f"/v1/surfaces/{transmission}/features", {"f": "npy"})

    async def centers(self, transmission: str) -> FloatArray:
        """The centres of the trained network, shape (m, 2) or, autoassociative, (m, 3)."""
        return await self._array(f"/v1/surfaces/{transmission}/network", {"f": "npy"})

    async def _array(self, path: str, params: Mapping[str, str]) -> FloatArray:
        answer = await self._request("GET", path, params=params)
        try:
            return np.asarray(np.load(io.BytesIO(answer.content), allow_pickle=False), dtype=np.float64)
        except (ValueError, EOFError) as error:
            raise LinkError(f"{answer.request.url} did not answer with an array; is it a receiver?") from error

    async def alive(self) -> bool:
        """Whether the receiver answers at all; one try."""
        try:
            return (await self.http.get("/health/live")).is_success
        except httpx.TransportError:
            return False

    async def set_channel(self, spec: str, seed: int | None = None) -> None:
        """Put a channel in force at the receiver, where its settings allow that; a seed may also stand in `spec`."""
        await self._request("PUT", "/v1/channel", json={"spec": spec} | ({} if seed is None else {"seed": seed}))

    async def delete(self, transmission: str) -> None:
        """Remove a surface and all that was received of it."""
        await self._request("DELETE", f"/v1/surfaces/{transmission}")

    async def _answer(self, method: str, path: str, **options: Any) -> httpx.Response:
        """The answer to one request, however long it takes as long as the receiver is alive.

        A link that takes its time, simulated or real, is silent once the body is out, and so is a receiver that hangs.
        Only another question tells them apart.
        """
        answer: httpx.Response | httpx.HTTPError | SurfacelinkError = LinkError(
            f"the receiver at {self.http.base_url} hangs: it took a request and answers no other; start it again"
        )
        async with anyio.create_task_group() as group:
            group.start_soon(self._watch, group.cancel_scope)
            try:
                answer = await self.http.request(method, path, **options)
            except (httpx.HTTPError, SurfacelinkError) as error:
                answer = error  # raised here, it would come out wrapped in a group
            group.cancel_scope.cancel()
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def _watch(self, scope: anyio.CancelScope) -> None:
        """Cancel `scope` once the receiver owes `PROBES` signs of life."""
        owed = 0
        while owed < PROBES:
            await self.tick(READ_TIMEOUT)
            try:
                sign = await self.http.get("/health/live", timeout=READ_TIMEOUT)
                owed = owed + 1 if sign.is_server_error else 0
            except httpx.HTTPError:
                owed += 1
        scope.cancel()

    async def _request(self, method: str, path: str, **options: Any) -> httpx.Response:
        for failures in range(1, self.retry.tries + 1):
            last = failures == self.retry.tries
            try:
                answer = await self._answer(method, path, **options)
            except httpx.TransportError as error:
                if last:
                    raise LinkError(
                        f"the receiver at {self.http.base_url} does not answer ({_reason(error)}); {_advice(error)}"
                    ) from error
                await self.sleep(self.retry.pause(failures, self.rng))
                continue
            if answer.is_success:
                return answer
            if last or answer.status_code not in RETRY_STATUS:
                raise _problem(answer)
            await self.sleep(_retry_after(answer) or self.retry.pause(failures, self.rng))
        raise ParameterError(f"tries must be 1 or more, got {self.retry.tries}")


def _reason(error: httpx.TransportError) -> str:
    return str(error) or type(error).__name__


def _advice(error: httpx.TransportError) -> str:
    if isinstance(error, httpx.ReadTimeout):
        return f"it is busy, or the link slower than {SLOWEST_LINK:g} bit/s: what was sent may still arrive, look later"
    if "[SSL" in str(error):
        return "it speaks no https there, or its certificate is not trusted; receiver serve speaks http://"
    return "start it with: receiver serve"


def _retry_after(answer: httpx.Response) -> float | None:
    value = answer.headers.get("Retry-After", "")
    return min(float(value), 60.0) if value.isdecimal() else None


def _problem(answer: httpx.Response) -> SurfacelinkError:
    try:
        problem = answer.json()
        said = problem.get("detail") or problem["title"]
    except (ValueError, KeyError, AttributeError):
        return LinkError(
            f"{answer.request.url} answered {answer.status_code} {answer.reason_phrase}; is it a receiver?"
        )
    if answer.status_code == NotFoundError.status:
        return NotFoundError(said)
    return RefusedError(f"the receiver answered {answer.status_code}: {said}", answer.status_code)
