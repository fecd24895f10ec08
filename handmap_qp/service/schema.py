"""Description of the messages, as Markdown and as JSON schema, made from their types."""

from __future__ import annotations

import json
import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import msgspec

from handmap_qp.human.verdict import RULES
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.options import Options, options_of
from handmap_qp.service import messages
from handmap_qp.service.caps import Caps
from handmap_qp.service.choosing import MOST_ITERATIONS, SOLVERS
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

FLAGS = {
    "dt_clamped": "more time than `max_dt` has passed since the last command",
    "time_backwards": "the time stamp is not later than the last one",
    "time_jump": "the time stamps jumped by more than a second relative to the server's clock",
    "slewing": "the robot is on its way to the mapped posture, within its speed limits",
    "stretch_clamped": "a stretch of T was outside its range",
    "watchdog": "no sample arrived in time: `status` is `hold` or `returning`",
    "at_rest": "the robot is at its rest posture",
    "resumed": "the first command after a hold",
    "released": "the robot is released and holds until `clutch`, whatever `status` says",
    "stopped": "an emergency stop is in force, until `clear`",
}
"""Flags of a command, besides the rule that a sample broke."""

CODES = {
    "invalid": "a field is missing, unknown, of another type or unusable; `field` names it",
    "protocol": "the message is of another version of the protocol; `protocols` has the versions "
    "that the server answers",
    "no_session": "the server does not know the session: it was restarted, or closed the session",
    "taken": "another client took the session over (`restore`)",
    "stale": "the number is not above the last one, and the request is not a repetition",
    "busy": "all sessions are in use, or this one is",
    "rate": "too many messages, openings or changes of options per second; `seq` may be 0",
    "stopped": "an emergency stop is in force: clear it first",
    "denied": "the server or the client of the session does not allow it",
    "internal": "the server failed and logged the reason",
}
"""Codes of an error."""

_NARROWED = {
    "solver": f"`{'` or `'.join(SOLVERS)}`, because the time of other solvers has no bound.",
    "max_iterations": "Linearisations per sample, at most; "
    f"the service accepts up to {MOST_ITERATIONS}.",
}
"""Options that the service restricts."""

_INTRODUCTION = f"""\
One message is one map with the key `type`. Units are SI and radians; poses are of the wrist frame,
in right-handed worlds.

- ZeroMQ: msgpack. Connect a DEALER (or REQ) socket to the port of requests, and a SUB socket to the
  port of the stream. A message of the stream is the session's name, a zero byte, and the message.
  Use one SUB socket per session: for each socket, the server keeps the newest message only,
  whatever session it is of.
- WebSocket: binary frames are msgpack, text frames JSON. `subscribe` starts a stream. If the server
  requires a token (16 to 256 of A-Z a-z 0-9 _ -), send it as the header `Authorization: Bearer
  TOKEN`. A page in a browser cannot set headers, so it offers the token as a subprotocol:
  `new WebSocket(url, ["handmap.v1", "bearer.TOKEN"])`.

A message is at most {Caps().message_size} bytes long; a longer one ends its connection.
Coordinates [m] and angles [rad] are within {messages.LARGEST:g} of 0, time stamps [s] within
{messages.LATEST:g}.

If a request arrives again byte by byte, the server repeats its answer without carrying it out
again. A request with a session's public `name` in place of its secret is carried out each time."""


def schema_text() -> str:
    """Return the description of all messages as Markdown."""
    parts = [
        f"# Messages of the mapping service, protocol {PROTOCOL}",
        _INTRODUCTION,
        "## Requests",
        "Every request also has these fields:",
        _rows(Request),
        *(_table(kind) for kind in get_args(AnyRequest)),
        "## Replies",
        "Every reply has `seq`, the number of the request that it answers. "
        "Replies may get further fields.",
        *(_table(kind) for kind in get_args(AnyReply)),
        "## Values",
        *(_table(kind) for kind in (Pose, Lengths, About, Detail)),
        "### Presets",
        "\n".join(map(_preset_line, PRESETS)),
        *map(
            _options_table,
            dict.fromkeys([*(type(preset.method) for preset in PRESETS.values()), IkOptions]),
        ),
        "## Flags of a command",
        "\n".join(f"- `{flag}`: {text}" for flag, text in FLAGS.items()),
        "## Rules for landmarks",
        "A sample that breaks a rule does not move the robot: `status` is `held`, and `rule` and "
        "`flags` have the name. Afterwards, `gliding` leads back to the human.",
        "\n".join(f"- `{rule}`: {text}" for rule, text in RULES.items()),
        "## Codes of an error",
        "\n".join(f"- `{code}`: {text}" for code, text in CODES.items()),
    ]
    return "\n\n".join(parts)


def json_schema() -> str:
    """Return all messages as JSON schema (2020-12)."""
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


_HEAD = ["| field | type | default | |", "|---|---|---|---|"]


def _table(kind: type[msgspec.Struct]) -> str:
    """Describe a message or value with its fields."""
    tag = kind.__struct_config__.tag
    parts = [f"### `{tag or kind.__name__}`", " ".join((kind.__doc__ or "").split()), _rows(kind)]
    return "\n\n".join(part for part in parts if part)


def _rows(kind: type[msgspec.Struct]) -> str:
    """Describe the fields that a struct adds to its base; empty if there are none."""
    hints = get_type_hints(kind, dict(vars(messages)), include_extras=True)
    base = next(
        (base for base in (Request, Reply) if issubclass(kind, base) and kind is not base), None
    )
    inherited = () if base is None else base.__struct_fields__
    rows = []
    for item in msgspec.structs.fields(kind):
        if item.name not in inherited:
            default = "" if item.required else f"`{json.dumps(_default(item))}`"
            hint = hints[item.name]
            rows.append(f"| `{item.name}` | {_type(hint)} | {default} | {_description(hint)} |")
    return "\n".join([*_HEAD, *rows]) if rows else ""


def _options_table(kind: type[Options]) -> str:
    """Describe options as their class does, except those that the service restricts."""
    about = (kind.__doc__ or "").partition("\n")[0]
    rows = [
        f"| `{option.name}` | {_type(option.type)} | `{json.dumps(option.default)}` "
        f"| {_NARROWED.get(option.name, option.about)} |"
        for option in options_of(kind)
    ]
    return "\n".join([f"### `{kind.__name__}`", "", about, "", *_HEAD, *rows])


def _preset_line(name: str) -> str:
    """Describe a preset, and where its options differ from the defaults in the tables."""
    preset = PRESETS[name]
    changes = {
        option: value
        for part in (preset.ik, preset.method)
        for option, value in type(part)().changes_to(part).items()
    }
    listed = ", ".join(f"`{option}` {json.dumps(value)}" for option, value in changes.items())
    differs = f" Its own values: {listed}." if changes else ""
    kind = type(preset.method).__name__
    return f"- `{name}` (`{kind}`): {preset.purpose}. Weakness: {preset.weakness}.{differs}"


def _default(item: msgspec.structs.FieldInfo) -> Any:
    value = item.default if item.default is not msgspec.NODEFAULT else item.default_factory()
    return round(value, 4) if isinstance(value, float) else value


def _description(hint: Any) -> str:
    metas = [meta for meta in getattr(hint, "__metadata__", ()) if isinstance(meta, msgspec.Meta)]
    return next((meta.description for meta in reversed(metas) if meta.description), "") or ""


def _type(hint: Any) -> str:
    """Name a type independently of Python."""
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
            # 2^53 is only the limit of integers in JSON.
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
