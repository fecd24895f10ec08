# coal is a compiled module without type information: every name exists and has any type.
from typing import Any

def __getattr__(name: str) -> Any: ...
