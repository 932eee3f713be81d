"""``simulate demo``: four surfaces over real HTTP, through a clean and through a noisy channel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import anyio
import httpx
import numpy as np

from common.errors import LinkError
from common.metrics import nrmse
from common.surface import FloatArray, HeightGrid
from sender.client import ReceiverClient
from sender.surfaces import Surface, find_surface
from simulator.baselines import reconstruct
from simulator.services import Services

DEMO_SURFACES = ("surface-1", "surface-2", "surface-3", "elevation")
SEED = 0
BYTES_OF_A_POINT = 24
"""Of the dense cloud, as plain float64."""


@dataclass(frozen=True)
class Arrived:
    """One transmission as the receiver holds it, and what other methods make of its points.

    Attributes
    ----------
    id, channel : str
        Of the surface at the receiver; in the short form.
    features : ndarray, shape (n, 3)
        The feature points that arrived.
    centers : ndarray, shape (m, 2)
        Of the network.
    sent_bytes : int
        Put on the air.
    grid : HeightGrid
        What the network made of the points.
    linear, cubic : ndarray, shape (rows, columns)
        What interpolation made of them, at the nodes of `grid`.
    seconds : float
        From the order to the grid.
    """

    id: str
    channel: str
    features: FloatArray
    centers: FloatArray
    sent_bytes: int
    grid: HeightGrid
    linear: FloatArray
    cubic: FloatArray
    seconds: float


@dataclass(frozen=True)
class Exhibit:
    """One surface, sent through the clean and through the noisy channel."""

    surface: Surface
    truth: HeightGrid
    clean: Arrived
    noisy: Arrived

    def row(self) -> dict[str, str | int | float]:
        """The figures of the table, by column."""
        row: dict[str, str | int | float] = {
            "surface": self.surface.name,
            "points": self.surface.points,
            "features": len(self.clean.features),
            "bytes sent": self.clean.sent_bytes,
            "dense bytes": self.surface.points * BYTES_OF_A_POINT,
        }
        for label, arrived in (("clean", self.clean), ("noisy", self.noisy)):
            for method, z in (("network", arrived.grid.z), ("linear", arrived.linear), ("cubic", arrived.cubic)):
                row[f"{label} {method}"] = nrmse(self.truth.z, z)
        row["seconds"] = self.clean.seconds + self.noisy.seconds
        return row


def paper_noise(surface: Surface) -> str:
    """The paper's noise as a channel: uniform, of the surface's amplitude, on all three coordinates."""
    return f"uniform:amplitude={surface.noise:.6g},axes=xyz"


async def run_demo(
    services: Services,
    names: tuple[str, ...] = DEMO_SURFACES,
    *,
    progress: Callable[[str], None] = lambda _stage: None,
) -> list[Exhibit]:
    """Send each surface through both channels and fetch what comes back.

    Parameters
    ----------
    services : Services
        A receiver that allows its channel to be set, and a sender that sends to it.
    names : tuple of str
        Surfaces by name.
    progress : callable
        Called with a line before each step; `steps` of them in all.

    Raises
    ------
    SurfacelinkError
        If a service refuses or does not answer.
    """
    exhibits = []
    async with (
        ReceiverClient.connect(services.receiver) as receiver,
        httpx.AsyncClient(base_url=services.sender, timeout=60, trust_env=False) as sender,
    ):
        for name in names:
            surface = find_surface(name)
            truth = surface.grid()
            arrived = []
            for label, channel in (("clean", "clean"), ("noisy", paper_noise(surface))):
                progress(f"{name}, {label} channel")
                arrived.append(await _transmit(receiver, sender, surface, truth, label, channel))
            exhibits.append(Exhibit(surface, truth, *arrived))
    return exhibits


def steps(names: tuple[str, ...] = DEMO_SURFACES) -> int:
    """How often `run_demo` reports progress."""
    return 2 * len(names)


async def _transmit(
    receiver: ReceiverClient,
    sender: httpx.AsyncClient,
    surface: Surface,
    truth: HeightGrid,
    label: str,
    channel: str,
) -> Arrived:
    transmission = f"{surface.name}-{label}"
    await receiver.set_channel(channel, seed=SEED)
    begin = time.monotonic()
    sent_bytes = await _ask_to_send(sender, {"surface": surface.name, "id": transmission, "seed": SEED})
    await receiver.wait_ready(transmission)
    grid = await receiver.grid(transmission, truth.shape)
    seconds = time.monotonic() - begin
    features = await receiver.features(transmission)
    linear, cubic = [
        await anyio.to_thread.run_sync(reconstruct, method, features, truth.x, truth.y, np.random.default_rng(SEED))
        for method in ("linear", "cubic")
    ]
    centers = await receiver.centers(transmission)
    return Arrived(transmission, channel, features, centers, sent_bytes, grid, linear, cubic, seconds)


async def _ask_to_send(sender: httpx.AsyncClient, order: dict[str, str | int]) -> int:
    """Have the sender service send; the bytes it put on the air."""
    answer = await sender.post("/v1/transmissions", json=order)
    if answer.status_code != httpx.codes.ACCEPTED:
        raise LinkError(f"the sender answered {answer.status_code}: {answer.text}")
    while (record := (await sender.get(answer.headers["Location"])).json())["state"] == "sending":
        await anyio.sleep(0.05)
    if record["state"] != "sent":
        raise LinkError(f"the sender failed: {record['error']['detail']}")
    return int(record["bytes"])
