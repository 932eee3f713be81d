"""A campaign: which surfaces, features, wire settings, channels, methods and seeds are tried against each other.

A campaign is described by a small TOML file. It expands to *trials*: one transmission each, whose harmed features all
methods share. Everything here is data; `simulator.trial` runs one trial, `simulator.runner` runs them all.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self, TypeAlias

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator, model_validator

from common.channel import Channel, PointImpairment
from common.errors import FileFormatError, MissingExtraError, NotFoundError, ParameterError, hint
from common.problems import invalid_fields
from common.wire import WireOptions
from common.wire.limits import DEFAULT_DATAGRAM, MAX_DATAGRAM
from sender.features import Extracted
from sender.readers import NoData, file_bytes
from sender.surfaces import MOST_POINTS, find_surface
from simulator import fields
from simulator.codecs import find_codec
from simulator.codecs.protection import find_protection
from simulator.methods import parse_method

Axis: TypeAlias = Annotated[str, Field(min_length=1, max_length=40)]
"""What the levels of a channel mean; `simulator.report.AXES` are those that it draws and explains best."""

MAX_TRIALS = 1_000_000
"""A campaign beyond this is a slip of the pen: at 10 ms a trial it would take three hours a core."""


class Settings(BaseModel):
    """Frozen, and unknown keys are refused: a misspelt key must not silently mean its default."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class SurfaceChoice(Settings):
    """A surface by name, a field of `simulator.fields` (whose nodes are the cloud), or the points of a file.

    `points` and `pieces` (along the longer side) go in the place of the surface's own setting.

    The truth of a named surface is its formula or grid. The truth of a file is the piecewise linear surface through
    *all* of its points, so a file should be sampled more densely than its features.
    """

    name: str | None = None
    field: str | None = None
    file: Path | None = Field(default=None, exclude=True)
    columns: tuple[str, ...] | None = None
    no_data: NoData | None = Field(default=None, exclude=True, description="as the sender's; `content` stands for it")
    points: int | None = Field(default=None, ge=3, le=MOST_POINTS)
    pieces: int | None = Field(default=None, ge=1, le=4000)
    content: str | None = Field(default=None, description="digest of the file, filled in when it is read")

    @model_validator(mode="after")
    def _one_of(self) -> Self:
        if sum(value is not None for value in (self.name, self.field, self.file)) != 1:
            raise ValueError(
                "give one of name (of a surface), field (of 256 x 256 nodes) and file (of points; "
                "called by its own name)"
            )
        for key in ("columns", "no_data"):
            if getattr(self, key) is not None and self.file is None:
                raise ValueError(f"{key} belongs to a file")
        try:
            if self.name is not None:
                find_surface(self.name)
            elif self.field is not None:
                fields.field(self.field)
        except NotFoundError as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def label(self) -> str:
        """Name in the table."""
        return self.file.name if self.file is not None else self.name or str(self.field)


class FeatureSettings(Settings):
    """How the cloud is sampled and its features are chosen; what is left out is the surface's own setting.

    `kind`: least and greatest z of each piece; the height at its centre, position implied; every point.
    At most one of `gap` (side of a piece), `pieces` (pieces along the longer side of the region) and `budget` (the
    finest pieces whose packets, protection included, fit into that many bytes).
    """

    points: int | None = Field(default=None, ge=3, le=MOST_POINTS)
    kind: Extracted = "extrema"
    gap: float | None = Field(default=None, gt=0)
    pieces: int | None = Field(default=None, ge=1, le=4000)
    budget: int | None = Field(default=None, ge=64)

    @model_validator(mode="after")
    def _one_measure(self) -> Self:
        if sum(value is not None for value in (self.gap, self.pieces, self.budget)) > 1:
            raise ValueError("give at most one of gap, pieces and budget")
        return self

    @property
    def label(self) -> str:
        """What is sent, as the table says it: "features" and what is not the surface's own setting."""
        given = self.model_dump(exclude_defaults=True)
        return " ".join(["features", *(f"{name}={value}" for name, value in given.items())])


class CodecSettings(Settings):
    """What is sent instead of features: the grid of the comparison, by a raster codec, under a Reed-Solomon code.

    `budget` is in bytes, the code's own included; the codec's finest setting that fits is taken.
    """

    codec: str
    protection: str = "none"
    budget: int = Field(ge=16)
    datagram: int = Field(default=DEFAULT_DATAGRAM, ge=16, le=MAX_DATAGRAM)

    @model_validator(mode="after")
    def _exists(self) -> Self:
        try:
            find_codec(self.codec)
            find_protection(self.protection)
        except (NotFoundError, MissingExtraError) as error:
            raise ValueError(str(error)) from error
        return self

    @property
    def method(self) -> str:
        """Name in the table."""
        return self.codec if self.protection == "none" else f"{self.codec} {self.protection}"

    @property
    def label(self) -> str:
        """What is sent, as the table says it."""
        return f"raster budget={self.budget}"


class ChannelSweep(Settings):
    """A channel, or one channel for each of several levels.

    `spec` is a channel in its short form; ``{level}`` in it stands for the level, ``{z}`` for the level times the
    range of the surface's heights, ``{noise}`` for the level times the noise amplitude the surface is usually tried
    with.
    """

    spec: str
    axis: Axis = "channel"
    levels: tuple[float, ...] = Field(default=(), max_length=1000)

    @model_validator(mode="after")
    def _builds(self) -> Self:
        if ("{" in self.spec) != bool(self.levels):
            raise ValueError("levels and a {level}, {z} or {noise} in spec go together")
        for level in self.levels or (0.0,):
            text = self.at(level, extent=1.0, noise=1.0)
            if "{" in text or "}" in text:
                raise ValueError(f"{self.spec!r}: accepted in braces are {{level}}, {{z}}, {{noise}}")
            Channel.parse(text)
        return self

    def only(self, level: float | None) -> Self:
        """The channel at one level: a trial does not depend on what other levels a campaign has."""
        return self.model_copy(update={"levels": () if level is None else (level,)})

    @property
    def moves_points(self) -> bool:
        """Whether an impairment acts on coordinates, which a raster has none of."""
        level = self.levels[0] if self.levels else 0.0
        impairments = Channel.parse(self.at(level, extent=1.0, noise=1.0)).impairments
        return any(isinstance(impairment, PointImpairment) for impairment in impairments)

    def at(self, level: float, *, extent: float, noise: float) -> str:
        """The short form at one level, for a surface of that range of z and that usual noise."""
        values = {"{level}": level, "{z}": level * extent, "{noise}": level * noise}
        return re.sub(r"\{(level|z|noise)\}", lambda found: repr(values[found[0]]), self.spec)


def _as_table(key: str) -> BeforeValidator:
    def convert(value: object) -> object:
        return {key: value} if isinstance(value, str) else value

    return BeforeValidator(convert)


class Trial(Settings):
    """One transmission and all that is needed to redo it."""

    campaign: str
    surface: SurfaceChoice
    features: FeatureSettings
    wire: WireOptions
    rounds: int
    channel: ChannelSweep
    level: float | None
    methods: tuple[str, ...]
    codec: CodecSettings | None
    grid: tuple[int, int]
    seed: int
    sample: int
    cell: str = Field(default="", description="digest of what is sent first of the rivals of its cell")

    @property
    def key(self) -> str:
        """A digest of everything that determines the outcome; of a file, its name too, by which its cloud is drawn."""
        return _digest(f"{self.surface.label}\n{self.model_dump_json()}")

    @property
    def transmission(self) -> str:
        """Id of the transmission at a receiver, which takes what has one id for one cloud."""
        return f"{self.campaign}-{self.digest}-{self.sample}"

    @property
    def draws(self) -> str:
        """What the channel's draws follow from, beside the seed: one name for all that is sent in a cell."""
        return f"{self.campaign}-{self.cell or self.digest}-{self.sample}"

    @property
    def digest(self) -> str:
        """Stands for the transmission: everything but the sample and the methods, which share one, and the cell.

        The name of a file counts, since its cloud is drawn by it: a receiver takes what has one id for one cloud.
        """
        name = "" if self.surface.file is None else f"{self.surface.label}\n"
        return _digest(name + self.model_dump_json(exclude={"methods", "sample", "cell"}))[:10]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:24]


class Campaign(Settings):
    """A full factorial plan; every list is one factor.

    Parameters
    ----------
    surfaces : names of surfaces, or tables with `name` or `file`.
    features, wire : tables; left out, each surface's own settings and the wire's defaults.
    channels : channels in short form, or tables with `spec`, `axis` and `levels`.
    methods : names of reconstructions, see `simulator.methods`.
    codecs : tables with `codec`, `protection` and `budget`: rasters sent instead; channels that move points skip them.
    seeds : how many samples of each surface, numbered from 0.
    seed : the campaign's own seed, from which every random draw follows.
    grid : rows and columns of the grid the reconstruction is compared on.
    rounds : transmissions of what the receipt says is missing, the first included; 1 where there are codecs.
    name, title, lead, notes : words of the report. A note explains why the network does not win on a surface; its key
        is the surface's name, or "surface axis level" for a single cell.
    """

    name: str = Field(default="campaign", pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    title: str = Field(default="", max_length=200)
    lead: str = Field(default="", max_length=4000)
    notes: Mapping[str, str] = Field(default={})
    surfaces: tuple[Annotated[SurfaceChoice, _as_table("name")], ...] = Field(min_length=1)
    features: tuple[FeatureSettings, ...] = Field(default=(FeatureSettings(),), min_length=1)
    wire: tuple[WireOptions, ...] = Field(default=(WireOptions(),), min_length=1)
    channels: tuple[Annotated[ChannelSweep, _as_table("spec")], ...] = Field(min_length=1)
    methods: tuple[str, ...] = Field(default=("network",), min_length=1)
    codecs: tuple[CodecSettings, ...] = ()
    seeds: int = Field(default=10, ge=1, le=100_000)
    seed: int = Field(default=0, ge=0, lt=2**63)
    grid: tuple[int, int] = (64, 64)
    rounds: int = Field(default=1, ge=1, le=100)

    @field_validator("grid")
    @classmethod
    def _bounded(cls, grid: tuple[int, int]) -> tuple[int, int]:
        if not all(2 <= side <= 4096 for side in grid):
            raise ValueError("rows and columns must each be 2 to 4096")
        return grid

    @field_validator("methods")
    @classmethod
    def _known(cls, methods: tuple[str, ...]) -> tuple[str, ...]:
        for method in methods:
            parse_method(method)
        if len(set(methods)) < len(methods):
            raise ValueError("a method stands twice")
        return methods

    @model_validator(mode="after")
    def _bounded_size(self) -> Self:
        if self.size > MAX_TRIALS:
            raise ValueError(f"{self.size} trials; at most {MAX_TRIALS} are accepted")
        return self

    @model_validator(mode="after")
    def _sent_alike(self) -> Self:
        if self.codecs and self.rounds > 1:
            raise ValueError(
                "codecs are sent once, and features again would have more bytes: leave out rounds or codecs"
            )
        return self

    @model_validator(mode="after")
    def _told_apart(self) -> Self:
        channels = [
            f"{channel.axis} {level:g}" if level is not None else str(Channel.parse(channel.spec))
            for channel in self.channels
            for level in channel.levels or (None,)
        ]
        for called, names, instead in (
            ("surface", [surface.label for surface in self.surfaces], "vary points or pieces in features"),
            ("channel", channels, "give each an axis of its own"),
            (
                "codec",
                [f"{codec.method} {codec.label}" for codec in self.codecs],
                "its datagram does not tell it apart",
            ),
        ):
            if twice := next((name for name in names if names.count(name) > 1), None):
                raise ValueError(
                    f"the {called} {twice!r} stands twice, and tables and report would make one line of both: {instead}"
                )
        return self

    @property
    def size(self) -> int:
        """Number of trials."""
        return (
            self.seeds
            * len(self.surfaces)
            * sum(max(1, len(channel.levels)) * len(self._senders(channel)) for channel in self.channels)
        )

    def _senders(self, channel: ChannelSweep) -> list[dict[str, Any]]:
        """The fields of a Trial that say what is sent through `channel`."""
        features = [
            {"features": features, "wire": wire, "methods": self.methods, "codec": None}
            for features in self.features
            for wire in self.wire
        ]
        if channel.moves_points:
            return features
        blank = {"features": FeatureSettings(), "wire": WireOptions(), "methods": ()}
        return [*features, *(blank | {"codec": codec} for codec in self.codecs)]

    def trials(self) -> list[Trial]:
        """Every combination, in an order that does not depend on anything but the campaign."""

        def trial(surface: SurfaceChoice, channel: ChannelSweep, level: float | None, sender: dict[str, Any]) -> Trial:
            return Trial(
                campaign=self.name,
                surface=surface,
                rounds=self.rounds,
                channel=channel.only(level),
                level=level,
                grid=self.grid,
                seed=self.seed,
                sample=0,
                **sender,
            )

        return [
            rival.model_copy(update={"sample": sample, "cell": cell})
            for surface in self.surfaces
            for channel in self.channels
            for senders in [self._senders(channel)]
            for sender in senders
            for level in channel.levels or (None,)
            for cell in [trial(surface, channel, level, senders[0]).digest]
            for rival in [trial(surface, channel, level, sender)]
            for sample in range(self.seeds)
        ]

    @classmethod
    def load(cls, path: Path, overrides: Mapping[str, Any] | None = None) -> Self:
        """The campaign in a TOML file; paths of files in it are relative to it.

        Raises
        ------
        ParameterError
            If the file cannot be read, is not TOML, or a key is unknown or out of bounds; one line that names the
            key and says what is accepted.
        """
        try:
            plan = tomllib.loads(path.read_text("utf-8"))
        except OSError as error:
            raise ParameterError(f"cannot read {path}: {error.strerror or error}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ParameterError(f"{path} is not a TOML file: {error}") from error
        return cls.build(plan | dict(overrides or {}), source=path.name, folder=path.parent)

    @classmethod
    def build(cls, plan: Mapping[str, Any], *, source: str = "campaign", folder: Path = Path()) -> Self:
        """The campaign of a table of settings, files relative to `folder`; raises ParameterError as `load` does."""
        try:
            campaign = cls.model_validate(dict(plan))
        except ValidationError as error:
            raise ParameterError(f"{source}: {_first_problem(error)}") from error
        return campaign.model_copy(update={"surfaces": tuple(_read(choice, folder) for choice in campaign.surfaces)})


def _read(choice: SurfaceChoice, folder: Path) -> SurfaceChoice:
    """A file is known by its contents: moved, it gives the same trials; changed, others."""
    if choice.file is None:
        return choice
    path = folder / choice.file
    try:
        data = file_bytes(path)
    except FileFormatError as error:
        raise ParameterError(f"surfaces: {error}") from error
    reading = b"" if choice.no_data is None else f"no_data {choice.no_data}".encode()
    content = hashlib.sha256(data + reading).hexdigest()[:16]
    return choice.model_copy(update={"file": path, "content": content})


_TABLES: Mapping[str, type[BaseModel]] = {
    "surfaces": SurfaceChoice,
    "features": FeatureSettings,
    "wire": WireOptions,
    "channels": ChannelSweep,
    "codecs": CodecSettings,
}


def _first_problem(error: ValidationError) -> str:
    """The first problem as one line: the key, what is wrong with it, what is accepted."""
    first, *_ = errors = error.errors(include_url=False)
    field = invalid_fields([{**each, "loc": ("the file", *each["loc"])} for each in errors])[0]
    if first["type"] == "extra_forbidden":
        table = _TABLES.get(str(first["loc"][0]), Campaign) if len(first["loc"]) > 1 else Campaign
        return f"{field.name} is not a key{hint(str(first['loc'][-1])[:40], table.model_fields)}"
    if first["type"] == "missing":
        return f"{field.name} is missing; it is needed"
    return f"{field.name}: {' '.join(field.detail.split()).removeprefix('Input ')}"
