"""Where the package's hands lie on disk."""

from __future__ import annotations

from pathlib import Path


def urdf_directory() -> Path:
    """The folder with one subfolder per hand.

    Inside the package when installed from a wheel, beside it in a checkout.
    """
    package = Path(__file__).resolve().parents[2]
    installed = package / "urdf"
    return installed if installed.is_dir() else package.parent / "urdf"
