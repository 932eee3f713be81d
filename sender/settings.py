"""Settings of the sender service, from the environment (``SENDER_...``) or the command line."""

from __future__ import annotations

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """What an operator can choose."""

    model_config = SettingsConfigDict(env_prefix="SENDER_", frozen=True, extra="forbid")

    host: str = Field("127.0.0.1", description="Address to listen on.")
    port: int = Field(8000, ge=0, le=65535, description="Port to listen on; 0 takes a free one.")
    receiver: str = Field("http://127.0.0.1:8001", description="URL of the receiver that everything is sent to.")
    max_upload_bytes: int = Field(
        64 << 20, ge=1024, le=1 << 30, description="Largest file that may be uploaded, in bytes."
    )
    max_points: int = Field(5_000_000, ge=3, description="Most points of a cloud that is drawn or uploaded.")
    kept: int = Field(1000, ge=1, description="Finished transmissions that are remembered; the oldest go first.")
