"""An OpenXR runtime of our own, and the bridge in it: `python openxr_runtime.py FOLDER WORDS...`.

The loader of OpenXR wants a shared library, so that of a few lines of C hands over to the functions
here. `joints.npy` of the folder is what it shows: poses of 26 joints (n, 2, 26, 7) of the left and
the right hand, NaN where a hand is not seen. It shows each once, and then ends the session.
"""

from __future__ import annotations

import ctypes
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import xr

SHIM = r"""
#include <stddef.h>
#include <stdint.h>

static void *lookup;

struct request {
    int kind;
    uint32_t version;
    size_t size;
    uint32_t interface;
    uint64_t api;
    void *lookup;
};

void set_lookup(void *given) { lookup = given; }

int xrNegotiateLoaderRuntimeInterface(const void *loader, struct request *request)
{
    request->interface = 1;
    request->api = (uint64_t)1 << 48;
    request->lookup = lookup;
    return 0;
}
"""
EXTENSIONS = [
    b"XR_EXT_hand_tracking",
    b"XR_MND_headless",
    b"XR_KHR_convert_timespec_time",
]
VALID = 3
STATES = [xr.SessionState.IDLE, xr.SessionState.READY]


class Runtime:
    """What the loader asks for, by the names of OpenXR's functions."""

    def __init__(self, joints: np.ndarray, extensions: list[bytes]) -> None:
        self.joints, self.extensions = joints, extensions
        self.events = [*STATES]
        self.shown = [0, 0]
        self.calls: list[str] = []
        self.kept: dict[str, Any] = {}

    def lookup(self, instance: Any, name: bytes, out: Any) -> int:
        word = name.decode()
        call = getattr(self, word, None) or (_make if "xrCreate" in word else None)
        if "xrDestroy" in word or word in ("xrBeginSession", "xrEndSession"):
            call = _accept
        kind = getattr(xr, f"PFN_{word}", None)
        if call is None or kind is None:
            out[0] = None
            return xr.Result.ERROR_FUNCTION_UNSUPPORTED.value

        def noted(*arguments: Any) -> int:
            self.calls.append(word)
            return call(*arguments) or 0

        self.kept.setdefault(word, kind(noted))
        out[0] = ctypes.cast(self.kept[word], ctypes.c_void_p).value
        return 0

    def xrEnumerateInstanceExtensionProperties(
        self, layer: Any, capacity: int, count: Any, properties: Any
    ) -> None:
        count[0] = len(self.extensions)
        for i in range(capacity):
            properties[i].extension_name = self.extensions[i]

    def xrGetInstanceProperties(self, instance: Any, out: Any) -> None:
        out[0].runtime_name = b"of the tests"

    def xrGetSystem(self, instance: Any, info: Any, out: Any) -> None:
        out[0] = 1

    def xrConvertTimespecTimeToTimeKHR(
        self, instance: Any, stamp: Any, out: Any
    ) -> None:
        out[0] = stamp[0].tv_sec * 10**9 + stamp[0].tv_nsec

    def xrCreateHandTrackerEXT(self, session: Any, info: Any, out: Any) -> None:
        # The handle says which hand: 1 is the left one.
        _make(out, value=info[0]._hand)

    def xrPollEvent(self, instance: Any, out: Any) -> int:
        if not self.events and max(self.shown) >= len(self.joints):
            self.events = [xr.SessionState.STOPPING]
        if not self.events:
            return xr.Result.EVENT_UNAVAILABLE.value
        event = xr.EventDataSessionStateChanged(state=self.events.pop(0))
        ctypes.memmove(out, ctypes.byref(event), ctypes.sizeof(event))
        return 0

    def xrLocateHandJointsEXT(self, tracker: Any, info: Any, out: Any) -> int:
        found = out[0]
        if found.joint_count != 26 or "xrBeginSession" not in self.calls:
            return xr.Result.ERROR_VALIDATION_FAILURE.value
        hand = (ctypes.cast(tracker, ctypes.c_void_p).value or 0) - 1
        poses = self.joints[self.shown[hand]]
        self.shown[hand] += 1
        found.is_active = 1
        for place, pose in zip(found.joint_locations, poses[hand], strict=True):
            is_seen = bool(np.isfinite(pose).all())
            place._location_flags = VALID * is_seen
            if is_seen:
                place.pose.position = xr.Vector3f(*pose[:3])
                place.pose.orientation = xr.Quaternionf(*pose[3:])
        return 0


def _accept(*_: Any) -> None:
    pass


def _make(*arguments: Any, value: int = 77) -> None:
    ctypes.cast(arguments[-1], ctypes.POINTER(ctypes.c_void_p))[0] = value


def install(folder: Path, runtime: Runtime) -> Callable[..., Any]:
    """Make the library of the runtime, which is active from now on in this process."""
    source, library = folder / "shim.c", folder / "libruntime.so"
    source.write_text(SHIM)
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source], check=True)
    about = {"name": "of the tests", "library_path": str(library)}
    manifest = folder / "runtime.json"
    manifest.write_text(json.dumps({"file_format_version": "1.0.0", "runtime": about}))
    os.environ["XR_RUNTIME_JSON"] = str(manifest)
    signature = (ctypes.c_int, ctypes.c_void_p, ctypes.c_char_p)
    kind = ctypes.CFUNCTYPE(*signature, ctypes.POINTER(ctypes.c_void_p))
    lookup = kind(runtime.lookup)
    ctypes.CDLL(str(library)).set_lookup(lookup)
    return lookup


def main() -> None:
    folder = Path(sys.argv[1])
    lacking = os.environ.get("LACKING", "").encode()
    offered = [name for name in EXTENSIONS if name != lacking]
    runtime = Runtime(np.load(folder / "joints.npy"), offered)
    _lookup = install(folder, runtime)
    sys.argv[1:2] = []
    from handmap_sources import openxr

    openxr.main()
    print(json.dumps(runtime.calls))


if __name__ == "__main__":
    main()
