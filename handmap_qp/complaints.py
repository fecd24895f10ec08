"""Say in one line what is wrong with the words of a command: what, expected, got, what to do.

tyro's own messages are boxes of several lines that repeat the help. Here they are taken apart, and
completed from the command's help page. A message of a form that is not known stays as it is.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from handmap_qp.errors import InvalidInputError, InvalidOptionsError, did_you_mean

_TYPES = {"INT": "a whole number", "FLOAT": "a number", "STR": "a value", "PATH": "a path"}
_BORDER = " │╭╮╰╯─"
_UNUSABLE = (
    r"(?:Error parsing|invalid choice .* for argument|Missing value for argument)"
    r" [('\"]*(--[\w.-]*\w|[A-Z]+\b)"
)
"""tyro's messages about the value of one option or positional argument."""


def explained(box: str, page: str, words: Sequence[str], advice: str) -> InvalidInputError:
    """Return the error that tyro's message stands for.

    Args:
        box: What tyro printed on stderr.
        page: The command's help page.
        words: The words given to the command.
        advice: What to do where nothing better is known.
    """
    text = _message(box)
    if text.startswith("Unrecognized"):
        return _unknown(text.partition(":")[2].split(","), page, advice)
    if text.startswith("Missing from") and (names := _missing(box)):
        return InvalidInputError(problem=f"expected {' and '.join(names)}", advice=advice)
    if found := re.match(_UNUSABLE, text):
        return _unusable(found[1], page, words, advice)
    return InvalidInputError(problem=f"{text} ({advice})")


def options_of(page: str) -> set[str]:
    """Return the options that a help page explains."""
    return set(re.findall(r"(?<!\S)--[a-z][\w.-]*\w", page))


def in_words_of_the_command_line(
    error: InvalidInputError | InvalidOptionsError, page: str, words: Sequence[str]
) -> InvalidInputError | InvalidOptionsError:
    """Name an option as users write it: `--ik.damping` in place of `damping`.

    Args:
        error: An error of the library, which knows options by their Python names.
        page: The help page of the command that ran into it.
        words: The words given to the command; an option among them counts more than others.
    """
    name = error.option if isinstance(error, InvalidOptionsError) else error.argument
    options = {o for o in options_of(page) if o[2:].replace("-", "_").rpartition(".")[2] == name}
    options = options & {word.partition("=")[0] for word in words} or options
    if len(options) != 1:
        return error
    return InvalidOptionsError(
        error.problem,
        option=options.pop(),
        expected=error.expected,
        got=error.got,
        advice=error.advice,
    )


def _message(box: str) -> str:
    """Return the message inside tyro's box, on one line."""
    lines = [line.strip(_BORDER) for line in box.splitlines() if line.startswith("│")]
    ends = [i for i, line in enumerate(lines) if not line]
    text = " ".join(lines[: ends[0]] if ends else lines)
    # tyro prefixes options of groups without a name.
    return text.replace("__tyro-dummy-inner__.", "--")


def _unknown(words: Sequence[str], page: str, advice: str) -> InvalidInputError:
    """Name the first unknown option, or the first word too many."""
    words = [word.strip() for word in words]
    option = next((word for word in words if word.startswith("-")), None)
    if option is None:
        return InvalidInputError(problem=f"unexpected word {words[0]!r}", advice=advice)
    option = option.partition("=")[0]
    hint = did_you_mean(option, options_of(page))
    return InvalidInputError(problem=f"no option {option}", advice=hint or advice)


def _missing(box: str) -> list[str]:
    """Return the arguments without a value, as the usage writes them."""
    # Their explanations are indented further.
    return [
        line.strip(_BORDER)
        for line in box.splitlines()
        if re.match(r"│ {5}[^ ]", line) and "--help" not in line
    ]


def _unusable(option: str, page: str, words: Sequence[str], advice: str) -> InvalidInputError:
    """Say which values an option takes, and what was given."""
    metavar = _metavar(option, page)
    given = _given(option, words, 99 if "[" in metavar else len(metavar.split()))
    choices = _choices(metavar)
    expected = f"one of {', '.join(choices)}" if choices else _TYPES.get(metavar, metavar)
    hint = did_you_mean(given, choices) if choices else ""
    got = repr(given) if given else "nothing"
    return InvalidInputError(argument=option, expected=expected, got=got, advice=hint or advice)


def _given(option: str, words: Sequence[str], count: int) -> str:
    """Return the words that follow an option, at most so many."""
    rest: list[str] = []
    for i, word in enumerate(words):
        name, is_joined, value = word.partition("=")
        if name.replace("_", "-") != option.replace("_", "-"):
            continue
        rest = [value] if is_joined else []
        for following in words[i + 1 :]:
            if is_joined or following.startswith("--"):
                break
            rest.append(following)
    return " ".join(rest[:count])


def _metavar(option: str, page: str) -> str:
    """Return what a help page writes behind an option."""
    # Two spaces or the end of the line separate it from the explanation.
    if found := re.search(rf"^│ +{re.escape(option)} (\S+(?: \S+)*)", page, re.MULTILINE):
        return found[1].rstrip(_BORDER)
    return "another value"


def _choices(metavar: str) -> list[str]:
    """Return the words of `{a,b}`."""
    is_set = metavar.startswith("{") and metavar.endswith("}")
    return metavar[1:-1].split(",") if is_set else []
