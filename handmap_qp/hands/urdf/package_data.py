"""Where the hands of this package lie on disk."""

from __future__ import annotations

from pathlib import Path


def urdf_directory() -> Path:
    """Return the folder with one subfolder per hand.

    It is inside the package when installed from a wheel, and beside it in a checkout.
    """
    package = Path(__file__).resolve().parents[2]
    installed = package / "urdf"
    return installed if installed.is_dir() else package.parent / "urdf"
