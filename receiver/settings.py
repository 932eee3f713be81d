"""What the receiver can be told from outside: `RECEIVER_` in the environment, or the command line."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """Settings of a receiver; each field is read from ``RECEIVER_<NAME>`` unless it is given."""

    model_config = SettingsConfigDict(env_prefix="RECEIVER_", frozen=True, extra="forbid")

    host: str = Field("127.0.0.1", min_length=1, description="Address to listen on.")
    port: int = Field(8001, ge=0, le=65_535, description="Port to listen on; 0 takes a free one.")
    data: Path = Field(
        Path("surfacelink-data"),
        description="Folder that keeps what was received and trained, and 4 MiB more for deletions on a full disk.",
    )
    channel: str = Field(
        "clean", description='The channel in front of the receiver, such as "gaussian:std=0.1;erasure:p=0.05".'
    )
    seed: int = Field(0, ge=0, lt=2**63, description="Seed of the channel's random draws.")
    channel_control: bool = Field(False, description="Whether PUT /v1/channel may change the channel.")
    trainings: int = Field(1, ge=1, le=64, description="Networks that are trained at the same time.")
    renderings: int = Field(2, ge=1, le=64, description="Grids that are computed at the same time.")
    max_body_bytes: int = Field(
        64 << 20, ge=1_024, le=1 << 30, description="Largest body accepted, in bytes; larger ones are a 413."
    )
    max_grid_cells: int = Field(
        4_000_000, ge=1, le=64_000_000, description="Most cells of one height grid; larger ones are a 422."
    )
    max_std_cells: int = Field(
        100_000,
        ge=1,
        le=4_000_000,
        description="The same for a grid with standard deviations, which cost far more.",
    )
    max_wait_seconds: float = Field(
        300.0, ge=0, le=3_600, description="Longest ?wait=, in seconds; larger ones are a 422."
    )
    cached_models: int = Field(
        16, ge=1, le=4_096, description="Trained networks that are kept in memory; the others are on disk."
    )
