"""Write what `handmap serve --schema` and `--json-schema` print, from the types of the messages.

    python docs/messages.py

A test compares the files, handmap_qp/apps/service/messages.md and .json, with the types. The table
of what stops a robot is written into docs/safety.md, too, and that of the statuses, which the page
of a headset shows, into docs/troubleshooting.md.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import docstring_parser
import msgspec

from handmap_core.human.sample import RULES
from handmap_core.ik.options import IkOptions
from handmap_qp.apps.service.cli import SCHEMAS
from handmap_qp.apps.service.opening import MOST_ITERATIONS, SOLVERS
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import messages
from handmap_qp.client.messages import (
    LARGEST,
    PROTOCOL,
    About,
    AnyReply,
    AnyRequest,
    Detail,
    Fist,
    HandSample,
    HandState,
    Lengths,
    Pose,
    Request,
)
from handmap_qp.mapping.presets import PRESETS
from handmap_qp.options import Options, options_of


class Stopping(NamedTuple):
    """One of the four words for what stops a robot and lets it follow.

    Attributes:
        word: The word.
        by: Who does it.
        robot: What the robot does.
        until: What ends it.
        requests: Requests that do it, by their types.
        former: Former names of requests, which still work.
        modes: Values of `mode` in `state`.
        marks: Values of `status`, and flags, in commands.
    """

    word: str
    by: str
    robot: str
    until: str
    requests: tuple[str, ...]
    former: tuple[str, ...]
    modes: tuple[str, ...]
    marks: tuple[str, ...]


STOPPING = (
    Stopping(
        "hold",
        "the software, if samples are missing or invalid, joints do not follow, the hand is not "
        "measured yet, or the QP has no solution",
        "keeps its posture; with `return_after` it goes to rest if samples are missing",
        "the next valid sample, which is a new reference with `resume=engage`; `not_following`: "
        "engage; `calibrating`: 30 samples are measured; `failed`: the next sample for which the "
        "QP has a solution",
        (),
        (),
        ("hold", "returning", "not_following", "calibrating"),
        ("held", "failed", "hold", "returning", "not_following", "calibrating"),
    ),
    Stopping(
        "disengage",
        "the session's owner; in a shared session everyone who is admitted",
        "keeps its posture and ignores samples",
        "engage",
        ("disengage",),
        ("release",),
        ("released",),
        ("released",),
    ),
    Stopping(
        "emergency stop",
        "everyone who is admitted, for every session",
        "brakes, keeps its posture and ignores samples",
        "`clear` with the number of the stop, which disengages",
        ("stop", "clear"),
        (),
        ("stopped",),
        ("stopped",),
    ),
    Stopping(
        "engage",
        "the session's owner; in a shared session everyone who is admitted",
        "follows from where it is; after `reset` from rest, or from a given posture",
        "one of the three above",
        ("engage", "reset"),
        ("clutch",),
        ("waiting", "following"),
        ("converged", "limited", "unreachable", "unsettled", "gliding"),
    ),
)
"""All that stops a robot of the service, and what lets it follow again."""

FLAGS = {
    "dt_clamped": "more time than `max_dt` has passed since the last command",
    "time_backwards": "the time stamp is not later than the last one",
    "time_jump": "the time stamps jumped by more than a second relative to the server's clock",
    "slewing": "the robot is on its way to the mapped posture, within its speed limits",
    "stretch_clamped": "a stretch of T was outside its range",
    "watchdog": "no sample arrived in time: `status` is `hold` or `returning`",
    "at_rest": "the robot is at its rest posture",
    "resumed": "the first command after a hold",
    "released": "the robot is disengaged and holds until `engage`, whatever `status` says",
    "stopped": "an emergency stop is in force, until `clear`",
    "busy": "the server has no time for the samples of this session, so the robot holds",
    "off_object": "a finger that touches the held object is more than 10 mm off its place on it",
}
"""Flags of a command, besides the rule that a sample broke."""

CODES = {
    "invalid": "a field is missing, unknown, of another type or unusable; `field` names it",
    "protocol": "the message is of another version of the protocol; `protocols` has the versions "
    "that the server answers",
    "no_session": "the server does not know the session: it was restarted, or closed the session",
    "taken": "another client took the session over (`restore`)",
    "stale": "the number is not above the last one, and the request is not a repetition",
    "busy": "all sessions are in use, or this one is, or the client's share of them; or the server "
    "has no time for a further session, or for the samples of those opened last: their robots hold",
    "rate": "too many messages, openings or changes of options per second; `seq` may be 0",
    "stopped": "an emergency stop is in force: clear it first",
    "denied": "the server or the client of the session does not allow it",
    "internal": "the server failed and logged the reason",
}
"""Codes of an error."""

SAFETY = Path(__file__).with_name("safety.md")
TROUBLESHOOTING = Path(__file__).with_name("troubleshooting.md")
STATUSES = SCHEMAS["schema"].with_name("webxr") / "statuses.json"
"""What each status means and what to do; the page reads it, and the documentation."""
LINKS: dict[str, dict[str, str]] = {
    "limited": {"at a limit": "#what-holds-the-hand"},
    "unreachable": {
        "out of reach": "#what-holds-the-hand",
        "calibrate": "calibration.md",
        "preset": "choose.md",
    },
    "unsettled": {"ik.max-iterations": "choose.md#options"},
    "failed": {"default weights and solver": "choose.md#options"},
    "held": {"the rule": "#rules-of-the-guard"},
    "gliding": {"returns": "faults.md#coming-back"},
    "released": {"until Engage": "safety.md#words-and-states"},
    "waiting": {"start the tracker": "#samples-do-not-arrive"},
    "hold": {
        "watchdog": "safety.md#guaranteed-by-the-watchdog",
        "start the tracker": "#samples-do-not-arrive",
    },
    "returning": {"rest": "safety.md#words-and-states"},
    "not_following": {"following_error": "service.md#a-driver"},
    "stopped": {"emergency stop": "safety.md#emergency-stop"},
    "calibrating": {"is measured": "calibration.md#the-first-seconds-of-a-session"},
}
"""Phrases of a status that are links in the documentation; the page of a headset has none."""
_BEGIN, _END = "<!-- stopping: by docs/messages.py -->", "<!-- end -->"
"""What the table of `STOPPING` is between."""

_NARROWED = {
    "solver": f"`{'` or `'.join(SOLVERS)}`, because the time of other solvers has no bound.",
    "max_iterations": "QPs of a sample, and three more where links would meet; "
    f"the service accepts up to {MOST_ITERATIONS}.",
}
"""Options that the service restricts."""

_COMMON = ("type", *Request.__struct_fields__)
"""Fields of every message."""

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

A message is at most {Settings().message_size} bytes long; a longer one ends its connection.
The wrist of a request is at most {LARGEST:g} m from the origin.

If a request arrives again byte by byte, the server repeats its answer without carrying it out
again. A request with a session's public `name` in place of its secret is carried out each time."""


def schema_text() -> str:
    """Return the description of all messages as Markdown."""
    parts = [
        f"# Messages of the mapping service, protocol {PROTOCOL}",
        _INTRODUCTION,
        "## Requests",
        "Every request also has these fields:",
        _rows(Request, ["type"]),
        *(_table(kind) for kind in get_args(AnyRequest)),
        "## Replies",
        "Every reply has `seq`, the number of the request that it answers. "
        "Replies may get further fields.",
        *(_table(kind) for kind in get_args(AnyReply)),
        "## Values",
        *map(_table, (Pose, Lengths, HandSample, HandState, Fist, About, Detail)),
        "### Presets",
        "\n".join(map(_preset_line, PRESETS)),
        *map(
            _table,
            dict.fromkeys(
                [*(type(each.method) for each in PRESETS.values()), IkOptions]
            ),
        ),
        "## What stops the robot",
        stopping_table(),
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


def stopping_table() -> str:
    """Return the table of `STOPPING`."""
    head = (
        "| word | who | the robot | until | requests | `mode` | `status` and flags |",
        "|---|---|---|---|---|---|---|",
    )
    return "\n".join([*head, *map(_stopping_row, STOPPING)])


def _stopping_row(one: Stopping) -> str:
    requests = _named(one.requests)
    if one.former:
        requests += f"; formerly {_named(one.former)}"
    cells = (
        one.by,
        one.robot,
        one.until,
        requests,
        _named(one.modes),
        _named(one.marks),
    )
    return f"| **{one.word}** | {' | '.join(cells)} |"


def _named(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def safety_text() -> str:
    """Return docs/safety.md with the table between its marks."""
    before, rest = SAFETY.read_text(encoding="utf-8").split(_BEGIN)
    _, after = rest.split(_END)
    return f"{before}{_BEGIN}\n\n{stopping_table()}\n\n{_END}{after.rstrip()}"


def troubleshooting_text() -> str:
    """Return docs/troubleshooting.md with the table of the statuses, and links to more."""
    text = TROUBLESHOOTING.read_text(encoding="utf-8")
    head = "| status | what it means | what to do |\n|---|---|---|\n"
    before, rest = text.split(head)
    _, after = rest.split("\n\n", 1)
    statuses = json.loads(STATUSES.read_text(encoding="utf-8"))
    rows = (
        f"| `{status}` | {_linked(status, each['means'])} | {_linked(status, each['do'])} |"
        for status, each in statuses.items()
    )
    return f"{before}{head}{chr(10).join(rows)}\n\n{after.rstrip()}"


def _linked(status: str, text: str) -> str:
    """Return a text of a status with the links of `LINKS`."""
    for phrase, target in LINKS.get(status, {}).items():
        text = text.replace(phrase, f"[{phrase}]({target})", 1)
    return text


def json_schema() -> str:
    """Return all messages as JSON schema (2020-12)."""
    either, components = _components(AnyRequest, AnyReply)
    title = f"handmap protocol {PROTOCOL}"
    return json.dumps({"title": title, "anyOf": either, "$defs": components}, indent=2)


def _components(*kinds: Any) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the JSON schemas of types, and those of the structs that they refer to.

    Fields are described in the docstring of their class, or of a base, under `Attributes`.
    """
    schemas, components = msgspec.json.schema_components(
        kinds, ref_template="#/$defs/{name}"
    )
    for kind in kinds:
        for option in options_of(kind) if _is_of_options(kind) else ():
            own = components[kind.__name__]["properties"]
            own[option.name]["description"] = option.about
    for name, schema in components.items():
        kind = getattr(messages, name, None)
        for base in () if kind is None else reversed(kind.__mro__):
            doc = docstring_parser.parse(base.__doc__ or "")
            for item in doc.params:
                if item.arg_name in schema["properties"]:
                    text = " ".join((item.description or "").split())
                    schema["properties"][item.arg_name]["description"] = text
            text = f"{doc.short_description} {doc.long_description or ''}"
            schema["description"] = " ".join(text.split())
    return list(schemas), components


def _is_of_options(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, Options)


def _table(kind: type[msgspec.Struct]) -> str:
    """Describe a message, value or options with its fields."""
    name = kind.__struct_config__.tag or kind.__name__
    about = _components(kind)[1][kind.__name__].get("description", "")
    parts = f"### `{name}`", about.partition("\n")[0], _rows(kind)
    return "\n\n".join(filter(None, parts))


def _rows(kind: type[msgspec.Struct], hidden: Sequence[str] = _COMMON) -> str:
    """Describe the fields of a struct that are not hidden; empty if there are none."""
    fields = _components(kind)[1][kind.__name__]["properties"].items()
    rows = [_row(name, field) for name, field in fields if name not in hidden]
    head = ["| field | type | default | |", "|---|---|---|---|"]
    return "\n".join(head + rows) if rows else ""


def _row(name: str, field: dict[str, Any]) -> str:
    default = field.get("default")
    value = json.dumps(round(default, 4) if isinstance(default, float) else default)
    given = f"`{value}`" if "default" in field else ""
    texts = [part.get("description", "") for part in (field, *field.get("anyOf", ()))]
    about = _NARROWED.get(name, next(filter(None, texts), ""))
    return f"| `{name}` | {_type(field)} | {given} | {about} |"


def _preset_line(name: str) -> str:
    """Describe a preset, and where its options differ from the defaults in the tables."""
    preset = PRESETS[name]
    changes = {
        option: value
        for part in (preset.ik, preset.method)
        for option, value in type(part)().changes_to(part).items()
    }
    listed = ", ".join(
        f"`{option}` {json.dumps(value)}" for option, value in changes.items()
    )
    differs = f" Its own values: {listed}." if changes else ""
    kind = type(preset.method).__name__
    return f"- `{name}` (`{kind}`): {preset.purpose}. Weakness: {preset.weakness}.{differs}"


_NAMES = {"string": "text", "object": "map", None: "any"}
_BOUNDS = {
    "minimum": "at least",
    "exclusiveMinimum": "above",
    "maximum": "at most",
    "maxLength": "at most",
    "maxItems": "at most",
}


def _type(schema: dict[str, Any]) -> str:
    """Name the type of a JSON schema."""
    if "$ref" in schema:
        return f"`{schema['$ref'].rpartition('/')[2]}`"
    if "anyOf" in schema:
        # null comes last; versions of msgspec differ.
        kinds = map(_type, schema["anyOf"])
        return " or ".join(sorted(kinds, key="null".__eq__))
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if "prefixItems" in schema:
        return f"{len(schema['prefixItems'])} x {_type(schema['prefixItems'][0])}"
    if "items" in schema:
        return f"[{_type(schema['items'])}, ...]{_bounds(schema)}"
    return f"{_NAMES.get(schema.get('type'), schema.get('type'))}{_bounds(schema)}"


def _bounds(schema: dict[str, Any]) -> str:
    """Name the bounds of a JSON schema; 2^53 is only the limit of integers in JSON."""
    given = [(sign, schema[key]) for key, sign in _BOUNDS.items() if key in schema]
    bounds = [f"{sign} {bound:g}" for sign, bound in given if bound != 2**53]
    bounds += [schema["title"]] if "pattern" in schema else []
    return f" ({', '.join(bounds)})" if bounds else ""


def files() -> dict[Path, str]:
    """Return the texts of the files to write."""
    return {
        SCHEMAS["schema"]: schema_text(),
        SCHEMAS["json_schema"]: json_schema(),
        SAFETY: safety_text(),
        TROUBLESHOOTING: troubleshooting_text(),
    }


if __name__ == "__main__":
    for file, text in files().items():
        file.write_text(text + "\n", encoding="utf-8")
        print(f"wrote {file}")
