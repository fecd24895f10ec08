"""Which method the arguments of a mapper name, and the weights of the QP that go with it."""

from __future__ import annotations

from inspect import isabstract
from typing import cast

from handmap_core.errors import InvalidOptionsError
from handmap_qp.hands import Values
from handmap_qp.ik import IkOptions
from .custom_method import CustomMethod, JointFunction, LandmarkFunction
from .method import Method, MethodOptions, Preset, get_preset


def named_method(
    method: Method | LandmarkFunction | str | None,
    preset: Preset | str | None,
    options: Values,
) -> tuple[Method, IkOptions]:
    """Return the method that the arguments of `HandMapper` name, and the QP weights with it.

    Args:
        method: The method, a function from landmarks to joint angles, or the name of a preset.
        preset: A preset or its name, in place of `method`.
        options: Options of the method that differ; of the paper's method if none is named.

    Raises:
        InvalidOptionsError: If they contradict each other, or there is no such preset.
    """
    if preset is not None and method is not None:
        raise InvalidOptionsError(
            "a method is given, too", option="preset", advice="leave one of them out"
        )
    if isinstance(method, str | Preset):
        preset = method
    if preset is not None:
        named = preset if isinstance(preset, Preset) else get_preset(preset)
        changed = named.method.replaced(**options) if options else named.method
        return changed, named.ik
    chosen = get_preset("paper").method if method is None else method
    if isinstance(chosen, MethodOptions):
        return chosen.replaced(**options) if options else chosen, chosen.weights
    if isinstance(chosen, type) and isinstance(chosen, Method):
        raise _class_given(chosen)
    if not options and not isinstance(chosen, type):
        if isinstance(chosen, CustomMethod):
            return chosen, chosen.weights
        if isinstance(chosen, Method):
            return chosen, IkOptions()
        if callable(chosen):
            function = cast("LandmarkFunction", chosen)
            return JointFunction(function), JointFunction.weights
    raise InvalidOptionsError(
        option="method",
        expected="a method, a function from landmarks to joint angles, the name of a preset, or "
        "single options of the paper's method",
        value=method,
    )


def _class_given(kind: type) -> InvalidOptionsError:
    """Return the error of a class where an object is needed."""
    problem = f"{kind.__name__} is a class"
    if isabstract(kind):
        return InvalidOptionsError(
            f"{problem} without targets", option="method", advice="define `targets`"
        )
    return InvalidOptionsError(
        problem, option="method", advice=f"give an object: {kind.__name__}()"
    )
