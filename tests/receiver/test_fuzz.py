"""Whatever is asked: an answer that makes sense, or a problem; never a 500."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlencode

import httpx
import pytest
from anyio.from_thread import BlockingPortal, start_blocking_portal
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from common.surface import FeatureSet
from receiver.app import create_app
from receiver.settings import Settings
from tests.receiver.conftest import HEADERS, packets_of

pytestmark = pytest.mark.filterwarnings("ignore::common.network.estimator.NetworkWarning")

SPARSE = settings(deadline=None, max_examples=120, suppress_health_check=list(HealthCheck))

WORDS = st.one_of(
    st.text(max_size=12),
    st.floats().map(str),
    st.integers().map(str),
    st.sampled_from(
        [
            "",
            "nan",
            "inf",
            "-1",
            "1e999",
            "3,3",
            "0,0",
            "9" * 30,
            "true",
            "auto",
            "png",
            "tif",
            "csv",
            "json",
            "*",
            "0,0,1,1",
            "1,1,0,0",
            "nan,0,1,1",
            "٣,٣",
            "\x00",
            "1_0,2",
        ]
    ),
)
QUERIES = st.dictionaries(
    st.sampled_from(
        [
            "shape",
            "bbox",
            "f",
            "std",
            "wait",
            "palette",
            "shading",
            "colorbar",
            "limit",
            "before",
            "spread",
            "smoothing",
            "max_centers",
            "mapping",
            "tolerance",
        ]
    ),
    WORDS,
    max_size=4,
).map(lambda query: {name: "0" if name == "wait" and value == "true" else value for name, value in query.items()})
NAMES = st.one_of(st.just("hills"), WORDS)
PATHS = st.sampled_from(
    [
        "/v1/surfaces",
        "/v1/surfaces/{}",
        "/v1/surfaces/{}/grid",
        "/v1/surfaces/{}/features",
        "/v1/surfaces/{}/network",
        "/v1/channel",
        "/health/ready",
        "/metrics",
        "/problems/{}",
        "/",
        "/{}",
        "/v1/transmissions/{}",
    ]
)
ACCEPTS = st.one_of(
    st.sampled_from(["*/*", "image/png", "text/csv;q=0.1", "text/html", ";;q=,", "a/b;q=x"]),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
)


@dataclass
class Receiver:
    """An application whose event loop runs in another thread, as hypothesis calls functions and awaits nothing."""

    portal: BlockingPortal
    client: httpx.AsyncClient

    def request(self, method: str, url: str, **options: Any) -> httpx.Response:
        return self.portal.call(partial(self.client.request, method, url, **options))


@pytest.fixture(scope="module")
def receiver(tmp_path_factory: pytest.TempPathFactory, features: FeatureSet) -> Iterator[Receiver]:
    folder: Path = tmp_path_factory.mktemp("receiver")
    app = create_app(
        Settings(data=folder, channel_control=True, max_wait_seconds=0.1, max_grid_cells=2_500, max_body_bytes=20_000)
    )
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    client = httpx.AsyncClient(transport=transport, base_url="http://receiver")
    with start_blocking_portal() as portal, portal.wrap_async_context_manager(app.router.lifespan_context(app)):
        receiver = Receiver(portal, client)
        body = b"".join(packets_of(features, "hills"))
        receiver.request("POST", "/v1/transmissions/hills", content=body, headers=HEADERS)
        yield receiver
        portal.call(client.aclose)


def assert_sensible(status: int, media_type: str, answer: object) -> None:
    assert status < 500
    if status >= 400:
        assert media_type == "application/problem+json"
        assert isinstance(answer, dict)
        assert answer["status"] == status
        assert answer["title"]


@SPARSE
@example(path="/v1/surfaces", name="hills", query={"before": str(2**63)}, accept="*/*", method="GET")
@given(path=PATHS, name=NAMES, query=QUERIES, accept=ACCEPTS, method=st.sampled_from(["GET", "GET", "HEAD", "PATCH"]))
def test_any_question(
    receiver: Receiver, path: str, name: str, query: dict[str, str], accept: str, method: str
) -> None:
    url = path.format(quote(name, safe=""))
    answer = receiver.request(method, f"{url}?{urlencode(query)}", headers={"Accept": accept})
    problem = answer.json() if answer.status_code >= 400 and method != "HEAD" else {}
    if method != "HEAD":
        assert_sensible(answer.status_code, answer.headers.get("content-type", ""), problem)
    assert answer.status_code < 500


@SPARSE
@given(data=st.data())
def test_any_body(receiver: Receiver, features: FeatureSet, data: st.DataObject) -> None:
    packets = packets_of(features, "dales")
    body = bytearray(b"".join(data.draw(st.lists(st.sampled_from(packets), max_size=6))))
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 255)), max_size=4)):
        if body:
            body[place % len(body)] = value
    body += data.draw(st.binary(max_size=40))
    answer = receiver.request("POST", "/v1/transmissions/dales", content=bytes(body), headers=HEADERS)
    assert_sensible(answer.status_code, answer.headers["content-type"], answer.json())
    assert answer.status_code in (202, 400, 409)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["spec", "seed", "impairments", "kind", "p", "std"]), inner, max_size=4)
    ),
    max_leaves=8,
)


@SPARSE
@given(document=JSON)
def test_any_channel(receiver: Receiver, document: object) -> None:
    as_json = {"Content-Type": "application/json"}
    answer = receiver.request("PUT", "/v1/channel", content=json.dumps(document), headers=as_json)
    assert_sensible(answer.status_code, answer.headers["content-type"], answer.json())
