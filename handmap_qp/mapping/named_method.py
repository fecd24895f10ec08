"""Which method the arguments of a mapper name, and the weights of the QP that go with it."""

from __future__ import annotations

from handmap_core.errors import InvalidOptionsError
from handmap_qp.hands import Values
from handmap_qp.ik import IkOptions
from .method import Method, MethodOptions, get_preset


def named_method(
    method: Method | str | None, preset: str | None, options: Values
) -> tuple[Method, IkOptions]:
    """Return the method that the arguments of `HandMapper` name, and the QP weights with it.

    Args:
        method: The method, or the name of a preset.
        preset: Name of a preset, in place of `method`.
        options: Options of the method that differ; of the paper's method if none is named.

    Raises:
        InvalidOptionsError: If they contradict each other, or there is no such preset.
    """
    if preset is not None and method is not None:
        raise InvalidOptionsError(
            "a method is given, too", option="preset", advice="leave one of them out"
        )
    if isinstance(method, str):
        preset = method
    if preset is not None:
        named = get_preset(preset)
        changed = named.method.replaced(**options) if options else named.method
        return changed, named.ik
    chosen = get_preset("paper").method if method is None else method
    if isinstance(chosen, MethodOptions):
        return chosen.replaced(**options) if options else chosen, chosen.weights
    is_method = isinstance(chosen, Method) and not isinstance(chosen, type)
    if is_method and not options:
        return chosen, IkOptions()
    raise InvalidOptionsError(
        option="method",
        expected="a method, the name of a preset, or single options of the paper's method",
        value=method,
    )
