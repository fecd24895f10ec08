# mujoco's classes come from a binary module without type information.
from typing import Any

def __getattr__(name: str) -> Any: ...
