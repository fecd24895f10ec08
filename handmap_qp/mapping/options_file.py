"""Files of options, which `--options` reads and the view writes.

They are YAML, and have the names that `Choice.with_changes` and the service take: `preset`, and
options of its method and of the QP. Options that are not in the file have the values of the preset.

    preset: teleoperation
    pinch_weight: 6.0
    damping: 0.2
"""

from pathlib import Path
from typing import Any

import msgspec
import yaml

from handmap_core.errors import InvalidInputError, did_you_mean
from .presets import Choice, known_options, preset_choice


def read_options(path: Path | str) -> dict[str, Any]:
    """Read a file of options.

    Args:
        path: The file.

    Returns:
        Values by name, as `Choice.with_changes` takes them. Their ranges are not checked here.

    Raises:
        InvalidInputError: If the file cannot be read, is not a table, or has an unknown name;
            `argument` is then that name.
    """
    file = Path(path)
    known = {"preset", *known_options()}
    try:
        table = msgspec.yaml.decode(file.read_bytes(), type=dict[Any, Any])
    except OSError as error:
        problem = f"{file}: cannot be read: {error.strerror or error}"
        raise InvalidInputError(problem, argument="options") from error
    except (msgspec.MsgspecError, ValueError) as error:
        problem = f"{file}: is not a table in YAML: {' '.join(str(error).split())}"
        advice = "write lines such as `preset: teleoperation`"
        raise InvalidInputError(problem, argument="options", advice=advice) from error
    for name in map(str, table.keys() - known):
        raise InvalidInputError(
            f"{file} has an unknown option",
            argument=name,
            advice=did_you_mean(name, known) or "see handmap retarget --help",
        )
    return table


def options_text(choice: Choice, start: Choice | None = None) -> str:
    """Return the text of a file with the options that differ from their preset's.

    Args:
        choice: Preset and options.
        start: The preset with the values that need not be written; its own if omitted.
    """
    start = start or preset_choice(choice.preset)
    changes = {"preset": choice.preset} | start.changes_to(choice)
    return yaml.safe_dump(msgspec.to_builtins(changes), sort_keys=False)
