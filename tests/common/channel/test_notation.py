"""Short strings and JSON: what is written is what is meant, and what is wrong is named."""

from __future__ import annotations

import doctest
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

import common.channel
from common.channel import REGISTRY, Channel, carrying, channel
from common.channel.impairments.erasure import Erasure
from common.channel.impairments.gaussian import Gaussian
from common.channel.impairments.rayleigh import Rayleigh
from common.channel.notation import MAX_GROWTH, MAX_IMPAIRMENTS, MAX_TEXT
from common.errors import ChannelError


def test_a_short_string_means_what_it_says() -> None:
    parsed = Channel.parse(" gaussian : std = 0.1 , axes=xyz ; erasure:p=0.05 ;seed=9;")
    assert parsed == Channel([Gaussian(std=0.1, axes="xyz"), Erasure(p=0.05)], seed=9)
    assert parsed.impairments[0] == Gaussian(std=0.1, axes="xyz")


@pytest.mark.parametrize("text", ["", "clean", " ; ;", "clean;clean", "profile:lora;clean"])
def test_doing_nothing_can_be_written(text: str) -> None:
    assert bool(Channel.parse(text)) is ("lora" in text)


def test_the_no_op_is_the_empty_channel() -> None:
    assert Channel.parse("clean") == Channel() == Channel.from_json({"impairments": [{"kind": "clean"}]})
    assert str(Channel()) == "clean"
    packets = (b"a", b"", b"b")
    delivery = Channel.parse("clean", seed=5).transmit(packets, transmission="t")
    assert (delivery.packets, delivery.faults, delivery.times) == (packets, (), (0.0, 0.0, 0.0))


def test_the_seed_in_the_text_goes_before_the_default() -> None:
    assert Channel.parse("erasure:p=0.1", seed=4).seed == 4
    assert Channel.parse("erasure:p=0.1;seed=0", seed=4).seed == 0
    assert Channel.from_json({"seed": 6}).seed == 6
    assert Channel.from_json({"spec": "erasure:p=0.1", "seed": 6}) == Channel.parse("erasure:p=0.1;seed=6")
    assert Channel.from_json({"spec": "erasure:p=0.1;seed=5", "seed": 5}).seed == 5


def test_equal_channels_are_equal_however_they_are_made() -> None:
    made = Channel([Rayleigh(ebn0_db=10, coherence=4, modulation="qpsk")], seed=2)
    assert Channel.parse(str(made)) == made == Channel.from_json(json.loads(json.dumps(made.to_json())))
    assert hash(Channel.parse(str(made))) == hash(made)
    assert Channel.from_json(str(made)) == made
    assert made != Channel(made.impairments, seed=3)


WRONG = [
    ("gausian:std=1", "did you mean 'gaussian'"),
    ("gaussian:sdt=1", "did you mean 'std'"),
    ("gaussian:std=-1", "standard deviation, data units"),
    ("gaussian", "exactly one of std, relative, snr_db"),
    ("gaussian:std=1,snr_db=3", "exactly one of std, relative, snr_db"),
    ("gaussian:std=nan", "std"),
    ("gaussian:std=1,std=2", "given twice"),
    ("gaussian:std", "name=value"),
    ("gaussian:std=1,axes=yx", "'xyz'"),
    ("erasure", "p .*field required"),
    ("erasure:p=1.5", "less than or equal to 1"),
    ("erasure:p=often", "valid number"),
    ("lorra", "did you mean 'lora'"),
    ("profile:nope", "accepted are lora"),
    ("profile", "accepted are lora"),
    ("seed=-1", "0 to 2"),
    ("seed=x", "0 to 2"),
    (f"seed={2**64}", "0 to 2"),
    ("seed=1;seed=2", "two seeds, 1 and 2; give one"),
    ("rayleigh:ebn0_db=3,coherence=0", "coherence"),
    (";".join(["erasure:p=0.1"] * (MAX_IMPAIRMENTS + 1)), "at most"),
    (" " * (MAX_TEXT + 1), "characters"),
    ("duplication:p=1,copies=2;duplication:p=1,copies=2", f"at most {MAX_GROWTH}"),
]


@pytest.mark.parametrize(("text", "message"), WRONG)
def test_what_is_wrong_is_named_and_what_is_accepted_is_said(text: str, message: str) -> None:
    with pytest.raises(ChannelError, match=message) as caught:
        Channel.parse(text)
    assert "\n" not in caught.value.detail
    assert len(caught.value.detail) < 400


@pytest.mark.parametrize(
    ("document", "message"),
    [
        (3, "short string"),
        (None, "short string"),
        ({"impairment": []}, "did you mean 'impairments'"),
        ({"impairments": {}}, "list"),
        ({"impairments": ["erasure"]}, "kind"),
        ({"impairments": [{"std": 1}]}, "kind"),
        ({"impairments": [{"kind": ["erasure"]}]}, "kind"),
        ({"impairments": [{"kind": "erasure", "p": {"a": 1}}]}, "p"),
        ({"impairments": [{"kind": "erasure", "q": 1}]}, "'q'"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
        ({"spec": "erasure:p=0.1;seed=5", "seed": 6}, "two seeds, 6 and 5; give one"),
        ({"spec": 3}, "spec must be a short string"),
        ({"spec": "clean", "impairments": []}, "short string"),
    ],
)
def test_wrong_json_is_named(document: object, message: str) -> None:
    with pytest.raises(ChannelError, match=message):
        Channel.from_json(document)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
PARTS = st.fixed_dictionaries({"kind": st.sampled_from(sorted(REGISTRY))}, optional={"p": JSON, "std": JSON})


@given(JSON | st.fixed_dictionaries({"impairments": st.lists(PARTS | JSON, max_size=3)}, optional={"seed": JSON}))
def test_any_json_is_a_channel_or_our_error(document: object) -> None:
    try:
        made = Channel.from_json(document)
    except ChannelError:
        return
    assert Channel.parse(str(made)) == made


WORDS = st.sampled_from(
    [*REGISTRY, "lora", "std", "p", "seed", "profile", "z", "0.1", "1e400", "-0", "=", ":", ",", ";"]
)


@given(st.text() | st.lists(WORDS, max_size=12).map("".join))
def test_any_text_is_a_channel_or_our_error(text: str) -> None:
    try:
        made = Channel.parse(text)
    except ChannelError:
        return
    assert Channel.parse(str(made)) == made
    assert Channel.from_json(made.to_json()) == made


def test_the_json_schema_knows_every_parameter() -> None:
    schema = Channel.json_schema()
    described = {model["properties"]["kind"]["const"]: model["properties"] for model in schema["$defs"].values()}
    assert set(described) == set(REGISTRY)
    for kind, properties in described.items():
        for name, parameter in properties.items():
            assert name == "kind" or parameter["description"], (kind, name)


def test_the_examples_in_the_docstrings_hold() -> None:
    for module in (common.channel, channel, carrying):
        results = doctest.testmod(module)
        assert results.attempted
        assert not results.failed
