"""Messages: decoding, refusals, and their description."""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import fields
from strategies import motion_of, rotations, translations

from handmap_core.stream.step_table import STATUS_NAMES
from handmap_qp.apps.service.dispatch import decode_request, encode_reply
from handmap_qp.apps.service.safety import SessionState
from handmap_qp.apps.service.session import to_pose
from handmap_qp.apps.service.websocket import _from_json
from handmap_qp.client.messages import (
    PROTOCOL,
    AnyReply,
    AnyRequest,
    Command,
    Disengage,
    Engage,
    Error,
    Open,
    Pose,
    Sample,
    State,
    Step,
)
from handmap_qp.mapping.presets import known_options

_PAGE = Path(__file__).parents[2] / "docs" / "messages.py"
messages = SimpleNamespace(**runpy.run_path(str(_PAGE), run_name="messages"))
STEP: dict[str, Any] = {
    "type": "step",
    "protocol": PROTOCOL,
    "seq": 7,
    "session": "s" * 16,
    "time": 1.5,
    "q": [0.0, 0.1, 0.2],
    "wrist": {"position": [0, 0, 1], "quat_xyzw": [0, 0, 0, 1]},
}
OPEN: dict[str, Any] = {
    "type": "open",
    "protocol": PROTOCOL,
    "seq": 7,
    "session": "s" * 16,
    "robot": "three_finger",
}
NAN = float("nan")

# Message and the field that the answer must name.
MISTAKES = {
    "text in numbers": (STEP | {"q": [0.0, "x"]}, "q[1]"),
    "not a number": (STEP | {"q": [0.0, 0.0, NAN]}, "q[2]"),
    "infinite": (STEP | {"points": [[0, 0, 0], [0, float("inf"), 0]]}, "points[1][1]"),
    "absurdly far": (STEP | {"landmarks": [[0, 0, 1e6]]}, "landmarks[0][2]"),
    "time is no number": (STEP | {"time": NAN}, "time"),
    "two coordinates": (STEP | {"landmarks": [[0, 0]]}, "landmarks[0]"),
    "no quaternion": (
        STEP | {"wrist": {"position": [0, 0, 0], "quat_xyzw": [0, 0, 0, 0]}},
        "wrist.quat_xyzw",
    ),
    "half a wrist": (STEP | {"wrist": {"position": [0, 0, 0]}}, "wrist"),
    "unknown field": (STEP | {"angles": [0.0]}, "angles"),
    "missing field": (
        {key: value for key, value in STEP.items() if key != "time"},
        "time",
    ),
    "unknown type": (STEP | {"type": "jump"}, "type"),
    "no number of the request": (STEP | {"seq": 0}, "seq"),
    "unknown choice": (OPEN | {"side": "up"}, "side"),
    "out of range": (OPEN | {"watchdog": -1.0}, "watchdog"),
    "a path for a name": (OPEN | {"name": "../../etc"}, "name"),
    "robot position not a number": (OPEN | {"robot_q": [NAN]}, "robot_q[0]"),
}


@pytest.mark.parametrize(("message", "field"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_mistake_is_answered_with_the_field_and_the_number_of_the_request(
    message: dict[str, Any], field: str
) -> None:
    answer = decode_request(msgspec.msgpack.encode(message))
    assert isinstance(answer, Error)
    assert (answer.code, answer.field) == ("invalid", field)
    assert answer.seq == message["seq"]


def test_every_pose_of_a_request_is_checked() -> None:
    wrong = {"position": [0, 0, 0], "quat_xyzw": [0, 0, 0, 2]}
    checked = 0
    for kind in get_args(AnyRequest):
        name = kind.__struct_config__.tag
        base = OPEN if name == "open" else STEP
        needed = {field.encode_name for field in fields(kind) if field.required}
        message = {key: value for key, value in base.items() if key in needed}
        for field in fields(kind):
            if Pose not in get_args(field.type):
                continue
            checked += 1
            payload = message | {"type": name, field.name: wrong}
            answer = decode_request(msgspec.msgpack.encode(payload))
            assert isinstance(answer, Error)
            assert answer.field == f"{field.name}.quat_xyzw"
    assert checked >= 8
    hands = {"left": {"wrist": wrong}}
    payload = msgspec.msgpack.encode(STEP | {"hands": hands})
    answer = decode_request(payload)
    assert isinstance(answer, Error)
    assert answer.field == "hands.left.wrist.quat_xyzw"


def test_a_sample_is_a_step_without_an_answer() -> None:
    request = decode_request(msgspec.msgpack.encode(STEP | {"type": "sample"}))
    assert isinstance(request, Sample)
    assert isinstance(request, Step)


@pytest.mark.parametrize(
    "message", [STEP | {"protocol": 9}, STEP | {"protocol": 9, "new": 1}]
)
def test_another_version_of_the_messages_is_named_as_such(
    message: dict[str, Any],
) -> None:
    answer = decode_request(msgspec.msgpack.encode(message))
    assert isinstance(answer, Error)
    assert (answer.code, answer.field, answer.seq) == ("protocol", "protocol", 7)


@given(st.binary(max_size=200))
def test_no_bytes_do_more_than_be_refused(payload: bytes) -> None:
    answer = decode_request(payload)
    assert isinstance(answer, Error)
    # The answer can always be encoded.
    encode_reply(answer)


@given(st.data())
def test_a_truncated_or_altered_message_is_read_or_refused(data: st.DataObject) -> None:
    whole = bytearray(msgspec.msgpack.encode(data.draw(st.sampled_from([STEP, OPEN]))))
    cut = data.draw(st.integers(0, len(whole)))
    for place in data.draw(st.lists(st.integers(0, len(whole) - 1), max_size=3)):
        whole[place] = data.draw(st.integers(0, 255))
    assert isinstance(decode_request(bytes(whole[:cut])), AnyRequest | Error)


@pytest.mark.parametrize("place", range(0, 130, 3))
def test_text_that_is_no_utf8_is_refused(place: int) -> None:
    # At any place, also where only the number of the request is decoded.
    payload = bytearray(
        msgspec.msgpack.encode(STEP | {"session": "s" * 60, "other": "x"})
    )
    payload[place : place + 2] = b"\xff\xfe"
    assert isinstance(decode_request(bytes(payload)), Error)


def test_deep_nesting_is_refused() -> None:
    deep = b"\x91" * 100_000
    assert isinstance(decode_request(deep), Error)


@pytest.mark.parametrize("text", ["{", "[" * 10_000, str(10**30), "\ud800 text", "NaN"])
def test_text_that_cannot_be_a_message_is_refused(text: str) -> None:
    assert isinstance(decode_request(_from_json(text)), Error)
    assert isinstance(decode_request(text.encode(errors="replace")), Error)


def test_json_and_msgpack_say_the_same() -> None:
    for message in (STEP, OPEN):
        text, binary = json.dumps(message), msgspec.msgpack.encode(message)
        assert decode_request(_from_json(text)) == decode_request(binary)


def test_the_schema_names_every_message_and_field() -> None:
    text = messages.schema_text()
    for kind in (*get_args(AnyRequest), *get_args(AnyReply)):
        assert f"### `{kind.__struct_config__.tag}`" in text
        for field in kind.__struct_fields__:
            assert f"`{field}`" in text


def test_the_schema_describes_every_field_and_option() -> None:
    rows = [
        line for line in messages.schema_text().splitlines() if line.startswith("| `")
    ]
    assert all(row.rstrip(" |").count("|") == 4 for row in rows), [
        row for row in rows if row.rstrip(" |").count("|") != 4
    ]
    for option in known_options():
        assert any(row.startswith(f"| `{option}` |") for row in rows)


def test_the_table_of_what_stops_a_robot_has_all_states_and_requests() -> None:
    requests = {kind.__struct_config__.tag for kind in get_args(AnyRequest)}
    named = [name for row in messages.STOPPING for name in (*row.requests, *row.former)]
    assert {*named} <= requests
    assert len({*named}) == len(named)
    states = {state.mode for state in SessionState} | {"calibrating"}
    modes = [mode for row in messages.STOPPING for mode in row.modes]
    assert sorted(modes) == sorted(states)
    # A command has the outcome of its sample, or the state in which no sample moves the robot.
    marks = [mark for row in messages.STOPPING for mark in row.marks]
    assert sorted(marks) == sorted({*STATUS_NAMES} | states - {"waiting", "following"})


def test_the_descriptions_of_mode_and_status_have_all_of_their_values() -> None:
    for kind, field, column in ((State, "mode", "modes"), (Command, "status", "marks")):
        text = messages.schema_text().split(f"### `{kind.__struct_config__.tag}`")[1]
        (row,) = re.findall(rf"^\| `{field}` .*", text.split("###")[0], re.MULTILINE)
        named = {one for part in messages.STOPPING for one in getattr(part, column)}
        assert named <= {*re.findall(r"\w+", row)}


def test_a_former_name_is_read_as_what_it_is_called_now() -> None:
    for former, kind in (("clutch", Engage), ("release", Disengage)):
        head = {"protocol": 1, "seq": 1, "session": "x" * 16}
        request = decode_request(msgspec.msgpack.encode(head | {"type": former}))
        assert isinstance(request, kind)
    opened = decode_request(msgspec.msgpack.encode(OPEN | {"resume": "clutch"}))
    assert isinstance(opened, Open)
    assert opened.resume == "engage"


def test_the_files_that_the_command_prints_are_those_of_today() -> None:
    for file, text in messages.files().items():
        assert file.read_text(encoding="utf-8") == text + "\n", (
            "run python docs/messages.py"
        )


def test_the_json_schema_accepts_what_is_sent() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft202012Validator(json.loads(messages.json_schema()))
    validator.validate(STEP)
    validator.validate(OPEN)
    assert not validator.is_valid(STEP | {"q": ["x"]})


def test_bounds_of_numbers_are_written_as_numbers() -> None:
    # `typing` takes Meta(ge=0) for Meta(ge=0.0), whichever came first: the page would depend on it.
    def check(schema: dict[str, Any]) -> dict[str, Any]:
        if schema.get("type") == "number":
            bounds = [value for key, value in schema.items() if "imum" in key.lower()]
            assert all(isinstance(bound, float) for bound in bounds), schema
        return schema

    json.loads(messages.json_schema(), object_hook=check)


@given(st.builds(motion_of, rotations, translations))
def test_poses_survive_both_ways(matrix: np.ndarray) -> None:
    back = to_pose(matrix)
    assert back is not None
    assert np.allclose(back.matrix, matrix, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_have_a_quaternion_too(axis: int) -> None:
    rotation = -np.eye(3)
    rotation[axis, axis] = 1.0
    pose = to_pose(motion_of(rotation, np.zeros(3)))
    assert pose is not None
    assert np.abs(pose.quat_xyzw).tolist() == np.eye(4)[axis].tolist()


def test_flags_and_codes_are_single_words() -> None:
    assert all(word.isidentifier() for word in (*messages.FLAGS, *messages.CODES))
