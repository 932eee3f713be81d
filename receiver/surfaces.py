"""What the receiver does: take packets in, keep them, train, and answer with what came of it. Knows no HTTP."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Hashable
from contextlib import asynccontextmanager
from dataclasses import replace
from functools import partial
from hashlib import sha256
from typing import Any, Generic, Self, TypeAlias, TypeVar
from weakref import WeakValueDictionary

import anyio
from anyio.to_thread import run_sync as run_in_thread

from common.errors import (
    ConflictError,
    NotReadyError,
    PacketError,
    StoreError,
    SurfacelinkError,
    VersionError,
    WireError,
)
from common.messages import Delivery, PacketCounts, PacketsNamed
from common.network.model import NetworkSettings, SurfaceModel
from common.problems import problem_of
from common.surface import FeatureSet
from common.wire import PacketDecoder, Reassembly, split, transmission_tag
from common.wire.packet import Packet, write_datagrams
from receiver import schemas
from receiver.events import Changes
from receiver.metrics import Metrics
from receiver.store import Row, Store
from receiver.training import STORING, Trainings

MISSING_NAMED = 1_000
"""Missing packets that a receipt names even if fewer have arrived: how many there are is but what a packet claims."""

logger = logging.getLogger(__name__)

Train: TypeAlias = Callable[..., SurfaceModel]
"""`SurfaceModel.train`, or what stands in for it: (features, settings, *, callback) -> SurfaceModel."""

Value = TypeVar("Value")


class _Recent(Generic[Value]):
    """The values that were used last, up to `size` of them."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._values: OrderedDict[Hashable, Value] = OrderedDict()

    def get(self, key: Hashable) -> Value | None:
        if key in self._values:
            self._values.move_to_end(key)
        return self._values.get(key)

    def put(self, key: Hashable, value: Value) -> None:
        self._values[key] = value
        self._values.move_to_end(key)
        while len(self._values) > self._size:
            self._values.popitem(last=False)

    def drop(self, key: Hashable) -> None:
        self._values.pop(key, None)


class StillTraining(NotReadyError):  # noqa: N818 - a state that passes, not a fault
    """The surface has no result yet, and will have one without being asked again."""

    retry_after = 1

    def __init__(self, name: str) -> None:
        super().__init__(f"{name} is being trained; ask again, or add ?wait=60 to wait for it")


class WrittenByNewer(StoreError):  # noqa: N818 - what is kept is sound
    """What is kept of the surface is written in a way that only a newer surfacelink reads."""

    def __init__(self, name: str, error: VersionError) -> None:
        super().__init__(
            f"what is kept of {name} needs a newer surfacelink ({error}): start that, or remove the surface "
            f"(DELETE /v1/surfaces/{name}) and send it again"
        )


class Harmed(StoreError):  # noqa: N818 - of what is kept
    """What is kept of the surface is not what was acknowledged."""

    def __init__(self, name: str) -> None:
        super().__init__(f"what is kept of {name} cannot be read whole; send its packets again")


class Surfaces:
    """The surfaces of a receiver.

    For one event loop. Work that takes time runs in threads; bodies of one surface are taken in one after the other.
    Make it with `open`.
    """

    def __init__(
        self, store: Store, trainings: Trainings, changes: Changes, metrics: Metrics, cached: int, train: Train
    ) -> None:
        self.store = store
        self.trainings = trainings
        self.changes = changes
        self.metrics = metrics
        self._train = train
        self._locks: WeakValueDictionary[str, anyio.Lock] = WeakValueDictionary()
        self._reassemblies: _Recent[Reassembly] = _Recent(cached)
        self._models: _Recent[SurfaceModel] = _Recent(cached)
        self._unkept: dict[tuple[int, int], dict[str, Any]] = {}
        """Why a surface's revision failed, where that is not on disk: its training could not be resumed, or what came
        of it not be stored. The next start tries again, and so does the next body."""

    @classmethod
    @asynccontextmanager
    async def open(
        cls,
        store: Store,
        *,
        trainings: int,
        cached: int,
        metrics: Metrics,
        train: Train = SurfaceModel.train,
    ) -> AsyncIterator[Self]:
        """The surfaces in `store`; what was not trained to its end is started again."""
        changes = Changes()
        async with anyio.create_task_group() as group:
            jobs = Trainings(group, trainings, changes.publish)
            surfaces = cls(store, jobs, changes, metrics, cached, train)
            for row in await run_in_thread(store.untrained):
                group.start_soon(surfaces._resume, row.id)
            try:
                yield surfaces
            finally:
                changes.close()
                jobs.cancel_all()
                group.cancel_scope.cancel()

    def _lock(self, name: str) -> anyio.Lock:
        return self._locks.setdefault(name, anyio.Lock())

    # Taking in

    async def receive(self, name: str, body: bytes, network: dict[str, Any], *, sent: bytes | None) -> schemas.Receipt:
        """Take in a body of packets of the surface `name`, and train if it brought something new.

        Parameters
        ----------
        name : str
        body : bytes
        network : dict
            Settings of the network that were given; those given earlier hold on.
        sent : bytes or None
            The body as it was before the channel, of which nothing may be left; None where that is not known.

        Raises
        ------
        PacketError
            If the body held no packet when it was sent.
        ConflictError
            If its packets belong to another transmission, or to other features under the same name.
        LimitError
            If it holds more than the wire's limits allow.
        StoreError
            If it cannot be stored, or what is kept of the surface not be read.
        """
        async with self._lock(name):
            try:
                row, delivery, features, missing = await run_in_thread(self._take_in, name, body, network, sent)
            except BaseException:
                # The packets may be in the reassembly and not on disk.
                self._reassemblies.drop(name)
                raise
            self.metrics.packets(delivery)
            if features is not None:
                self._start(row, features)
            self.changes.publish(name)
        contents = schemas.Contents.model_validate(row.contents)
        return schemas.Receipt(
            id=name,
            state=schemas.state_of(self._now(row)),
            packets=PacketsNamed(**dict(contents.packets), missing=missing),
            points=contents.points,
            complete=contents.complete,
            delivery=delivery,
            links=schemas.Links.of(name),
        )

    def _take_in(
        self, name: str, body: bytes, network: dict[str, Any], sent: bytes | None
    ) -> tuple[Row, Delivery, FeatureSet | None, list[int]]:
        """Blocks. The features are those to train on, None where nothing is new or is being trained already; last are
        missing packets."""
        idle = self.trainings.get(name) is None
        decoder = PacketDecoder()
        packets = [*decoder.feed(body), *decoder.close()]
        if not packets and sent is not None and not _framed(sent):
            raise PacketError("the body holds no packet; accepted is a run of packets as docs/wire.md specifies them")
        tag = transmission_tag(name)
        row, reassembly = self._reassembly(name)
        fates: dict[str, int] = {"new": 0, "duplicate": 0, "foreign": 0}
        fresh: list[Packet] = []
        for packet in packets:
            try:
                fate = reassembly.add(packet)
            except ConflictError as error:
                raise ConflictError(
                    f"{error}; this id is taken by an earlier transmission: take another id, or remove it first "
                    f"(DELETE /v1/surfaces/{name})"
                ) from error
            fates[fate] += 1
            if fate == "new":
                fresh.append(packet)
        if packets and fates["foreign"] == len(packets):
            raise ConflictError("the packets belong to another transmission; post them under the id they were made for")
        delivery = Delivery(damaged=decoder.damaged, **fates)
        features = reassembly.features() if reassembly.points else None
        digest = _digest(features)
        changed = digest != (row.features if row else None)
        # A copy of a packet that is here already can be the better one and replace it.
        kept = [packet for packet in packets if packet.tag == tag] if changed else fresh
        before = row.settings if row else {}
        settings = before | network
        renew = features is not None and (changed or NetworkSettings(**settings) != NetworkSettings(**before))
        row = self.store.receive(
            name,
            b"".join(_datagram(packet) for packet in kept),
            features=digest,
            settings=settings,
            contents=_contents(reassembly, features, row, delivery).model_dump(),
            renew=renew,
        )
        self._reassemblies.put(name, reassembly)
        # What could not be resumed after a start, or not be stored, gets another chance.
        again = idle or (row.n, row.revision) in self._unkept
        training = renew or (again and schemas.state_of(row) == "training")
        missing = reassembly.missing[: max(MISSING_NAMED, reassembly.received)]
        return row, delivery, features if training else None, list(missing)

    def _reassembly(self, name: str) -> tuple[Row | None, Reassembly]:
        """What has arrived of `name`, from memory or from disk."""
        row = self.store.find(name)
        if row is None:
            return None, Reassembly(name)
        reassembly = self._reassemblies.get(name)
        if reassembly is None:
            reassembly = Reassembly(name)
            for arrival in self.store.arrivals(row.n):
                decoder = PacketDecoder()
                try:
                    packets = [*decoder.feed(arrival), *decoder.close()]
                except VersionError as error:
                    raise WrittenByNewer(name, error) from error
                for packet in packets:
                    reassembly.add(packet)
        return row, reassembly

    # Training

    def _start(self, row: Row, features: FeatureSet) -> None:
        self._unkept.pop((row.n, row.revision), None)

        def work(callback: Callable[[str, float], None]) -> SurfaceModel:
            with self.metrics.training():
                return self._train(features, NetworkSettings(**row.settings), callback=callback)

        self.trainings.start(row.id, work, partial(self._finish, row))

    async def _resume(self, name: str) -> None:
        """Train what is here of `name`, unless that is done or under way; where it cannot be read, say so."""
        async with self._lock(name):
            row = None
            try:
                row = await run_in_thread(self.store.find, name)
                if row is not None and schemas.state_of(row) == "training" and self.trainings.get(name) is None:
                    _, reassembly = await run_in_thread(self._reassembly, name)
                    self._start(row, await run_in_thread(_acknowledged, row, reassembly))
            except SurfacelinkError as error:
                logger.exception("training of %s could not be resumed", name)
                if row is not None:
                    failure = StoreError(f"what was kept of {name} cannot be read: {error}; send its packets again")
                    if isinstance(error, (Harmed, WrittenByNewer)):
                        failure = error
                    self._unkept[row.n, row.revision] = problem_of(failure).model_dump(exclude_none=True)
                    self.changes.publish(name)

    async def _finish(self, row: Row, outcome: SurfaceModel | SurfacelinkError) -> None:
        job = self.trainings.get(row.id)
        failure = outcome if isinstance(outcome, SurfacelinkError) else None
        try:
            await run_in_thread(self._keep, row, outcome)
        except StoreError as error:
            # One failure may pass; who waits for the surface is told of the second.
            if job is not None and job.stage == STORING and self.trainings.get(row.id) is job:
                told = failure or _unstored(row.id, error)
                self._unkept[row.n, row.revision] = problem_of(told).model_dump(exclude_none=True)
            raise
        self._unkept.pop((row.n, row.revision), None)
        self.metrics.trained("failed" if failure else "ready")

    def _keep(self, row: Row, outcome: SurfaceModel | SurfacelinkError) -> None:
        if isinstance(outcome, SurfacelinkError):
            self.store.failed(row.n, row.revision, problem_of(outcome).model_dump(exclude_none=True))
            return
        digest = self.store.trained(row.n, row.revision, state=outcome.to_state(), summary=outcome.summary())
        self._models.put(digest, outcome)

    # Answering

    def _now(self, row: Row) -> Row:
        """`row` with what the store does not know of it."""
        problem = self._unkept.get((row.n, row.revision))
        return row if problem is None else replace(row, failed=row.revision, error=problem)

    def _progress(self, name: str) -> schemas.Progress | None:
        job = self.trainings.get(name)
        return None if job is None else schemas.Progress(stage=job.stage, fraction=job.fraction)

    def _info(self, row: Row) -> schemas.SurfaceInfo:
        return schemas.surface_info(self._now(row), self._progress(row.id))

    async def info(self, name: str) -> schemas.SurfaceInfo:
        """What is known of `name`; raises NotFoundError."""
        return self._info(await run_in_thread(self.store.get, name))

    async def list(self, *, before: int | None, limit: int) -> schemas.SurfaceList:
        """At most `limit` surfaces, the latest first."""
        rows = await run_in_thread(partial(self.store.latest, before=before, limit=limit + 1))
        more = len(rows) > limit
        return schemas.SurfaceList(
            surfaces=[self._info(row) for row in rows[:limit]],
            next=f"/v1/surfaces?before={rows[limit - 1].n}&limit={limit}" if more else None,
        )

    async def settle(self, name: str, seconds: float) -> Row:
        """`name` once it is ready or failed, or after `seconds` as it is then; raises NotFoundError."""
        with self.changes.subscribe(name) as subscription:
            row = self._now(await run_in_thread(self.store.get, name))
            with anyio.move_on_after(seconds):
                while schemas.state_of(row) not in ("ready", "failed") and await subscription.next() is not None:
                    row = self._now(await run_in_thread(self.store.get, name))
        return row

    async def model(self, name: str, wait: float = 0.0) -> tuple[Row, SurfaceModel]:
        """The trained model of `name`.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        NotReadyError
            If it is not ready after `wait` seconds; says why.
        """
        row = await self.settle(name, wait)
        match schemas.state_of(row):
            case "receiving":
                raise NotReadyError(f"no point of {name} has arrived yet; POST /v1/transmissions/{name} sends some")
            case "training":
                raise StillTraining(name)
            case "failed":
                reason = (row.error or {}).get("detail", "see its error")
                raise NotReadyError(f"{name} could not be trained: {reason}")
        return row, await self._load(row)

    async def _load(self, row: Row) -> SurfaceModel:
        """The very model that `row` names by its digest; raises StillTraining where that is no longer to be had."""
        digest = row.digest or ""
        model = self._models.get(digest)
        if model is not None:
            return model
        try:
            model = await run_in_thread(self._revive, row.n, digest)
        except (SurfacelinkError, KeyError, ValueError, TypeError) as error:
            # Written by another version, or harmed on disk: what it was trained on is still there.
            logger.warning("the model of %s cannot be read and is trained again: %r", row.id, error)
            await run_in_thread(self.store.forget_model, row.n, digest)
            await self._resume(row.id)
            raise StillTraining(row.id) from error
        if model is None:
            # A later revision arrived after the row was read.
            raise StillTraining(row.id)
        self._models.put(digest, model)
        return model

    def _revive(self, n: int, digest: str) -> SurfaceModel | None:
        state = self.store.model(n, digest)
        return None if state is None else SurfaceModel.from_state(state)

    async def features(self, name: str) -> tuple[Row, FeatureSet]:
        """What has arrived of `name`; raises NotFoundError, NotReadyError while there is no point, and StoreError where
        it was harmed on disk."""
        async with self._lock(name):
            await run_in_thread(self.store.get, name)
            row, reassembly = await run_in_thread(self._reassembly, name)
            if row is None:
                raise StoreError("the surface is gone")
            return row, await run_in_thread(_acknowledged, row, reassembly)

    async def delete(self, name: str) -> None:
        """Remove `name` and all that belongs to it; its training is called off. Raises NotFoundError."""
        async with self._lock(name):
            row = await run_in_thread(self.store.delete, name)
            self.trainings.cancel(name)
            self._unkept.pop((row.n, row.revision), None)
            self._reassemblies.drop(name)
            self._models.drop(row.digest)
        self.changes.publish(name)


def _unstored(name: str, error: StoreError) -> StoreError:
    return StoreError(
        f"{name} was trained, and its network could not be stored: {error}; it will be, within a minute of there being "
        "room"
    )


def _digest(features: FeatureSet | None) -> str | None:
    return None if features is None else sha256(features.points.tobytes()).hexdigest()


def _acknowledged(row: Row, reassembly: Reassembly) -> FeatureSet:
    """The features that are here; raises NotReadyError where none arrived, Harmed where others did."""
    features = reassembly.features() if reassembly.points or row.features is None else None
    if features is None or _digest(features) != row.features:
        raise Harmed(row.id)
    return features


def _framed(body: bytes) -> bool:
    """Whether `body` is a run of one packet or more, intact or not."""
    try:
        return bool(split(body))
    except WireError:
        return False


def _datagram(packet: Packet) -> bytes:
    """Bytes that decode to `packet`, without the inner code that brought it here."""
    return write_datagrams(packet.header, [packet.block], packet.number)[0]


def _contents(
    reassembly: Reassembly, features: FeatureSet | None, row: Row | None, delivery: Delivery
) -> schemas.Contents:
    """What is known of a surface by now."""
    before = schemas.Contents.model_validate(row.contents).packets if row else None
    packets = PacketCounts(
        received=reassembly.received,
        damaged=(before.damaged if before else 0) + delivery.damaged,
        duplicate=(before.duplicate if before else 0) + delivery.duplicate,
        foreign=(before.foreign if before else 0) + delivery.foreign,
        rebuilt=reassembly.rebuilt,
        total=reassembly.total,
    )
    if features is None:
        return schemas.Contents(packets=packets)
    return schemas.Contents(
        region=schemas.RegionInfo.of(features.region),
        units=schemas.UnitsInfo.of(features.units),
        gap=features.gap,
        kind=features.kind,
        points=len(features),
        complete=reassembly.complete,
        packets=packets,
    )
