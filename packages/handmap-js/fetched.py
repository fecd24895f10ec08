"""Libraries of JavaScript that the playground takes from npm, checked by their hash."""

from __future__ import annotations

import hashlib
import io
import sys
import tarfile
import urllib.request
from pathlib import Path
from typing import NamedTuple


class Library(NamedTuple):
    """A package of npm.

    Attributes:
        name: Its name.
        version: The version that is taken.
        sha512: Hash of its archive, in hexadecimal.
        files: What is taken of it, and where it goes beside the page.
    """

    name: str
    version: str
    sha512: str
    files: dict[str, str]

    @property
    def address(self) -> str:
        """Where its archive is."""
        short = self.name.rpartition("/")[2]
        return f"https://registry.npmjs.org/{self.name}/-/{short}-{self.version}.tgz"


THREE = Library(
    "three",
    "0.187.0",
    "422bbb47e0a687c0acb59b18d6e24e4969d595fa3b66d34b57b985f0996d9372"
    "c1dc0b43bbd71166572744a90093c638cfa28ac37e73ed8ed4addee3598f1eb4",
    {
        "build/three.module.js": "three/three.module.js",
        "build/three.core.js": "three/three.core.js",
        "examples/jsm/controls/OrbitControls.js": "three/OrbitControls.js",
        "LICENSE": "three/LICENSE",
    },
)

VISION = Library(
    "@mediapipe/tasks-vision",
    "1.1.0",
    "649aa1d3030a388368adf49f7ef0c0c73c8ed7ffdcf85886dc893339d3439cba"
    "af041dc36cc7e3d1b07fb72b3648d7fd4bdd78b20a086c8a45e074ce8b7dfa72",
    {
        "vision_bundle.mjs": "vision/vision_bundle.mjs",
        "wasm/vision_wasm_internal.js": "vision/wasm/vision_wasm_internal.js",
        "wasm/vision_wasm_internal.wasm": "vision/wasm/vision_wasm_internal.wasm",
        "wasm/vision_wasm_module_internal.js": "vision/wasm/vision_wasm_module_internal.js",
        "wasm/vision_wasm_module_internal.wasm": "vision/wasm/vision_wasm_module_internal.wasm",
    },
)


def fetch(library: Library, cache: Path, target: Path) -> None:
    """Take files of a library; its archive is kept, so that the next time needs no network.

    Args:
        library: The library.
        cache: Folder of archives.
        target: Folder of the page.

    Raises:
        SystemExit: If it cannot be had, or is not what it was.
    """
    file = cache / library.address.rpartition("/")[2]
    if not file.is_file():
        cache.mkdir(parents=True, exist_ok=True)
        try:
            with urllib.request.urlopen(library.address, timeout=60.0) as answer:
                content = answer.read()
        except OSError as error:
            sys.exit(f"playground: {library.address} cannot be fetched ({error})")
        file.write_bytes(content)
    content = file.read_bytes()
    if hashlib.sha512(content).hexdigest() != library.sha512:
        file.unlink()
        sys.exit(f"playground: {library.address} is not what it was: another hash")
    with tarfile.open(fileobj=io.BytesIO(content)) as archive:
        for source, place in library.files.items():
            member = archive.extractfile(f"package/{source}")
            assert member
            to = target / place
            to.parent.mkdir(parents=True, exist_ok=True)
            to.write_bytes(member.read())
