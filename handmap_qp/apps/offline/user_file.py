"""Mappings of a user's file, by `FILE.py` or `FILE.py:NAME`: `read_user_mapping`.

NAME is one of these:

- a method: an object with `bind`, such as a `handmap_qp.CustomMethod`; its class, if that needs no
  arguments; or a `Preset`. The QP of this package moves the robot.
- a function from landmarks (21, 3) [m] to joint positions [rad or m].
- a callable that takes the person's hand and the robot, and returns a method or a function. It is
  called for each recording, so that state such as a filter's starts again.

`FILE.py` alone is enough if the file defines one of them.
"""

import inspect
import sys
import traceback
from contextlib import redirect_stdout
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from handmap_core.errors import HandmapError, InvalidInputError, did_you_mean, expect
from handmap_qp.hands import Hand
from handmap_qp.mapping import LandmarkFunction, Method, Preset

Mapping = Method | Preset | LandmarkFunction
"""What a user may give in place of the name of a preset."""
_MODULE = "handmap_user_file"
"""Name under which a user's file is imported."""
_KINDS = (
    "a method with `bind` (handmap_qp.CustomMethod), or a function from landmarks (21, 3) to joint "
    "angles"
)


class UserCodeError(HandmapError):
    """Code of a user cannot be used, or raised an error.

    Attributes:
        name: Its name, as on the command line.
    """

    def __init__(self, name: str, problem: str) -> None:
        super().__init__(f"{name}: {problem}")
        self.name = name


class UserMapping(NamedTuple):
    """A mapping that a user's file defines.

    Attributes:
        name: Its name, as on the command line.
        file: The file.
        defined: What the file defines: see the top of this file.
    """

    name: str
    file: Path
    defined: object

    @property
    def is_for_one_hand(self) -> bool:
        """Whether it is a function of landmarks alone, whose joints are those of one robot."""
        is_method = isinstance(self.defined, Method | Preset)
        return not is_method and _arguments_of(self.defined) == 1

    def for_hands(self, human: Hand, robot: Hand) -> object:
        """Return the method or function for two hands.

        Raises:
            UserCodeError: If the user's code raises an error.
        """
        made = self.defined
        if isinstance(made, type) and isinstance(made, Method):
            return self.run(made)
        if self.is_for_one_hand or isinstance(made, Method | Preset):
            return made
        return self.run(made, human, robot)

    def run(self, function: object, *arguments: object) -> object:
        """Call code of the user.

        Raises:
            HandmapError: As the code raises it.
            UserCodeError: If it raises another error; the message has its line.
        """
        assert callable(function)
        try:
            return function(*arguments)
        except HandmapError as error:
            raise UserCodeError(self.name, str(error)) from error
        except Exception as error:
            raise self.failed(error) from error

    def failed(self, error: BaseException) -> UserCodeError:
        """Return an error of the user's code as one line, with the line of the file."""
        return UserCodeError(self.name, described(error, self.file))


def is_user_file(name: str) -> bool:
    """Return whether a name on the command line is `FILE.py` or `FILE.py:NAME`."""
    file, _, _ = name.rpartition(":")
    return name.endswith(".py") or file.endswith(".py")


def read_user_mapping(name: str, argument: str = "--methods") -> UserMapping:
    """Run a user's file, and return the mapping that it defines.

    Args:
        name: `FILE.py:NAME`, or `FILE.py` if it defines one mapping.
        argument: The argument, for messages.

    Raises:
        InvalidInputError: If there is no such file or name, or it is no mapping.
        UserCodeError: If the file raises an error.
    """
    place, _, attribute = (
        (name, "", "") if name.endswith(".py") else name.rpartition(":")
    )
    file = Path(place)
    expect(file.is_file(), argument, "a file that exists", got=place)
    defined = {
        key: value
        for key, value in vars(_imported(file)).items()
        if not key.startswith("_")
    }
    if not attribute:
        attribute = _only_mapping(name, file, defined, argument)
    elif attribute not in defined:
        raise InvalidInputError(
            f"{file} does not define {attribute}",
            argument=argument,
            advice=did_you_mean(attribute, defined) or _listed(defined),
        )
    found = defined[attribute]
    if isinstance(found, type) and inspect.isabstract(found):
        problem = f"{attribute} does not define targets"
        raise UserCodeError(name, f"{problem}, the one function that it must have")
    is_method = isinstance(found, Method | Preset)
    if not is_method and _arguments_of(found) not in (1, 2):
        got = f"{attribute} = {found!r:.60}"
        if callable(found):
            got = f"{attribute} with {_arguments_of(found)} arguments"
        raise InvalidInputError(argument=argument, expected=_KINDS, got=got)
    return UserMapping(name, file, found)


def described(error: BaseException, file: Path) -> str:
    """Return an error in one line: the last line of a file that it came through, and what it is."""
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if Path(frame.filename).absolute() == file.absolute()
    ]
    if isinstance(error, SyntaxError) and error.lineno:
        lines.append(error.lineno)
    where = f"line {lines[-1]}: " if lines else ""
    what = error.msg if isinstance(error, SyntaxError) else str(error)
    return " ".join(f"{where}{type(error).__name__}: {what}".split())


def _imported(file: Path) -> ModuleType:
    """Import a file as Python runs a script: with its folder on the path."""
    spec = spec_from_file_location(_MODULE, file)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    # Dataclasses and msgspec look up their module there.
    sys.modules[_MODULE] = module
    folder = str(file.absolute().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        # Output of commands is theirs.
        with redirect_stdout(sys.stderr):
            spec.loader.exec_module(module)
    except SystemExit as error:
        advice = "put what must not run on import below `if __name__ == '__main__':`"
        problem = f"{described(error, file)}: {advice}"
        raise UserCodeError(str(file), problem) from error
    except Exception as error:
        raise UserCodeError(str(file), described(error, file)) from error
    return module


def _only_mapping(
    name: str, file: Path, defined: dict[str, object], argument: str
) -> str:
    """Return the name of the one mapping that a file defines.

    Objects come before classes, and methods before functions.

    Raises:
        InvalidInputError: If it defines none, or several.
    """
    own = {
        key: value
        for key, value in defined.items()
        if not callable(value) or value.__module__ == _MODULE
    }
    methods = {k: v for k, v in own.items() if isinstance(v, Method | Preset)}
    objects = [key for key, value in methods.items() if not isinstance(value, type)]
    classes = [key for key, v in methods.items() if not inspect.isabstract(v)]
    functions = [
        key
        for key, value in own.items()
        if inspect.isfunction(value) and _arguments_of(value) == 1
    ]
    found = objects or classes or [*methods] or functions
    if not found:
        raise InvalidInputError(
            f"{file} defines no mapping",
            argument=argument,
            expected=_KINDS,
            advice=f"write {_KINDS}",
        )
    if len(found) > 1:
        raise InvalidInputError(
            f"{file} defines several mappings: {', '.join(found)}",
            argument=argument,
            advice=f"name one, as {name}:{found[0]}",
        )
    return found[0]


def _listed(defined: dict[str, object]) -> str:
    """Return the names of a file that may be mappings."""
    names = [
        key
        for key, value in defined.items()
        if callable(value) and value.__module__ == _MODULE
    ]
    return f"it defines {', '.join(names)}" if names else "it defines nothing"


def _arguments_of(value: object) -> int:
    """Return how many arguments a callable needs; 0 if it is none, or its arguments are unknown."""
    if not callable(value):
        return 0
    try:
        parameters = inspect.signature(value).parameters.values()
    except (TypeError, ValueError):
        return 0
    kinds = inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return sum(p.kind in kinds and p.default is p.empty for p in parameters)
