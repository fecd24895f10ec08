"""The addresses of the repository, for the metadata of all packages.

GitHub Actions names the repository by GITHUB_SERVER_URL and GITHUB_REPOSITORY. Elsewhere no address
is known, and nothing is written.

    python .ci/addresses.py core         # writes the addresses into the sources of a package
    python .ci/addresses.py --check dist # fails if a wheel or an sdist of a folder has no address

The metadata of the library is written by hatchling's hook, `.ci/metadata.py`. It needs nothing but
Python, because it runs on the host before a build in a container, which has no such variables.
"""

from __future__ import annotations

import argparse
import os
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path


def repository() -> str:
    """Return the address of the repository, or an empty text outside of GitHub Actions."""
    server, name = (
        os.environ.get(f"GITHUB_{part}", "") for part in ("SERVER_URL", "REPOSITORY")
    )
    return f"{server}/{name}" if server and name else ""


def addresses(address: str) -> dict[str, str]:
    """Return the pages of a repository by the labels that package indexes know."""
    pages = {"Source": "", "Issues": "/issues", "Changelog": "/blob/main/CHANGELOG.md"}
    return {label: f"{address}{page}" for label, page in pages.items()}


def write_addresses(package: Path, address: str) -> None:
    """Write the addresses into pyproject.toml, or setup.cfg and package.xml, of a package.

    A file that has them is left as it is, so a second call changes nothing.
    """
    urls = addresses(address)
    project = package / "pyproject.toml"
    if "\n[project]\n" in project.read_text("utf-8"):
        rows = "\n".join(f'{label} = "{url}"' for label, url in urls.items())
        _append(project, "\n[project.urls]\n", f"{rows}\n")
        return
    rows = "\n".join(f"    {label} = {url}" for label, url in urls.items())
    _append(package / "setup.cfg", "[metadata]\n", f"project_urls =\n{rows}\n")
    manifest = package / "package.xml"
    text = manifest.read_text("utf-8")
    kinds = {"repository": urls["Source"], "bugtracker": urls["Issues"]}
    rows = "".join(f'  <url type="{kind}">{url}</url>\n' for kind, url in kinds.items())
    if "<url " not in text:
        last = "</license>\n"
        manifest.write_text(text.replace(last, f"{last}{rows}", 1), "utf-8")


def without_address(folder: Path) -> list[str]:
    """Return the names of the wheels and sdists of a folder that have no Project-URL."""
    files = [*folder.glob("*.whl"), *folder.glob("*.tar.gz")]
    return sorted(file.name for file in files if not _project_urls(file))


def _append(file: Path, head: str, rows: str) -> None:
    """Append a table to a file, unless it has it."""
    text = file.read_text("utf-8")
    if head not in text:
        file.write_text(f"{text}{head}{rows}", "utf-8")


def _project_urls(file: Path) -> list[str]:
    """Return the fields Project-URL of a wheel or an sdist."""
    if file.suffix == ".whl":
        with zipfile.ZipFile(file) as wheel:
            (name,) = (
                name
                for name in wheel.namelist()
                if name.endswith(".dist-info/METADATA")
            )
            data = wheel.read(name)
    else:
        with tarfile.open(file) as sdist:
            stream = sdist.extractfile(f"{file.name.removesuffix('.tar.gz')}/PKG-INFO")
            data = stream.read() if stream else b""
    return message_from_bytes(data).get_all("Project-URL") or []


def main() -> None:
    """Write the addresses into a package, or check the wheels and sdists of a folder."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true")
    parser.add_argument("folder", type=Path)
    words = parser.parse_args()
    if not words.check:
        if address := repository():
            write_addresses(words.folder, address)
        return
    if not [*words.folder.glob("*.whl")]:
        sys.exit(f"{words.folder}: no wheel")
    if missing := without_address(words.folder):
        sys.exit(f"No Project-URL: {', '.join(missing)}")


if __name__ == "__main__":
    main()
