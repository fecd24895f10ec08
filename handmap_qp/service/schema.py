"""The schema of the messages, in words and as JSON schema, made of the types themselves."""

from __future__ import annotations

import dataclasses
import json
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import docstring_parser
import msgspec

from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.service import messages
from handmap_qp.service.caps import Caps
from handmap_qp.service.messages import (
    PROTOCOL,
    About,
    AnyReply,
    AnyRequest,
    Detail,
    Lengths,
    Pose,
    Reply,
    Request,
)
from handmap_qp.service.opening import MOST_ITERATIONS, SOLVERS

FLAGS = {
    "dt_clamped": "more time has passed since the last command than `max_dt`",
    "time_backwards": "the time stamp is not later than the last one",
    "time_jump": "the time stamps jumped by more than a second against the server's clock",
    "slewing": "the robot is on its way to where the mapping has it, within its speed limits",
    "stretch_clamped": "a stretch of T was outside its range",
    "watchdog": "no sample has come in time: `status` is `hold` or `returning`",
    "at_rest": "the robot has arrived at rest",
    "resumed": "the first command after a hold",
    "released": "the session was let go: the robot stays until `clutch`, whatever `status` says besides",
}
"""What a command may be flagged with."""

CODES = {
    "invalid": "a field is missing, unknown, of the wrong type or cannot be used; `field` names it",
    "protocol": "another version of the messages",
    "no_session": "the server does not know the session: it was restarted, or has closed it",
    "taken": "another client has taken the session over (`restore`)",
    "stale": "the number is not above the last one, and the message is not its repetition",
    "busy": "all sessions are taken, or this one is in use",
    "rate": "too many messages, openings of sessions or changes of options a second; `seq` may be 0",
    "denied": "the server does not allow it, or the session's client",
    "internal": "the server failed at it, and has logged why",
}
"""What an error's `code` may be."""

_NARROWED = {
    "solver": f"`{'` or `'.join(SOLVERS)}`: the time of others is not bounded.",
    "max_iterations": f"Linearisations per sample, at most; the service takes no more than {MOST_ITERATIONS}.",
}


def schema_text() -> str:
    """All messages as Markdown."""
    parts = [
        f"# Messages of the mapping service, protocol {PROTOCOL}",
        "One message is one map with a key `type`. SI and radians; poses are of the wrist frame, in right-handed worlds.\n\n"
        "- ZeroMQ: msgpack. A DEALER (or REQ) socket to the port of requests; a SUB socket to the port of the stream, where a "
        "message is the session's name, a zero byte, and the message. One SUB socket per session: for each the server keeps the "
        "newest message alone, whatever session it is of.\n"
        "- WebSocket: binary frames are msgpack, text frames JSON. `subscribe` turns on a stream. Where a token is asked for (16 "
        "to 256 of A-Z a-z 0-9 _ -), a client shows it as the header `Authorization: Bearer TOKEN`, and a page in a browser, which "
        'cannot set headers, as a subprotocol: `new WebSocket(url, ["handmap.v1", "bearer.TOKEN"])`.\n\n'
        f"A message is at most {Caps().message_size} bytes long; a longer one ends its connection. Coordinates [m] and angles "
        f"[rad] are within {messages.LARGEST:g} of 0, time stamps [s] within {messages.LATEST:g}.\n\n"
        "A request that is repeated byte by byte is answered again and carried out once. One that bears a session's public "
        "`name` in place of its secret is carried out each time.",
        "## Requests",
        "Every request has these fields too:",
        _table(Request).partition("\n\n")[2].partition("\n\n")[2],
        *(_table(kind) for kind in get_args(AnyRequest)),
        "## Replies",
        "Every reply has `seq`, the number of the request that it answers. Replies may grow fields.",
        *(_table(kind) for kind in get_args(AnyReply)),
        "## Values",
        *(_table(kind) for kind in (Pose, Lengths, About, Detail)),
        *(_options_table(kind) for kind in (MappingOptions, IkOptions)),
        "## Flags of a command",
        "\n".join(f"- `{flag}`: {text}" for flag, text in FLAGS.items()),
        "## Codes of an error",
        "\n".join(f"- `{code}`: {text}" for code, text in CODES.items()),
    ]
    return "\n\n".join(parts)


def json_schema() -> str:
    """All messages as JSON schema (2020-12)."""
    (requests, replies), components = msgspec.json.schema_components(
        [AnyRequest, AnyReply], ref_template="#/$defs/{name}"
    )
    return json.dumps(
        {
            "title": f"handmap protocol {PROTOCOL}",
            "anyOf": [requests, replies],
            "$defs": components,
        },
        indent=2,
    )


def _table(kind: type[msgspec.Struct]) -> str:
    tag = kind.__struct_config__.tag
    title = f"`{tag}`" if tag else f"`{kind.__name__}`"
    hints = get_type_hints(kind, dict(vars(messages)), include_extras=True)
    base = next(
        (base for base in (Request, Reply) if issubclass(kind, base) and kind is not base), None
    )
    inherited = () if base is None else base.__struct_fields__
    rows = []
    for item in msgspec.structs.fields(kind):
        if item.name in inherited:
            continue
        default = "" if item.required else f"`{json.dumps(_default(item))}`"
        rows.append(
            f"| `{item.name}` | {_type(hints[item.name])} | {default} | {_description(hints[item.name])} |"
        )
    head = ["", "| field | type | default | |", "|---|---|---|---|"] if rows else []
    return "\n".join([f"### {title}", "", " ".join((kind.__doc__ or "").split()), *head, *rows])


def _options_table(kind: type[MappingOptions | IkOptions]) -> str:
    """Options as their class describes them."""
    described = docstring_parser.parse(kind.__doc__ or "")
    hints = get_type_hints(kind)
    # Of what the service takes less than the package does, it says so.
    texts = {param.arg_name: param.description or "" for param in described.params} | _NARROWED
    rows = [
        f"| `{item.name}` | {_type(hints[item.name])} | `{json.dumps(item.default)}` | {' '.join(texts[item.name].split())} |"
        for item in dataclasses.fields(kind)
    ]
    head = ["", "| field | type | default | |", "|---|---|---|---|"]
    return "\n".join(
        [f"### `{kind.__name__}`", "", described.short_description or "", *head, *rows]
    )


def _default(item: msgspec.structs.FieldInfo) -> Any:
    value = item.default if item.default is not msgspec.NODEFAULT else item.default_factory()  # type: ignore[operator]
    return round(value, 4) if isinstance(value, float) else value


def _description(hint: Any) -> str:
    metas = [meta for meta in getattr(hint, "__metadata__", ()) if isinstance(meta, msgspec.Meta)]
    return next((meta.description for meta in reversed(metas) if meta.description), "") or ""


def _type(hint: Any) -> str:
    """A type as readers of any language know it."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _type(inner[0]) + _bounds(inner[1:])
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in inner)
    if origin in (Union, types.UnionType):
        return " or ".join("null" if part is type(None) else _type(part) for part in inner)
    if origin is tuple:
        return (
            f"[{_type(inner[0])}, ...]"
            if inner[1:] == (...,)
            else f"{len(inner)} x {_type(inner[0])}"
        )
    if origin is dict:
        return "map"
    names = {
        "str": "text",
        "float": "number",
        "int": "integer",
        "bool": "boolean",
        "Any": "any",
        "NoneType": "null",
    }
    return names.get(getattr(hint, "__name__", str(hint)), f"`{getattr(hint, '__name__', hint)}`")


def _bounds(metas: tuple[Any, ...]) -> str:
    signs = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    found = []
    for meta in metas:
        if isinstance(meta, msgspec.Meta):
            # 2^53 is merely where JSON's integers end.
            found += [
                f"{sign} {getattr(meta, key):g}"
                for key, sign in signs.items()
                if getattr(meta, key) not in (None, 2**53)
            ]
            if meta.max_length is not None:
                found.append(f"at most {meta.max_length}")
            if meta.title is not None:
                found.append(meta.title)
    return f" ({', '.join(found)})" if found else ""
