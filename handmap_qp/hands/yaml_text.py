"""YAML parsed once for every text: the hands of each recording are read again."""

from __future__ import annotations

import pickle
from functools import lru_cache
from typing import Any

import yaml

YamlError = yaml.YAMLError

_MOST_LEVELS = 2000
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def parse(text: str) -> Any:
    """Return the document in a text; a new one at every call.

    Raises:
        YamlError: If the text is not YAML.
        ValueError: On a date that does not exist.
        RecursionError: If the document is nested too deeply.
    """
    return pickle.loads(_pickled(text))


@lru_cache(maxsize=64)
def _pickled(text: str) -> bytes:
    """Parse YAML with libyaml, in a tenth of the time.

    It crashes on some ten thousand levels, where plain Python raises `RecursionError`. Every level
    takes one of these characters, and a description a few hundred of them.
    """
    is_deep = sum(map(text.count, "[{-?:")) > _MOST_LEVELS
    return pickle.dumps(yaml.load(text, Loader=yaml.SafeLoader if is_deep else _LOADER))
