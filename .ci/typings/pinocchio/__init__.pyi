# Pinocchio's names come from a compiled module without type information: any of them exists, and is of any type.
from typing import Any

def __getattr__(name: str) -> Any: ...
