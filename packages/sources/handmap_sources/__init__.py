"""Live sources of human hands, each a command of `handmap track` in a file of its own.

`device` has what they share. `openxr` also runs alone, where the OpenXR runtime is.
"""
