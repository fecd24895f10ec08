"""All that the README tells a reader to type works, in its order, after its own install line.

The environment is fresh: the package's wheels with the extras that the line names, and nothing
else. That installs half a gigabyte of packages, so `make full` does it.
`make demo` and `make test` make the environment that these tests run in.
"""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest
from paths.fresh import wheels
from readme_steps import README, count_steps, environment_of, run, run_steps, steps

MOST_WORDS = 700
COMMANDS = [step.command for step in steps() if step.command]
(INSTALL,) = (line for line in COMMANDS if line.startswith("pip install"))


@pytest.fixture(scope="module")
def environment(
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, str]:
    """An environment that has what the README's install line installs."""
    folder = tmp_path_factory.mktemp("environment")
    variables = environment_of(folder)
    run([sys.executable, "-m", "venv", str(folder)], folder, variables)
    core, library = shlex.split(INSTALL)[2:]
    assert core == "./core"
    # The checkout as wheels, which other tests have perhaps built.
    core_wheel, library_wheel = map(str, wheels())
    library = library.replace(".", library_wheel, 1)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    run([*pip, core_wheel, library], folder, variables)
    return variables


@pytest.mark.slow
@pytest.mark.full
def test_every_step_works_in_the_order_of_the_page(
    environment: dict[str, str], tmp_path: Path
) -> None:
    assert run_steps(tmp_path, environment) == count_steps()
    assert (tmp_path / "demo" / "gestures.png").is_file()
    assert (tmp_path / "hand_allegro_right.npz").is_file()


def test_the_page_is_short() -> None:
    assert len(README.split()) <= MOST_WORDS


@pytest.mark.slow
@pytest.mark.full
def test_commands_outside_of_blocks_exist(environment: dict[str, str]) -> None:
    for words in set(re.findall(r"`handmap ([a-z ]+)`", README)):
        run(["handmap", *words.split(), "--help"], Path.cwd(), environment)
