"""What packages bring that no other package of an environment needs, in MB.

python needed.py ROOT NAME...    # JSON: of each, of all together, and all that ROOT needs
"""

import json
import sys
from importlib.metadata import PackageNotFoundError, distribution, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def needed(root: str, left_out: set[str]) -> set[str]:
    """Return all installed packages that one needs, without those that are left out."""
    found: set[str] = set()
    seen = set()
    waiting = [Requirement(root)]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if name in left_out or str(wanted) in seen:
            continue
        seen.add(str(wanted))
        try:
            further = map(Requirement, requires(name) or ())
        except PackageNotFoundError:
            continue
        found.add(name)
        extras = wanted.extras or {""}
        waiting += [
            each
            for each in further
            if not each.marker
            or any(each.marker.evaluate({"extra": extra}) for extra in extras)
        ]
    return found


def sizes_of(names: set[str]) -> dict[str, float]:
    """Return the size of packages [MB]."""
    return {
        name: sum(
            Path(file.locate()).stat().st_size
            for file in distribution(name).files or ()
            if Path(file.locate()).is_file()
        )
        / 1e6
        for name in names
    }


def main(root: str, *names: str) -> None:
    """Print the sizes."""
    everything = needed(root, set())
    each = {name: sizes_of(everything - needed(root, {name})) for name in names}
    together = sizes_of(everything - needed(root, {*names}))
    print(json.dumps([each, together, sizes_of(everything)]))


if __name__ == "__main__":
    main(*sys.argv[1:])
