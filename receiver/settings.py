"""What the receiver can be told from outside: `RECEIVER_` in the environment, or the command line."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Settings of a receiver; each field is read from ``RECEIVER_<NAME>`` unless it is given."""

    model_config = SettingsConfigDict(env_prefix="RECEIVER_", frozen=True, extra="forbid")

    host: Annotated[str, Field(min_length=1, description="Address to listen on.")] = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65_535, description="Port to listen on; 0 takes a free one.")] = 8001
    data: Annotated[
        Path,
        Field(
            description="Folder that keeps what was received and trained, and 4 MiB more for deletions on a full disk."
        ),
    ] = Path("surfacelink-data")
    channel: Annotated[
        str, Field(description='The channel in front of the receiver, such as "gaussian:std=0.1;erasure:p=0.05".')
    ] = "clean"
    seed: Annotated[int, Field(ge=0, lt=2**63, description="Seed of the channel's random draws.")] = 0
    channel_control: Annotated[bool, Field(description="Whether PUT /v1/channel may change the channel.")] = False
    trainings: Annotated[int, Field(ge=1, le=64, description="Networks that are trained at the same time.")] = 1
    renderings: Annotated[int, Field(ge=1, le=64, description="Grids that are computed at the same time.")] = 2
    max_body_bytes: Annotated[
        int, Field(ge=1_024, le=2**30, description="Largest body accepted, in bytes; larger ones are a 413.")
    ] = 64 * 2**20
    max_grid_cells: Annotated[
        int, Field(ge=1, le=64_000_000, description="Most cells of one height grid; larger ones are a 422.")
    ] = 4_000_000
    max_std_cells: Annotated[
        int, Field(ge=1, le=4_000_000, description="The same for a grid with standard deviations, which cost far more.")
    ] = 100_000
    max_wait_seconds: Annotated[
        float, Field(ge=0, le=3_600, description="Longest ?wait=, in seconds; larger ones are a 422.")
    ] = 300.0
    cached_models: Annotated[
        int, Field(ge=1, le=4_096, description="Trained networks that are kept in memory; the others are on disk.")
    ] = 16
