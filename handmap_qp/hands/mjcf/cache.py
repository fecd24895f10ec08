"""URDFs of MJCF files that a description refers to, kept in the user's cache: `cached_urdf`."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import tempfile
from pathlib import Path

from handmap_qp.errors import HandError
from handmap_qp.hands.mjcf.convert import convert_mjcf, write_converted

# Counts changes of the conversion, so that URDFs of an earlier one are not used.
_CONVERSION = 2


def cached_urdf(file: Path) -> Path:
    """Return the URDF of an MJCF file, converted again if an XML file beside it has changed.

    Args:
        file: The MJCF file.

    Returns:
        The URDF; its meshes lie beside it.

    Raises:
        HandError: If MuJoCo cannot compile the file, or the cache cannot be written.
    """
    folder = cache_folder() / f"{file.stem}-{_fingerprint(file)}"
    urdf = folder / f"{file.stem}.urdf"
    if urdf.is_file():
        return urdf
    converted = convert_mjcf(file)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Another process may convert the same file: the first complete folder stays.
        temporary = Path(tempfile.mkdtemp(dir=folder.parent))
        write_converted(converted, temporary / urdf.name)
        try:
            temporary.rename(folder)
        except OSError:
            if not urdf.is_file():
                raise
    except OSError as error:
        reason = error.strerror or error
        raise HandError(f"the cache {folder} cannot be written: {reason}", file=file) from error
    return urdf


def cache_folder() -> Path:
    """Return the folder of converted URDFs: in `$XDG_CACHE_HOME`, else in `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "handmap_qp" / "mjcf"


def _fingerprint(file: Path) -> str:
    """Return a digest of the file's path, the XML files beside it, and the versions at work."""
    versions = [importlib.metadata.version(name) for name in ("handmap-qp", "mujoco")]
    parts = [str(file.resolve()), *versions, str(_CONVERSION)]
    for other in sorted(file.parent.glob("*.xml")):
        stat = other.stat()
        parts.append(f"{other.name} {stat.st_size} {stat.st_mtime_ns}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]
