"""The receiver's answers in JSON: one declaration is the answer, its check and its documentation."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from common import messages
from common.messages import Delivery, PacketCounts, State
from common.problems import Problem
from common.surface import Region, Units
from receiver.store import Row


class Answer(BaseModel):
    """Root of the answers."""

    model_config = ConfigDict(frozen=True)


class RegionInfo(Answer):
    """The rectangle that a surface is defined on, in the units of x and y."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    @classmethod
    def of(cls, region: Region) -> RegionInfo:
        """From the data type."""
        return cls(**asdict(region))


class UnitsInfo(Answer):
    """Units of the coordinates; "" is none."""

    xy: str = Field(description="Of x and y.")
    z: str = Field(description="Of the heights.")

    @classmethod
    def of(cls, units: Units) -> UnitsInfo:
        """From the data type."""
        return cls(**asdict(units))


class Contents(Answer):
    """What has arrived of a surface."""

    region: RegionInfo | None = None
    units: UnitsInfo | None = None
    gap: float | None = None
    kind: str | None = None
    points: int = 0
    complete: bool = False
    packets: PacketCounts


class Progress(Answer):
    """How far the training is."""

    stage: str = Field(description="What is being done.", examples=["selection"])
    fraction: float = Field(description="How much of the stage is done, 0 to 1.", ge=0, le=1)


class Links(Answer):
    """Where to go from here."""

    surface: str
    grid: str
    features: str
    network: str
    events: str

    @classmethod
    def of(cls, name: str) -> Links:
        """The addresses of surface `name`."""
        base = f"/v1/surfaces/{name}"
        return cls(
            surface=base,
            grid=f"{base}/grid",
            features=f"{base}/features",
            network=f"{base}/network",
            events=f"{base}/events",
        )


class Receipt(messages.Receipt):
    """The answer to a transmission."""

    delivery: Delivery = Field(description="What the POST brought.")
    links: Links


class SurfaceInfo(Answer):
    """A surface, as far as it has arrived and been trained."""

    id: str
    state: State = Field(
        description="receiving: no point yet; training; ready: the network knows all that arrived; failed: see `error`."
    )
    created: str = Field(description="When the first packet arrived (ISO 8601, UTC).")
    updated: str = Field(description="When the surface last changed (ISO 8601, UTC).")
    region: RegionInfo | None
    units: UnitsInfo | None
    gap: float | None = Field(description="Segment gap, in the units of x and y.")
    kind: str | None = Field(description="How the feature points were chosen.")
    points: int = Field(description="Feature points that are here.")
    complete: bool = Field(description="Whether no packet is missing.")
    packets: PacketCounts
    settings: dict[str, Any] = Field(description="Settings of the network that were given.")
    progress: Progress | None = Field(description="How far the training is, while there is one.")
    network: dict[str, Any] | None = Field(description="The network, once it is ready.")
    error: Problem | None = Field(
        description="Why the training failed, could not be resumed after a start, or what came of it not be stored."
    )
    links: Links


class SurfaceList(Answer):
    """Surfaces, the latest first."""

    surfaces: list[SurfaceInfo]
    next: str | None = Field(description="Where the list goes on, null at its end.")


class ChannelInfo(Answer):
    """The channel in force in front of the receiver."""

    impairments: list[dict[str, Any]] = Field(examples=[[{"kind": "gaussian", "std": 0.1}]])
    seed: int
    spec: str = Field(description="The same as a short string.", examples=["gaussian:std=0.1"])
    control: bool = Field(description="Whether PUT may change it.")


class Health(Answer):
    """A probe's answer."""

    status: Literal["ok"] = "ok"


def state_of(row: Row) -> State:
    """Where the surface of `row` is on its way."""
    if row.revision == 0:
        return "receiving"
    if row.trained == row.revision:
        return "ready"
    return "failed" if row.failed == row.revision else "training"


def surface_info(row: Row, progress: Progress | None) -> SurfaceInfo:
    """What is told of the surface of `row`."""
    contents = Contents.model_validate(row.contents)
    state = state_of(row)
    return SurfaceInfo(
        id=row.id,
        state=state,
        created=row.created,
        updated=row.updated,
        **dict(contents),
        settings=row.settings,
        progress=progress if state == "training" else None,
        network=row.summary if state == "ready" else None,
        error=Problem.model_validate(row.error) if state == "failed" else None,
        links=Links.of(row.id),
    )
