"""How a channel is written: the short string and JSON.

Short string::

    channel = part *(";" part)
    part    = kind [":" name "=" value *("," name "=" value)]  /  profile  /  "profile:" profile  /  "seed=" integer

for example ``gaussian:std=0.1,axes=xyz;erasure:p=0.05;seed=7``. A profile stands for its impairments. JSON is
``{"impairments": [{"kind": "gaussian", "std": 0.1, "axes": "xyz"}], "seed": 7}``, or ``{"spec": short string}``, or
just the short string.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import prod

from pydantic import ValidationError

from common.channel.impairment import Impairment
from common.channel.impairments import REGISTRY
from common.channel.impairments.duplication import Duplication
from common.channel.profiles import PROFILES
from common.errors import ChannelError, hint

MAX_IMPAIRMENTS = 32
"""More than any link needs; bounds the work that one PUT /v1/channel can ask of every later transmission."""
MAX_GROWTH = 8
"""Packets that duplication may make of one: bounds the memory of a transmission."""
MAX_TEXT = 4096
"""Characters of a short string: 32 impairments with every parameter spelled out stay below it."""
MAX_SEED = 2**64 - 1


def parse_text(text: str) -> tuple[tuple[Impairment, ...], int | None]:
    """Impairments and seed (None where not given) of a short string; raises ChannelError."""
    if len(text) > MAX_TEXT:
        raise ChannelError(f"the channel is {len(text)} characters long; at most {MAX_TEXT} are accepted")
    impairments: list[Impairment] = []
    seed: int | None = None
    for part in filter(None, map(str.strip, text.split(";"))):
        if part.startswith("seed="):
            seed = _one_seed(seed, check_seed(part.removeprefix("seed=")))
        else:
            impairments.extend(_parse_part(part))
    return check_impairments(impairments), seed


def _one_seed(before: int | None, seed: int) -> int:
    if before not in (None, seed):
        raise ChannelError(f"the channel has two seeds, {before} and {seed}; give one")
    return seed


def _parse_part(part: str) -> tuple[Impairment, ...]:
    kind, colon, arguments = part.partition(":")
    if kind == "profile":
        return _profile(arguments.strip())
    if not colon and kind in PROFILES:
        return _profile(kind)
    parameters: dict[str, object] = {}
    for argument in filter(None, map(str.strip, arguments.split(","))):
        name, equals, value = (piece.strip() for piece in argument.partition("="))
        if not (name and equals and value):
            raise ChannelError(f"{part!r}: {argument!r} is not of the form name=value")
        if name in parameters:
            raise ChannelError(f"{part!r}: {name} is given twice")
        parameters[name] = value
    return (build(kind.strip(), parameters),)


def _profile(name: str) -> tuple[Impairment, ...]:
    if name not in PROFILES:
        raise ChannelError(f"unknown profile {name!r}{hint(name, PROFILES)}")
    return parse_text(PROFILES[name].channel)[0]


def build(kind: str, parameters: Mapping[str, object]) -> Impairment:
    """The impairment `kind` with `parameters` (texts or numbers); raises ChannelError naming what is accepted."""
    if kind not in REGISTRY:
        raise ChannelError(f"unknown impairment {kind!r}{hint(kind, [*REGISTRY, *PROFILES])}")
    model = REGISTRY[kind]
    accepted = [name for name in model.model_fields if name != "kind"]
    for name in parameters:
        if name not in accepted:
            raise ChannelError(f"{kind} has no parameter {name!r}{hint(name, accepted)}")
    try:
        return model(**parameters)
    except ValidationError as error:
        raise ChannelError(_explain(kind, model, error)) from error


def _explain(kind: str, model: type[Impairment], error: ValidationError) -> str:
    """One line: the parameter, what is wrong with it, what it means."""
    first = error.errors(include_url=False)[0]
    problem = first["msg"].removeprefix("Value error, ")
    if not first["loc"]:
        return f"{kind}: {problem}"
    name = str(first["loc"][0])
    given = "" if first["type"] == "missing" else f", got {str(first['input'])[:40]!r}"
    meaning = model.model_fields[name].description
    return f"{kind}: {name} ({meaning}): {problem[0].lower()}{problem[1:]}{given}"


def check_seed(value: object) -> int:
    """The seed as an integer of 0 to 2^64 - 1; raises ChannelError."""
    try:
        seed = int(value) if isinstance(value, (int, str)) and not isinstance(value, bool) else -1
    except ValueError:
        seed = -1
    if not 0 <= seed <= MAX_SEED:
        raise ChannelError(f"seed must be an integer of 0 to 2^64 - 1, got {str(value)[:40]!r}")
    return seed


def check_impairments(impairments: Iterable[Impairment]) -> tuple[Impairment, ...]:
    """The impairments without the ones that do nothing; raises ChannelError where they are too many."""
    kept = tuple(impairment for impairment in impairments if impairment.kind != "clean")
    if len(kept) > MAX_IMPAIRMENTS:
        raise ChannelError(f"{len(kept)} impairments; at most {MAX_IMPAIRMENTS} are accepted")
    growth = prod(1 + part.copies for part in kept if isinstance(part, Duplication))
    if growth > MAX_GROWTH:
        raise ChannelError(f"the duplications make {growth} packets of one; at most {MAX_GROWTH} are accepted")
    return kept


def parse_json(document: object) -> tuple[tuple[Impairment, ...], int | None]:
    """Impairments and seed of a decoded JSON document; raises ChannelError."""
    if isinstance(document, str):
        return parse_text(document)
    if not isinstance(document, Mapping) or {"impairments", "spec"} <= document.keys():
        raise ChannelError(
            'a channel in JSON is {"impairments": [...], "seed": 0}, {"spec": "...", "seed": 0} or a short string'
        )
    members = ("impairments", "spec", "seed")
    for name in document:
        if name not in members:
            raise ChannelError(f"a channel has no member {str(name)[:40]!r}{hint(str(name), members)}")
    given = check_seed(document["seed"]) if "seed" in document else None
    if "spec" in document:
        if not isinstance(document["spec"], str):
            raise ChannelError("spec must be a short string, such as gaussian:std=0.1;erasure:p=0.05")
        impairments, seed = parse_text(document["spec"])
        return impairments, given if seed is None else _one_seed(given, seed)
    parts = document.get("impairments", [])
    if not isinstance(parts, list) or len(parts) > MAX_IMPAIRMENTS:
        raise ChannelError(f"impairments must be a list of at most {MAX_IMPAIRMENTS}")
    return check_impairments(map(_parse_member, parts)), given


def _parse_member(part: object) -> Impairment:
    if not isinstance(part, Mapping) or not isinstance(part.get("kind"), str):
        raise ChannelError('an impairment in JSON is {"kind": "gaussian", "std": 0.1}; kind must be a string')
    return build(part["kind"], {str(name): value for name, value in part.items() if name != "kind"})


def to_text(impairments: Iterable[Impairment], seed: int) -> str:
    """The short string that parses back to the same channel."""
    parts = [_part_text(impairment) for impairment in impairments] or ["clean"]
    return ";".join([*parts, f"seed={seed}"] if seed else parts)


def _part_text(impairment: Impairment) -> str:
    arguments = ",".join(f"{name}={_value_text(value)}" for name, value in parameters_of(impairment).items())
    return f"{impairment.kind}:{arguments}" if arguments else impairment.kind


def _value_text(value: object) -> str:
    return repr(value).removesuffix(".0") if isinstance(value, float) else str(value)


def parameters_of(impairment: Impairment) -> dict[str, object]:
    """The parameters that differ from their defaults, the impairment's own before those that all have."""
    given = impairment.model_dump(mode="json", exclude={"kind"}, exclude_defaults=True)
    inherited = [name for base in type(impairment).__mro__[1:] for name in vars(base).get("__annotations__", {})]
    return {name: given[name] for name in sorted(given, key=lambda name: name in inherited)}
