"""A node of ROS 2 over DDS without a ROS installation: `DdsNode`, on Cyclone DDS.

Topics and types are named as ROS's own middleware does, types are read from rosbags. Services have
the form of `rmw_cyclonedds_cpp`: their requests begin with the number of the client and its own
count, which Fast DDS sends beside the data.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from types import new_class
from typing import Any

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.typesys import Stores, get_typestore

from handmap_qp.apps.arguments import KeyFiles
from handmap_qp.apps.connection import connected
from .bridge import Bridge, Message

_TYPES = get_typestore(Stores.ROS2_HUMBLE).fielddefs
# Basic types that have another name in the interface language of DDS.
_BASIC = {"string": str, "bool": bool, "byte": types.uint8}
_CALLER = {"guid": types.uint64, "seq": types.int64}
_REQUEST = _CALLER | {"structure_needs_at_least_one_member": types.uint8}
_REPLY = _CALLER | {"success": bool, "message": str}

QOS = Qos(
    Policy.Reliability.Reliable(duration(milliseconds=100)),
    Policy.History.KeepLast(10),
    # Other middleware of ROS reads the first version of CDR only.
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
"""Default quality of service of ROS 2: reliable, volatile, the last ten."""


class DdsNode:
    """A node; see `bridge.Node`.

    Args:
        domain: Number of the DDS domain, `ROS_DOMAIN_ID`.
        namespace: Namespace of its topics and services, without slashes at the ends.
    """

    def __init__(self, domain: int, namespace: str) -> None:
        # What ROS looks for at a participant.
        enclave = Qos(Policy.Userdata(b"enclave=/;"))
        self._participant = DomainParticipant(domain, qos=enclave)
        self.domain = domain
        self._namespace = namespace
        self._writers: dict[str, DataWriter] = {}
        self._services: list[Callable[[], None]] = []

    def publish(self, topic: str, message: Message) -> None:
        """Publish a message; a topic without a leading `/` is in the node's namespace."""
        if topic not in self._writers:
            place = topic if topic.startswith("/") else f"/{self._namespace}/{topic}"
            self._writers[topic] = self._end(
                DataWriter, f"rt{place}", struct(message[0])
            )
        self._writers[topic].write(filled(*message))

    def serve(self, name: str, act: Callable[[], str]) -> None:
        """Offer a service; arguments as in `bridge.Node.serve`."""
        asked, told = trigger_types()
        place = f"{self._namespace}/{name}"
        requests = self._end(DataReader, f"rq/{place}Request", asked)
        replies = self._end(DataWriter, f"rr/{place}Reply", told)

        def answer() -> None:
            for request in requests.take(10):
                # Not the note that a client has gone.
                if isinstance(request, asked):
                    problem = act()
                    reply = told(request.guid, request.seq, not problem, problem)
                    replies.write(reply)

        self._services.append(answer)

    def follow(
        self, session: str, source: str, keys: KeyFiles, controller: str
    ) -> None:
        """Publish the commands of a session, and answer requests, until Ctrl-C.

        Raises:
            InvalidInputError: If there is no such service or session.
        """
        with connected("--from", source, keys, refused="SESSION") as client:
            client.watch(session)
        with client, suppress(KeyboardInterrupt):
            bridge = Bridge(self, client, controller)
            print(
                f"{session} is in ROS domain {self.domain}; end by Ctrl-C", flush=True
            )
            while True:
                bridge.spin_once()
                self.answer()

    def answer(self) -> None:
        """Answer the requests that have come."""
        for service in self._services:
            service()

    def _end(self, kind: Any, topic: str, message: Any) -> Any:
        """Return a writer or reader of a topic."""
        participant = self._participant
        return kind(participant, Topic(participant, topic, message, QOS), QOS)


@cache
def struct(name: str) -> Any:
    """Return the DDS type of a message by its name in ROS, such as `std_msgs/msg/Header`."""
    fields = {field: _kind(*about) for field, about in _TYPES[name][1]}
    return _declared(name, fields)


def filled(name: str, fields: Any) -> Any:
    """Return a message, with other messages inside as tuples of their fields."""

    def value(node: Any, about: Any, given: Any) -> Any:
        if node.name == "BASE":
            return given
        if node.name == "NAME":
            return filled(about, given)
        return [value(*about[0], item) for item in given]

    kinds = [about for _, about in _TYPES[name][1]]
    return struct(name)(
        *[value(*kind, f) for kind, f in zip(kinds, fields, strict=True)]
    )


@cache
def trigger_types() -> tuple[Any, Any]:
    """Return the DDS types of request and reply of `std_srvs/srv/Trigger`."""
    place = "std_srvs/srv/Trigger"
    return _declared(f"{place}_Request", _REQUEST), _declared(
        f"{place}_Response", _REPLY
    )


def _declared(name: str, fields: dict[str, Any]) -> Any:
    package, group, short = name.split("/")
    full = {"typename": f"{package}::{group}::dds_::{short}_"}
    body = {"__annotations__": fields, "__module__": __name__}
    return dataclass(new_class(short, (IdlStruct,), full, lambda own: own.update(body)))


def _kind(node: Any, about: Any) -> Any:
    """Return the DDS type of a field: basic, a message, or a sequence of one of them."""
    match node.name:
        case "BASE":
            return _BASIC.get(about[0]) or getattr(types, about[0])
        case "NAME":
            return struct(about)
    return types.sequence[_kind(*about[0])]
