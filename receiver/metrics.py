"""What a receiver counts, in a registry of its own, for Prometheus."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Literal

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from common.messages import Delivery

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "PATCH"})
"""Counted by name; whatever else a client makes up is "other"."""


class Metrics:
    """Counters of one receiver."""

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "receiver_requests", "HTTP requests answered.", ["method", "route", "status"], registry=self._registry
        )
        self._seconds = Histogram(
            "receiver_request_seconds", "Seconds until an answer began.", ["route"], registry=self._registry
        )
        self._packets = Counter(
            "receiver_packets", "Packets that arrived, by what became of them.", ["fate"], registry=self._registry
        )
        self._trainings = Counter(
            "receiver_trainings", "Trainings that ended, by their outcome.", ["outcome"], registry=self._registry
        )
        self._training_seconds = Histogram(
            "receiver_training_seconds",
            "Seconds a training took, called off or not.",
            buckets=(0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100, 300),
            registry=self._registry,
        )
        self._surfaces = Gauge("receiver_surfaces", "Surfaces that are kept.", registry=self._registry)
        self._running = Gauge("receiver_trainings_running", "Trainings queued or running.", registry=self._registry)

    def packets(self, delivery: Delivery) -> None:
        """Count the packets of one body."""
        for fate, number in delivery.model_dump().items():
            self._packets.labels(fate).inc(number)

    def trained(self, outcome: Literal["ready", "failed"]) -> None:
        """Count a training that ended."""
        self._trainings.labels(outcome).inc()

    def training(self) -> AbstractContextManager[object]:
        """Measure a training, for as long as the context is open."""
        return self._training_seconds.time()

    def request(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count an answer."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(route).observe(seconds)

    def text(self, *, surfaces: int, running: int) -> bytes:
        """All of it in Prometheus' text format."""
        self._surfaces.set(surfaces)
        self._running.set(running)
        return generate_latest(self._registry)


class CountRequests:
    """ASGI middleware that counts answers by route, not by path, so that no client can add a series."""

    def __init__(self, app: ASGIApp, metrics: Metrics, clock: Callable[[], float] = time.perf_counter) -> None:
        self.app = app
        self.metrics = metrics
        self.clock = clock

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        start = self.clock()

        async def counted(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = getattr(scope.get("route"), "path", "none")
                method = scope["method"] if scope["method"] in METHODS else "other"
                self.metrics.request(method, route, message["status"], self.clock() - start)
            await send(message)

        await self.app(scope, receive, counted)
