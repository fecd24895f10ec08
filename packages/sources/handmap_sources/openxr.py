"""Send the hands of an OpenXR runtime by UDP: a program of its own, where the runtime is.

It imports nothing of handmap_qp. On a PC with the runtime of a headset, copy this file there:

    pip install pyopenxr
    python openxr.py --right 192.168.1.5:5580 --left 192.168.1.5:5581

On the machine with handmap, `handmap track datagrams udp://:5580 --layout openxr26` takes the
right hand. Joints are in the LOCAL space of the runtime [m]: y up, -z forward.
"""

import argparse
import ctypes
import json
import socket
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import Any

try:
    import xr
except ImportError as problem:
    sys.exit(f"openxr: {problem}: pip install pyopenxr")

PERIOD = 1.0 / 90.0
"""Time between two samples [s]."""
JOINTS = 26
_IS_WINDOWS = sys.platform == "win32"
_CLOCK = "win32_convert_performance_counter" if _IS_WINDOWS else "convert_timespec"
NEEDED = {"XR_EXT_hand_tracking", "XR_MND_headless", f"XR_KHR_{_CLOCK}_time"}
"""Extensions: joints, a session without pictures, and the present time."""
_VALID = (
    xr.SpaceLocationFlags.POSITION_VALID_BIT
    | xr.SpaceLocationFlags.ORIENTATION_VALID_BIT
)
_Joints = list[tuple[float, ...]]


def hands(sides: Sequence[str]) -> Iterator[list[_Joints]]:
    """Yield the joints of each hand, until the runtime ends the session.

    Joints are position [m] and quaternion x, y, z, w; there are none of a hand that is not seen.
    """
    offered = xr.enumerate_instance_extension_properties()
    if missing := NEEDED - {each.extension_name.decode() for each in offered}:
        sys.exit(f"openxr: the OpenXR runtime lacks {', '.join(sorted(missing))}")
    with ExitStack() as closing:
        keep = closing.enter_context
        wanted = xr.InstanceCreateInfo(enabled_extension_names=sorted(NEEDED))
        instance = keep(xr.create_instance(wanted))
        system = xr.SessionCreateInfo(system_id=xr.get_system(instance))
        session = keep(xr.create_session(instance, system))
        place = xr.ReferenceSpaceCreateInfo(xr.ReferenceSpaceType.LOCAL)
        space = keep(xr.create_reference_space(session, place))
        trackers = []
        for side in sides:
            which = xr.HandTrackerCreateInfoEXT(xr.HandEXT[side.upper()])
            trackers.append(keep(xr.create_hand_tracker_ext(session, which)))
        while _goes_on(instance, session):
            info = xr.HandJointsLocateInfoEXT(space, _now(instance))
            yield [_joints(tracker, info) for tracker in trackers]
            time.sleep(PERIOD)


def _goes_on(instance: Any, session: Any) -> bool:
    """Begin the session when the runtime is ready; return False when it is to end."""
    while True:
        try:
            event = xr.poll_event(instance)
        except xr.EventUnavailable:
            return True
        if event.type is xr.StructureType.EVENT_DATA_SESSION_STATE_CHANGED:
            kind = ctypes.POINTER(xr.EventDataSessionStateChanged)
            state = ctypes.cast(ctypes.byref(event), kind).contents.state
            if state is xr.SessionState.READY:
                xr.begin_session(session, xr.SessionBeginInfo())
            elif state.value >= xr.SessionState.STOPPING.value:
                return False


def _now(instance: Any) -> Any:
    """Return the present in the runtime's time."""
    # What differs from system to system is not on all of them.
    there: Any = xr
    if _IS_WINDOWS:
        windows: Any = ctypes
        count = ctypes.c_longlong()
        windows.windll.kernel32.QueryPerformanceCounter(ctypes.byref(count))
        return there.convert_win32_performance_counter_to_time_khr(instance, count)
    stamp = there.timespec(*divmod(time.monotonic_ns(), 10**9))
    return there.convert_timespec_time_to_time_khr(instance, stamp)


def _joints(tracker: Any, info: Any) -> _Joints:
    """Return the joints of a hand if all are valid.

    pyopenxr's own function for it gives the runtime no room for them.
    """
    places = (xr.HandJointLocationEXT * JOINTS)()
    found = xr.HandJointLocationsEXT(joint_locations=places)
    function = xr.get_instance_proc_addr(tracker.instance, "xrLocateHandJointsEXT")
    locate = ctypes.cast(function, xr.PFN_xrLocateHandJointsEXT)
    code = locate(tracker, info, ctypes.byref(found))
    result = xr.check_result(xr.Result(code))
    if result.is_exception():
        raise result
    if not found.is_active or any(_VALID & ~each.location_flags for each in places):
        return []
    return [(*each.pose.position, *each.pose.orientation) for each in places]


def address(text: str) -> tuple[str, int]:
    """Return host and port of HOST:PORT; ValueError for other words."""
    host, port = text.split(":")
    if not 0 < int(port) < 1 << 16:
        raise ValueError(port)
    return host, int(port)


def main() -> None:
    """Send until Ctrl-C, or until the runtime ends the session."""
    parser = argparse.ArgumentParser(description="Send OpenXR hands by UDP.")
    for side in ("right", "left"):
        about = f"where to send the {side} hand"
        parser.add_argument(f"--{side}", type=address, metavar="HOST:PORT", help=about)
    arguments = vars(parser.parse_args())
    given = {side: to for side, to in arguments.items() if to}
    if not given:
        parser.error("give --right HOST:PORT, --left HOST:PORT or both")
    try:
        with socket.socket(type=socket.SOCK_DGRAM) as sender:
            for seen in hands([*given]):
                for (side, to), joints in zip(given.items(), seen, strict=True):
                    about = {"time": time.monotonic(), "side": side}
                    sample = about | {"valid": bool(joints), "joints": joints}
                    packet = json.dumps(sample)
                    sender.sendto(packet.encode(), to)
    except KeyboardInterrupt:
        pass
    except (xr.XrException, OSError) as error:
        sys.exit(f"openxr: {error}")


if __name__ == "__main__":
    main()
