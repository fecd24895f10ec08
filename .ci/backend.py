"""The build backend: hatchling, which also gives metadata to pip without building anything.

hatchling leaves out the two hooks for metadata where pip asks, because hooks of a build may add
dependencies. Ours does not. Without the hooks pip builds the whole wheel to read its metadata, so
that the core compiled for minutes behind the words "Preparing metadata".

Where the machine has no C++ compiler, a build needs one more package, which has one (`compilers`).
"""

from __future__ import annotations

from pathlib import Path
from typing import TypeAlias

from compilers import ZIG, needs_zig
from hatchling.build import (
    build_editable,
    build_sdist,
    build_wheel,
    get_requires_for_build_sdist,
)
from hatchling.builders.wheel import WheelBuilder

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
    "prepare_metadata_for_build_editable",
    "prepare_metadata_for_build_wheel",
]

ConfigSettings: TypeAlias = "dict[str, str | list[str]] | None"


def get_requires_for_build_wheel(
    config_settings: ConfigSettings = None,
) -> list[str]:
    """Return what a build of the wheel needs besides what pyproject.toml names (PEP 517)."""
    del config_settings
    return [ZIG] if needs_zig() else []


def get_requires_for_build_editable(
    config_settings: ConfigSettings = None,
) -> list[str]:
    """Return the same for an editable install (PEP 660)."""
    return get_requires_for_build_wheel(config_settings)


def prepare_metadata_for_build_wheel(
    metadata_directory: str, config_settings: ConfigSettings = None
) -> str:
    """Write METADATA into a folder of its own; return the folder's name (PEP 517)."""
    del config_settings
    builder = WheelBuilder(str(Path.cwd()))
    folder = Path(metadata_directory, f"{builder.artifact_project_id}.dist-info")
    folder.mkdir(exist_ok=True)
    metadata = builder.config.core_metadata_constructor(builder.metadata)
    (folder / "METADATA").write_text(metadata, encoding="utf-8")
    return folder.name


def prepare_metadata_for_build_editable(
    metadata_directory: str, config_settings: ConfigSettings = None
) -> str:
    """Write the metadata of an editable install, which has that of a wheel (PEP 660)."""
    return prepare_metadata_for_build_wheel(metadata_directory, config_settings)
